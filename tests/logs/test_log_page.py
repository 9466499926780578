"""The page on a user's own log: its cells run on any log, and give a table, a model and a plan."""

import json
import lzma

import numpy as np
import pytest

from affordlib.logs import PushedObject, fit
from affordlib.results import repo_root

TRIANGLE_MM = [[0, 0], [130, 0], [30, 110]]


@pytest.fixture(scope="module")
def cells():
    """The source of the page's cells by id."""
    path = repo_root() / "notebooks" / "09_a_log_of_your_own.ipynb"
    return {c["id"]: "".join(c["source"]) for c in json.loads(path.read_text())["cells"]}


def run(cells, ids, folder, logs="data/own_log", **known):
    """Execute some cells; returns their names."""
    names = {"seed": 0, "folds": 2, "out_dir": str(folder), "logs": str(logs)}
    names |= {"outline": TRIANGLE_MM, "tool_radius": 1.5} | known
    for each in ids.split():
        exec(cells[each], names)
    return names


@pytest.mark.slow
def test_from_a_csv_to_a_model_and_a_plan(cells, tmp_path):
    visible = "c05 fit plan"
    assert sum(bool(line.strip()) for n in visible.split() for line in cells[n].splitlines()) <= 45
    written = run(cells, "c03 csv", tmp_path)  # what is folded; the rest brings its own imports
    known = {"csv": written["csv"], "out": tmp_path}
    names = run(cells, "c05 fit predict plan", tmp_path, **known)
    plan, log, pushes = (names[name] for name in ("plan", "log", "pushes"))
    error = {row["model"]: row["position_mean_m"] for row in names["table"]}
    assert error["physics_gp"] < error["gaussian_process"] < error["constant"]
    assert error["np"] < error["constant"]
    assert plan.predicted_distance_m < 0.003
    turn = names["wanted"][2] - names["now"][2]
    assert abs(plan.steps[-1].predicted_turn_rad - turn) < 0.1

    # The page goes on with a model read from a file: it predicts as the fitted one does.
    fitted = fit(pushes, "np", seed=0)
    for one, other in zip(fitted.predict(pushes), names["model"].predict(pushes), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)

    # The first push, in the robot's frame and unit, is a push of the log: recorded, it reads alike.
    contact, end = names["contact_mm"], names["end_mm"]
    path = np.array([contact - 0.5 * (end - contact), end])
    after = np.add(names["now"], (*(end - contact), 0.0))
    log.add((0, 1), path, (names["now"], after))
    read, push = log.pushes().select(np.array([-1])), plan.steps[0].primitive
    assert read.length_m[0] == pytest.approx(push.length, abs=1e-6)
    ahead = np.arctan2(*read.direction[0, ::-1]) + names["now"][2]
    assert np.cos(ahead - push.direction) == pytest.approx(1)


def test_other_conditions_are_read(cells, tmp_path):
    """Any name, compressed or not, any number of pushes."""
    needed, folder = "c03 csv c05 conditions", tmp_path / "logs"
    data = run(cells, needed, tmp_path)["data"]
    assert len(data) == 250
    assert np.degrees(np.arccos((data.normal * data.direction).sum(axis=1))).max() < 52
    with pytest.raises(ValueError, match="pushes must be of one group"):
        PushedObject.of(data)
    folder.mkdir()
    packed = (repo_root() / "data" / "own_log" / "felt_mid.txt.xz").read_bytes()
    (folder / "ice.txt.xz").write_bytes(packed)
    data = run(cells, needed, tmp_path, folder)["data"]
    assert data.context["surface"].tolist() == ["ice"] * 50
    (folder / "ice.txt.xz").unlink()
    text = lzma.decompress(packed)
    (folder / "steel_patch_2.txt").write_bytes(b"12" + text[2:])
    data = run(cells, needed, tmp_path, folder)["data"]
    assert data.context["support"].tolist() == ["patch_2"] * 12
