import io
import math
import re

import numpy as np
import pytest
from dask.distributed import Client
from PIL import Image

from affordlib.paths import repo_root
from affordlib.results import read_results, write_results
from affordlib.workbook import WorkbookError
from experiments.seeds import gather, main, over_seeds, run_all
from tests.test_workbook import Book


def rows(a, b):
    return [
        {"planner": "astar", "n": 4, "mean_m": a, "reached": True},
        {"planner": "astar", "n": 4, "mean_m": 2 * a, "reached": True},
        {"planner": "gradient", "n": 4, "mean_m": b, "reached": b < 1},
    ]


def test_rows_that_agree_in_words_become_one_with_mean_and_deviation():
    table, _ = over_seeds([rows(1.0, 0.5), rows(2.0, 0.7), rows(6.0, 3.0)])
    assert [(row["planner"], row["seeds"], row["reached"]) for row in table] == [
        ("astar", 3, True),
        ("astar", 3, True),
        ("gradient", 2, True),
        ("gradient", 1, False),
    ]
    assert (table[0]["mean_m"], table[1]["mean_m"]) == (3.0, 6.0)
    assert table[0]["sd_mean_m"] == pytest.approx(math.sqrt(7.0))
    assert (table[0]["n"], "sd_n" in table[0]) == (4, False)
    assert (table[3]["mean_m"], table[3]["sd_mean_m"]) == (3.0, None)


def test_what_differs_is_drawn_with_a_dot_for_every_seed():
    def image(tables):
        return np.asarray(Image.open(io.BytesIO(over_seeds(tables)[1])).convert("RGB"))

    wide = image([rows(1.0, 0.5), rows(2.0, 0.7)])
    assert wide.min() < 50 < 200 < wide.max()
    assert (image([rows(1.0, 0.5), rows(2.0, 0.7), rows(1.5, 0.6)]) != wide).any()
    assert over_seeds([rows(1.0, 0.5), rows(1.0, 0.5)])[1] is None


def test_a_dry_run_runs_nothing_and_passes_everything_on(capsys):
    before = set((repo_root() / "runs").glob("*")) if (repo_root() / "runs").is_dir() else set()
    asked = ["7", "8", "--profile", "smoke", "--only", "00", "--out", "dry", "--dry-run", "--force"]
    assert main([*asked, "--settings", "00.goal_x_m=0.11"]) == 0
    said = capsys.readouterr().out
    assert said.count("00_start_here: would run") == 2
    assert "'goal_x_m': 0.11" in said
    assert "'seed': 8" in said
    after = set((repo_root() / "runs").glob("*"))
    assert not [path for path in after - before if path.name.startswith("dry")]
    assert main(["7", "--settings", "00.goal=1", "--dry-run"]) == 1
    assert "goal" in capsys.readouterr().out


@pytest.fixture
def book(tmp_path):
    book = Book(tmp_path)
    book.add("01_first", 'tables = {"out": [{"what": "a", "length_m": 0.001 * seed}]}')
    text = book.path("01_first").read_text().replace("tables={}", "tables=tables")
    book.path("01_first").write_text(text)
    return book


def run(book, seeds, client=None):
    run_all({k: book.command("--seed", str(k), "--out", f"mine-seed{k}") for k in seeds}, client)


@pytest.mark.slow
def test_seeds_side_by_side_are_gathered_into_one_table_and_page(book):
    with Client(processes=False, dashboard_address=None, n_workers=2) as client:
        run(book, [1, 3], client)
    runs = book.runs
    folders = {seed: runs / f"mine-seed{seed}" for seed in (1, 3)}
    page = gather(folders, runs / "mine-seeds")
    document = read_results(runs / "mine-seeds" / "01_first.json")
    assert document["parameters"] == {"seeds": [1, 3]}
    (row,) = document["tables"]["out"]
    assert row == {
        "seeds": 2,
        "what": "a",
        "length_m": pytest.approx(0.002),
        "sd_length_m": pytest.approx(0.001 * math.sqrt(2)),
    }
    text = page.read_text()
    assert "Seeds 1, 3." in text
    assert "sd length, mm" in text
    assert "| 1.41 |" in text
    (picture,) = re.findall(r"!\[each seed\]\((.+)\)", text)
    with Image.open(page.parent / picture) as image:
        assert image.width > 300


@pytest.mark.slow
def test_a_seed_that_fails_is_named_and_the_others_run(book):
    book.add("02_second", "assert seed != 1, 'no luck'")
    with pytest.raises(WorkbookError, match=r"(?s)^seed 1:.*no luck"):
        run(book, [1, 2])
    assert book.log("mine-seed2") == ["01_first", "02_second"]


def test_seeds_must_differ(capsys):
    assert main(["1", "1"]) == 1
    assert capsys.readouterr().err == "seeds: SEEDS must differ, got [1, 1]\n"


def test_numbers_that_only_some_seeds_have_are_meaned_over_those():
    one, other = {"m": "a", "x": 1.0, "auc": 0.5}, {"m": "a", "x": 2.0, "auc": None, "late": 3.0}
    ((row,), _) = over_seeds([[one], [other]])
    assert row == {"m": "a", "seeds": 2, "x": 1.5, "sd_x": row["sd_x"], "auc": 0.5, "late": 3.0}
    assert over_seeds([[{"m": "a", "x": None}]]) == ([{"m": "a", "x": None, "seeds": 1}], None)
    assert over_seeds([[], []]) == ([], None)


def test_texts_of_results_are_no_markup(tmp_path):
    bad = "<img src=x onerror=alert(1)>"
    for seed in (1, 2):
        rows = [{bad: bad, "x": 1.0 * seed}]
        write_results(tmp_path / str(seed), "00_start_here", {"seed": seed}, {bad: rows})
        (tmp_path / str(seed) / "plan.json").write_text("{}")  # nothing of a notebook
    page = gather({seed: tmp_path / str(seed) for seed in (1, 2)}, tmp_path / "both")
    assert page.read_text().count("&lt;img src=x onerror=alert(1)&gt;") == 3
    assert "<img" not in page.read_text()
