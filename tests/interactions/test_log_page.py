"""The page on a user's own log: its thirty lines run, and give a table and a plan."""

import json
import lzma
import re

import numpy as np
import pytest

from affordlib.paths import repo_root
from affordlib.planning import plan_push_at
from affordlib.types import Goal
from tests.problems import Still

IMPORTS = """
import lzma, numpy as np
from affordlib.evaluation import cross_validate
from affordlib.interactions import Log
from affordlib.models import fit
from affordlib.paths import repo_root
from affordlib.planning import plan_push_at
from affordlib.types import Goal
"""


@pytest.fixture(scope="module")
def script():
    """The page's thirty lines, run on one condition, with quick models."""
    path = repo_root() / "notebooks" / "09_a_log_of_your_own.ipynb"
    cells = json.loads(path.read_text())["cells"]
    (cell,) = [c for c in cells if "script" in c["metadata"].get("tags", [])]
    return IMPORTS + "".join(cell["source"])


@pytest.mark.slow
def test_the_script_of_thirty_lines(script):
    lines = [line for line in script.splitlines() if line.strip()]
    assert len(lines) <= 30 + 1
    outline = ((0, 0), (130, 0), (30, 110))
    names = {"logs": "data/own_log", "outline": outline, "tool_radius": 1.5, "folds": 2, "seed": 0}
    exec(script, names)
    table, plan = names["table"], names["plan"]
    assert table.columns.tolist() == [
        *("model", "group", "n_train", "n", "position_mean_m", "position_sem_m"),
        *("position_median_m", "yaw_mean_rad", "yaw_sem_rad", "coverage_50", "coverage_90"),
    ]
    error = table[table["group"] == "all"].set_index("model")["position_mean_m"]
    assert error["physics_gp"] < error["gaussian_process"] < error["constant"]
    assert error["np"] < error["constant"]
    assert plan.predicted_distance_m < 0.003
    assert abs(plan.steps[-1].predicted_turn_rad - 0.25) < 0.1


def reading(script, folder):
    """The log that the script reads from a folder."""
    names = {"logs": folder, "outline": ((0, 0), (130, 0), (30, 110)), "tool_radius": 1.5}
    exec(re.split(r"^pushes = ", script, flags=re.MULTILINE)[0], names)
    return names["data"]


def test_other_conditions_are_read(script, tmp_path):
    """Any name, compressed or not, any number of pushes; the error of a truncated one says so."""
    packed = (repo_root() / "data" / "own_log" / "felt_mid.txt.xz").read_bytes()
    (tmp_path / "ice.txt.xz").write_bytes(packed)
    assert reading(script, tmp_path).context["surface"].tolist() == ["ice"] * 50
    (tmp_path / "ice.txt.xz").unlink()
    text = lzma.decompress(packed)
    (tmp_path / "steel_patch_2.txt").write_bytes(b"12" + text[2:])
    assert reading(script, tmp_path).context["support"].tolist() == ["patch_2"] * 12
    (tmp_path / "steel_patch_2.txt").write_bytes(text[:-4000])
    with pytest.raises(ValueError, match=r"interaction \d+ \(group 'steel_patch_2'\): tool_"):
        reading(script, tmp_path)


def test_plans_want_one_group(script):
    data = reading(script, "data/own_log")
    assert len(data) == 250
    assert np.degrees(np.arccos((data.normal * data.direction).sum(axis=1))).max() < 52
    with pytest.raises(ValueError, match="log must hold one group"):
        plan_push_at(Still(), data, (0.0, 0.0, 0.0), Goal((0.01, 0.0)))
