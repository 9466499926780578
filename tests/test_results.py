"""Results are read back unchanged, written completely or not at all; tables are made from them."""

import json
import math
import os
import re
import subprocess
import sys
import time

import numpy as np
import pytest

from affordlib import results
from affordlib.results import read_results, write_results
from experiments import tables
from experiments.tables import fill_tables, markdown_table
from tests.waiting import no_room, wait_until

ROWS = [
    {"planner": "astar", "n": 30, "mean_m": 0.00441, "plan_ms_median": 12.345, "tp_percent": 80.0},
    {"planner": "gradient", "n": 30, "mean_m": None, "plan_ms_median": 1.0, "tp_percent": 99.96},
]
SHOWN = [("p95_m", 0.0123456, "p95, mm", "12.35"), ("theta_rad", math.pi / 2, "theta, °", "90.0")]
SHOWN += [("error_mm", -0.001, "error, mm", "0.00"), ("closed_loop", False, "closed loop", "no")]
SHOWN += [("loss", 0.123456, "loss", "0.123"), ("loss", -999.7, "loss", "-1000")]
SHOWN += [("note", "two\nlines", "note", "two lines"), ("m", 3, "m", "3")]


def test_round_trip_converts_numpy_scalars(tmp_path):
    row = {"n": np.int64(3), "mean_m": np.float32(0.5), "ok": np.bool_(True), "x": None}
    path = write_results(tmp_path, "06_planning", {"modes": ("full", "partial")}, {"t": [row]})
    document = read_results(path)
    assert path == tmp_path / "06_planning.json"
    assert document["notebook"] == "06_planning"
    assert document["parameters"] == {"modes": ["full", "partial"]}
    assert document["tables"] == {"t": [{"n": 3, "mean_m": 0.5, "ok": True, "x": None}]}
    assert document["tables"]["t"][0]["ok"] is True
    assert {"python", "torch", "pybullet", "platform"} < document["versions"].keys()
    assert read_results(write_results(tmp_path, "a", {}, {"t": []}))["tables"] == {"t": []}


