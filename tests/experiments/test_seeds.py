import math

import pytest

from affordlib.results import read_results, write_results
from experiments.seeds import main, over_seeds


def rows(a, b):
    return [
        {"planner": "astar", "n": 4, "mean_m": a, "reached": True},
        {"planner": "astar", "n": 4, "mean_m": 2 * a, "reached": True},
        {"planner": "gradient", "n": 4, "mean_m": b, "reached": b < 1},
    ]


def test_rows_that_agree_in_words_become_one_with_mean_and_deviation():
    table = over_seeds([rows(1.0, 0.5), rows(2.0, 0.7), rows(6.0, 3.0)])
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
    (row,) = over_seeds([[one], [other]])
    assert row == {"m": "a", "seeds": 2, "x": 1.5, "sd_x": row["sd_x"], "auc": 0.5, "late": 3.0}
    assert over_seeds([[{"m": "a", "x": None}]]) == [{"m": "a", "x": None, "seeds": 1}]
    assert over_seeds([[], []]) == []


def test_seeds_are_gathered_and_texts_of_results_are_no_markup(tmp_path, capsys):
    bad = "<img src=x onerror=alert(1)>"
    for seed in (1, 3):
        folder = tmp_path / f"mine-seed{seed}"
        table = [{bad: bad, "length_m": 0.001 * seed}]
        write_results(folder, "00_start_here", {"seed": seed}, {bad: table})
        (folder / "plan.json").write_text("{}")  # not a page's result
    assert main([str(tmp_path / "mine"), "1", "3"]) == 0
    page = (tmp_path / "mine-seeds" / "index.md").read_text()
    assert str(tmp_path / "mine-seeds") in capsys.readouterr().out
    for said in ("Seeds 1, 3.", "sd length, mm", "| 1.41 |"):
        assert said in page
    assert page.count("&lt;img src=x onerror=alert(1)&gt;") == 3
    assert "<img" not in page
    document = read_results(tmp_path / "mine-seeds" / "00_start_here.json")
    assert document["parameters"] == {"seeds": ["1", "3"]}
    (row,) = document["tables"][bad]
    assert (row["length_m"], row["sd_length_m"]) == pytest.approx((0.002, 0.001 * math.sqrt(2)))
