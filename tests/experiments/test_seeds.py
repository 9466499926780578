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
    assert [(r["planner"], r["seeds"], r["reached"], r["n"], r["mean_m"]) for r in table] == [
        ("astar", 3, True, 4, 3.0),
        ("astar", 3, True, 4, 6.0),
        ("gradient", 2, True, 4, pytest.approx(0.6)),
        ("gradient", 1, False, 4, 3.0),
    ]
    assert (table[0]["sd_mean_m"], table[3]["sd_mean_m"]) == (pytest.approx(math.sqrt(7.0)), None)
    assert "sd_n" not in table[0]
    # Numbers that only some seeds have are averaged over these seeds.
    one, other = {"m": "a", "x": 1.0, "auc": 0.5}, {"m": "a", "x": 2.0, "auc": None, "late": 3.0}
    ((row,), _) = over_seeds([[one], [other]])
    assert row == {"m": "a", "seeds": 2, "x": 1.5, "sd_x": row["sd_x"], "auc": 0.5, "late": 3.0}
    assert over_seeds([[{"m": "a", "x": None}]]) == ([{"m": "a", "x": None, "seeds": 1}], None)
    assert over_seeds([[], []]) == ([], None)


def test_what_differs_is_drawn_with_a_dot_for_every_seed():
    def image(*tables):
        return np.asarray(Image.open(io.BytesIO(over_seeds(tables)[1])).convert("RGB"))

    two = rows(1.0, 0.5), rows(2.0, 0.7)
    assert image(*two).min() < 50 < 200 < image(*two).max()
    assert (image(*two, rows(1.5, 0.6)) != image(*two)).any()
    assert over_seeds([two[0], two[0]])[1] is None


def test_a_dry_run_runs_nothing_and_passes_everything_on(capsys):
    asked = ["7", "8", "--profile", "smoke", "--only", "00", "--out", "dry", "--dry-run", "--force"]
    assert main([*asked, "--settings", "00.goal_x_m=0.11"]) == 0
    said = capsys.readouterr().out
    assert said.count("00_start_here: would run") == 2
    assert "'goal_x_m': 0.11" in said
    assert "'seed': 8" in said
    assert not list((repo_root() / "runs").glob("dry-seed*"))
    assert main(["7", "--settings", "00.goal=1", "--dry-run"]) == 1
    assert "goal" in capsys.readouterr().err
    assert main(["1", "1"]) == 1
    assert capsys.readouterr().err == "seeds: SEEDS must differ, got [1, 1]\n"


@pytest.mark.slow
def test_seeds_side_by_side_are_gathered_and_one_that_fails_is_named(tmp_path):
    book = Book(tmp_path)
    book.add("01_first", 'tables = {"out": [{"what": "a", "length_m": 0.001 * seed}]}')
    text = book.path("01_first").read_text().replace("tables={}", "tables=tables")
    book.path("01_first").write_text(text)
    book.add("02_second", "assert seed != 1, 'no luck'")
    names = {seed: f"mine-seed{seed}" for seed in (1, 3)}
    lines = {seed: book.command("--seed", str(seed), "--out", names[seed]) for seed in names}
    with (
        Client(processes=False, dashboard_address=None, n_workers=2) as client,
        pytest.raises(WorkbookError, match=r"(?s)^seed 1:.*no luck"),
    ):
        run_all(lines, client)
    assert book.log(names[3]) == ["01_first", "02_second"]
    page = gather({seed: book.runs / name for seed, name in names.items()}, book.runs / "both")
    document = read_results(book.runs / "both" / "01_first.json")
    assert document["parameters"] == {"seeds": [1, 3]}
    (row,) = document["tables"]["out"]
    length = {"length_m": 0.002, "sd_length_m": 0.001 * math.sqrt(2)}
    assert {name: row.pop(name) for name in length} == pytest.approx(length)
    assert row == {"seeds": 2, "what": "a"}
    text = page.read_text()
    for said in ("Seeds 1, 3.", "sd length, mm", "| 1.41 |"):
        assert said in text
    (picture,) = re.findall(r"!\[each seed\]\((.+)\)", text)
    with Image.open(page.parent / picture) as image:
        assert image.width > 300


def test_texts_of_results_are_no_markup(tmp_path):
    bad = "<img src=x onerror=alert(1)>"
    for seed in (1, 2):
        rows = [{bad: bad, "x": 1.0 * seed}]
        write_results(tmp_path / str(seed), "00_start_here", {"seed": seed}, {bad: rows})
        (tmp_path / str(seed) / "plan.json").write_text("{}")  # not a notebook's result
    page = gather({seed: tmp_path / str(seed) for seed in (1, 2)}, tmp_path / "both")
    assert page.read_text().count("&lt;img src=x onerror=alert(1)&gt;") == 3
    assert "<img" not in page.read_text()