def test_bad_tables_are_refused_before_anything_is_written(tmp_path):
    for table, named in (
        ([{"mean_m": math.nan}], r"tables\['t'\]\[0\]\['mean_m'\] is nan"),
        ([{"a": 1.0}, {"a": np.float64("-inf")}], r"\[1\]\['a'\] is -inf"),
        ([{"a": np.zeros(2)}], r"\['a'\] .*ndarray"),
        ([{3: 1}], r"tables\['t'\]\[0\] has the key 3"),
        ({"a": 1}, r"tables\['t'\] .*dict"),
        ([[1]], r"tables\['t'\] .*each a dict"),
    ):
        with pytest.raises((TypeError, ValueError), match=named):
            write_results(tmp_path, "06_planning", {}, {"t": table})
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_full_disk_leaves_the_old_file(tmp_path, monkeypatch, step):
    path = write_results(tmp_path, "a", {}, {"t": [{"n": 1}]})
    before = path.read_bytes()
    monkeypatch.setattr(os, step, no_room)
    with pytest.raises(OSError, match=r"No space left.*a\.json") as failure:
        write_results(tmp_path, "a", {}, {"t": [{"n": 2}]})
    assert failure.value.filename == str(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_kill_leaves_no_half_file_and_the_next_writer_no_leftovers(tmp_path):
    code = (
        "import itertools, os, sys\n"
        "from affordlib.results import write_results\n"
        "rows, slow = [{'n': i, 'text': 'x' * 200} for i in range(2000)], 'slow' in sys.argv\n"
        "os.fsync = (lambda _: input()) if slow else os.fsync\n"
        "for i in itertools.count():\n"
        "    write_results(sys.argv[1], 'a', {'i': i}, {'t': rows})\n"
    )
    path, left = tmp_path / "a.json", []
    for how in ("fast", "slow"):  # killed somewhere, and before the file gets its name
        command = [sys.executable, "-c", code, str(tmp_path), how]
        with subprocess.Popen(command, stdin=subprocess.PIPE) as process:
            there = "a.json" if how == "fast" else f".*.{process.pid}.*.tmp"
            wait_until(lambda there=there: list(tmp_path.glob(there)), process=process)
            time.sleep(0.3)
            process.kill()
        left = [p.name for p in tmp_path.iterdir() if p != path]
        assert [row["n"] for row in read_results(path)["tables"]["t"]] == list(range(2000))
    assert len(left) == 1
    assert left[0].startswith(f".a.json.{process.pid}.")
    living = tmp_path / f".a.json.{os.getppid()}.0.tmp"
    living.touch()  # of a writer that is still running
    write_results(tmp_path, "a", {}, {})
    assert sorted(tmp_path.iterdir()) == [living, path]


def test_damaged_or_missing_results_are_named(tmp_path):
    for text, reason in (
        ('{"notebook": "a", "parameters": {}, "vers', "JSONDecodeError"),
        ('{"notebook": 1, "parameters": 1, "versions": 1, "tables": {"t": [{"a": NaN}]}}', "nan"),
        ('{"notebook": "a", "parameters": {}, "versions": {}}', "KeyError.'tables'"),
        ("[]", "TypeError"),
        ("[" * 100_000, "RecursionError"),
    ):
        (tmp_path / "a.json").write_text(text)
        with pytest.raises(ValueError, match=rf"a\.json .*{reason}.*delete it and run"):
            read_results(tmp_path / "a.json")
    with pytest.raises(FileNotFoundError, match=r"b\.json; run the notebook"):
        read_results(tmp_path / "b.json")


def test_relative_folders_start_at_the_repository(tmp_path, monkeypatch):
    root = tmp_path / "checkout"
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.setattr(results, "repo_root", lambda: root)
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert results.resolve_out_dir("runs/lab") == root / "runs" / "lab"
    assert (root / "runs" / "lab").is_dir()
    (root / "file").write_text("")
    for bad in ("file", "file/under"):
        with pytest.raises(NotADirectoryError, match="out_dir must be a folder"):
            results.resolve_out_dir(bad)


MARKDOWN = """\
| planner | n | mean, mm | plan median, ms | tp, % |
| --- | ---: | ---: | ---: | ---: |
| astar | 30 | 4.41 | 12.3 | 80.0 |
| gradient | 30 | – | 1.0 | 100.0 |
"""


def test_tables_show_units_and_few_digits():
    assert markdown_table(ROWS) == MARKDOWN
    short = "| n | planner |\n| ---: | --- |\n| 30 | astar |\n"
    assert markdown_table(ROWS[:1], ["n", "planner"]) == short
    with pytest.raises(ValueError, match="'speed' is not in the table; it has planner, n"):
        markdown_table(ROWS, ["speed"])
    table = results.results_table(ROWS, ["planner", "mean_m"])
    assert list(table.columns) == ["planner", "mean, mm"]
    assert table.to_numpy().tolist() == [["astar", "4.41"], ["gradient", "–"]]
    for column, value, head, shown in SHOWN:  # units come from the name
        assert (results.heading(column), results.cell(column, value)) == (head, shown)


def test_pages_are_filled_and_checked_and_blocks_must_choose_what_is_there(tmp_path, capsys):
    source = write_results(tmp_path, "06_planning", {}, {"planning": ROWS})
    page = tmp_path / "page.md"
    opened = f"<!-- table: {source}#planning -->\n"
    page.write_text(f"# Title\n\n{opened}stale\n<!-- /table -->\n\nend\n")
    assert tables.main(["--check", str(page)]) == 1
    assert "python -m experiments.tables" in capsys.readouterr().err
    assert "stale" in page.read_text()
    assert tables.main([str(page)]) == 0
    assert page.read_text() == f"# Title\n\n{opened}{MARKDOWN}<!-- /table -->\n\nend\n"
    assert tables.main(["--check", str(page)]) == 0
    block = "<!-- table: {}#planning {} -->\n<!-- /table -->\n"
    for option, reason in [("planner=rrt", "no row"), ("columns=x", "'x'"), ("mode=a", "'mode'")]:
        with pytest.raises(ValueError, match=reason):
            fill_tables(block.format(source, option))
    with pytest.raises(ValueError, match="not closed"):
        fill_tables(opened)


def test_columns_are_drawn_as_dots_once(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(tables, "PICTURES", str(tmp_path))
    source, page = write_results(tmp_path, "a", {}, {"t": ROWS}), tmp_path / "page.md"
    block = f"<!-- table: {source}#t picture=some:{{}} -->\n<!-- /table -->\n"
    page.write_text(block.format("mean"))
    for arguments, code in (["--check"], 1), ([], 0), (["--check"], 0):
        assert tables.main([*arguments, str(page)]) == code
    texts = re.findall(r">([^<]+)</text>", (tmp_path / "some.svg").read_text())
    assert {"astar", "gradient", "[mm]"} <= {*texts}
    page.write_text(block.format("plan_median"))  # drawn again
    assert tables.main([str(page)]) == 0
    page.write_text(block.format("mean,tp"))
    assert tables.main([str(page)]) == 1
    assert "['mean', 'tp'] must be headings of one unit" in capsys.readouterr().err
    assert tables.interval_of("2.0 ± 0.5") == (2.0, 1.5, 2.5)
    assert tables.interval_of("-1.0 (-2.5 to 1.0)") == (-1.0, -2.5, 1.0)
    assert np.isnan(tables.interval_of("–")).all()


def test_the_pages_and_the_shipped_results_agree_and_carry_no_path():
    root, pages = results.repo_root(), ("README.md", "RESULTS.md", "data/README.md")
    assert tables.main(["--check", *(str(root / name) for name in pages)]) == 0
    for path in (root / "data" / "results").glob("*.json"):
        assert read_results(path)["notebook"] == path.stem
        given = json.loads(path.read_text())["parameters"].values()
        assert not [v for v in given if isinstance(v, str) and os.path.isabs(v)]


def test_blocks_join_columns_and_turn_rows_into_columns(tmp_path):
    three = ("a", "b_c", 2e-3), ("a", "d", None), ("e", "d", 3e-3)
    rows = [{"planner": p, "mode": m, "mean_m": mean, "sem_m": 1e-3} for p, m, mean in three]
    source = write_results(tmp_path, "06_planning", {}, {"planning": rows})
    options = "columns=who:planner by=mode 'values=mean_m±sem_m,up_to:mean_m(sem_m..sem_m)'"
    block = f"<!-- table: {source}#planning planner=e,a {options} -->\n<!-- /table -->\n"
    filled = fill_tables(block)
    assert filled.splitlines()[1:-1] == [
        "| who | d: mean, mm | b c: mean, mm | d: up to, mm | b c: up to, mm |",
        "| --- | ---: | ---: | ---: | ---: |",
        "| e | 3.00 ± 1.00 | – | 3.00 (1.00 to 1.00) | – |",
        "| a | – | 2.00 ± 1.00 | – | 2.00 (1.00 to 1.00) |",
    ]
