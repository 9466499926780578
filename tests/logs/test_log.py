"""A user's own log: errors in one sentence, results in any frame, and the page on it."""

import json
import lzma
import math

import numpy as np
import pandas as pd
import pytest

from affordlib.geometry import rotated
from affordlib.logs import Log, PushedObject, cross_validate, fit, planar, summary
from affordlib.results import repo_root
from experiments.real_pushes import pushes_of

TRIANGLE_MM, SHIPPED_MM = ((0, 0), (150, 0), (0, 150)), ((0, 0), (130, 0), (30, 110))
CENTRE_MM = np.array([50.0, 50.0])
START, END = (600.0, -20.0, 0.3), (598.555, -8.562, 0.38)  # the tool touches in both
PUSH = {"tool_t": np.linspace(0, 6.6, 12), "poses": (START, END)}
PUSH |= {"context": {"surface": "felt"}, "group": "felt_mid"}


def tool(angle=0.3, at=(600.0, -20.0)):
    """A tool that comes from below, seen from the triangle, 30 mm from its corner."""
    way = np.stack([np.linspace(30, 35, 12), np.linspace(-2, 14, 12)], axis=1)
    return rotated(way, angle) + at


def one(**changed):
    """Arguments of a valid push, some of them changed."""
    return PUSH | {"tool_xy": tool()} | changed


def shipped_log():
    return Log("mm", SHIPPED_MM, tool_radius=1.5)


def shipped():
    """Arguments of `add` of its fifty pushes."""
    pushes = pushes_of(repo_root() / "data" / "own_log" / "felt_left.txt.xz")
    return [{"tool_t": t, "tool_xy": xy, "poses": planar(p, "wxyz")} for p, t, xy in pushes]


def test_a_push_is_told_in_the_frame_of_the_object():
    log = Log("mm", TRIANGLE_MM)
    log.add(**one())
    data = log.pushes()
    np.testing.assert_allclose(data.contact_m[0], [(30.625 - 50) / 1e3, -0.05], atol=1e-9)
    np.testing.assert_allclose(data.normal, [[0, 1]], atol=1e-12)
    np.testing.assert_allclose(data.direction, [[5, 16] / np.hypot(5, 16)], atol=1e-9)
    assert data.length_m[0] == pytest.approx(0.014 * np.hypot(5, 16) / 16)
    before, after = (np.array(log.centroid_pose(pose)) for pose in (START, END))
    np.testing.assert_allclose(before, (*np.add(rotated(CENTRE_MM, 0.3), (600, -20)) / 1e3, 0.3))
    np.testing.assert_allclose(data.displacement_m[0], rotated((after - before)[:2], -0.3))
    assert data.turn_rad[0] == pytest.approx(0.08)
    query = log.query(rotated(tool() - START[:2], -0.3), PUSH["context"], "felt_mid")
    for name in ("contact_m", "normal", "direction", "length_m", "outline_m"):
        np.testing.assert_allclose(getattr(query, name), getattr(data, name), atol=1e-12)


def test_units_frames_tables_and_poses_in_between_change_nothing():
    log = Log("mm", TRIANGLE_MM)
    log.add(**one())
    x, y, yaw = END
    away = rotated(np.array([x, y]) - (600, -20), np.radians(-40) - 0.3) / 1e3
    poses = (0.0, 0.0, -40.0), (*away, -40 + np.degrees(yaw - 0.3))
    closed = [*TRIANGLE_MM, TRIANGLE_MM[0]]  # as other programs store outlines
    other = Log("m", np.array(closed) / 1e3, angle_unit="deg")
    other.add(**one(poses=poses, tool_xy=rotated(tool(0.0, (0, 0)), np.radians(-40)) / 1e3))
    # The object is seen until after the tool has stopped, when someone takes it away.
    times, poses = [0.0, 3.3, 6.6, 9.0], [START, START, END, (0.0, 0.0, 0.0)]
    table = {"poses": pd.DataFrame(poses), "poses_t": pd.Series(times)}
    between = Log("mm", TRIANGLE_MM)
    between.add(**one(**table, tool_xy=pd.DataFrame(tool())))
    logs = [other, between]
    for unit, size, t in (("cm", 0.1, 1.7e9 + PUSH["tool_t"]), ("m", 1e-3, PUSH["tool_t"])):
        logs.append(Log(unit, np.multiply(TRIANGLE_MM, size)))  # with lists, and stamps as in ROS
        t = (1e9 * t).astype(np.int64) if unit == "cm" else pd.to_datetime(t, unit="s")
        poses = [np.multiply(pose, (size, size, 1)).tolist() for pose in (START, END)]
        logs[-1].add(**one(tool_xy=(tool() * size).tolist(), poses=poses, tool_t=t))
    for name in ("contact_m", "normal", "direction", "length_m", "displacement_m", "turn_rad"):
        for same in logs:
            expected = getattr(log.pushes(), name)
            np.testing.assert_allclose(getattr(same.pushes(), name), expected, atol=1e-9)


BAD = {
    "millimetres as metres": ({"unit": "m"}, "the radius of outline, in m, must lie in"),
    "another outline's unit": (
        {"unit": "m", "outline": np.array(TRIANGLE_MM) / 1e3},
        "tool_xy never touches .*share a frame, unit and clock",
    ),
    "degrees as radians": (
        {"poses": ((600.0, -20.0, 17.2), END)},
        "yaws of poses .angle_unit is 'rad'; take away .* must lie in .* rad, got 17.2",
    ),
    "degrees of the end alone": ({"poses": (START, (605.0, -14.0, 4.5))}, "turn, in rad.* 2.08"),
    "a pose of another push": ({"poses": (START, (700.0, -14.0, 0.38))}, "of poses .*another push"),
    "a missing column of the pose": ({"poses": (START[:2], END[:2])}, "poses must have .* 3 num"),
    "repeated times": ({"tool_t": np.array([0, 1, 1, *range(3, 12)])}, "tool_t must incr.* row 2"),
    "a date that is missing": (
        {"tool_t": np.array([*np.arange(11), "NaT"], "datetime64[s]")},
        "tool_t must be finite, but 1 of 12 rows are not, the first is row 11",
    ),
    "a time that is masked": ({"tool_t": np.ma.masked_equal(range(12), 4)}, "tool_t .* is row 4;"),
    "a gap": (
        {"tool_xy": np.vstack([tool()[:-1], [[np.nan, 0]]])},
        "tool_xy must be finite, but 1 of 12 rows are not, the first is row 11; drop",
    ),
    "an object that was lost": (
        {"poses": [START, *[(np.nan,) * 3] * 4, END], "poses_t": np.linspace(0, 6.6, 6)},
        "poses must be finite, but 4 of 6 rows are not, the first is row 1; drop",
    ),
    "a held pose": ({"poses": (START, START)}, "tool_xy ends 14.0 mm inside .*sign, unit.* held"),
    "two clocks": ({"poses_t": (1.7e9, 1.7e9 + 6.6)}, "poses_t are from 1.7.* tool_t .*same clock"),
    "times of 32 bits": (
        {"tool_t": (1.7e9 + np.linspace(0, 6.6, 12)).astype(np.float32)},
        "tool_t must increase, but row 1 .*64 bits",
    ),
    "positions in space": ({"tool_xy": np.insert(tool(), 2, 7.0, axis=1)}, "tool_xy .*planar"),
    "an object that is lost before the push ends": ({"poses_t": (0.0, 4.0)}, "from 0 to 4, but"),
    "poses without times": ({"poses": (START, START, END)}, "give their times"),
    "a tool inside": (
        {"tool_xy": tool()[8:], "tool_t": np.arange(4.0)},
        "tool_xy is already 9.6 mm inside the outline in its first row",
    ),
    "a context that is no number": ({"context": {"m": float("nan")}}, "context 'm' must be finite"),
    "too many feet": ({"context": {"feet": np.ones((36, 3))}}, "feet must be .*up to 12, 3., got"),
    "a contour of an image": (
        {"outline": np.random.default_rng(0).random((30_000, 2))},
        "outline must be three to 1000 corners .*every tenth point",
    ),
    "a whole session": (
        {"tool_t": np.arange(1e5), "tool_xy": np.zeros((100_000, 2))},
        "tool_xy must have 2 to 20000 rows .*split a session",
    ),
    "a curved push": (
        {"tool_xy": tool() - np.outer(np.sin(np.linspace(0, np.pi, 12)), (9, 0))},
        "way aside .a push is straight: cut a curved one into pieces",
    ),
}
"""Arguments of `Log` or of a push that are wrong, and what is said."""


@pytest.mark.parametrize("name", BAD)
def test_what_is_wrong_is_said_in_a_sentence_and_not_added(name):
    changed, says = BAD[name]
    log = {"unit": "mm", "outline": TRIANGLE_MM}
    log |= {name: changed[name] for name in changed.keys() & log.keys()}
    push, logs = one(**{name: changed[name] for name in changed.keys() - log.keys()}), []

    def read():
        logs.append(Log(**log))
        logs[0].add(**push)

    with pytest.raises(ValueError, match=says) as raised:
        read()
    said = str(raised.value)
    assert "\n" not in said
    assert not logs or (len(logs[0]) == 0 and "push 0 " in said)


def test_whatever_follows_a_recorded_push_is_noticed():
    """All shipped pushes are accepted, and none with a way back or aside; half of it suffices."""
    log = shipped_log()
    for t, xy, poses in map(dict.values, shipped()):
        across = np.array([xy[0, 1] - xy[-1, 1], xy[-1, 0] - xy[0, 0]])
        for then in (xy[0], (xy[0] + xy[-1]) / 2, 20 * xy[0] - 19 * xy[-1], xy[-1] + 2 * across):
            with pytest.raises(ValueError, match=r"way back \(cut it|way aside"):
                log.add(np.append(t, t[-1] + 1), np.vstack([xy, then]), poses)
        log.add(t, xy, poses)
    assert len(log) == 50


def test_a_round_tool_may_meet_a_corner_or_many_edges():
    square = np.array([[-50, -50], [50, -50], [50, 50], [-50, 50]])
    log = Log("mm", square, tool_radius=20)
    log.add((0, 1), ((-90, -90), (-55, -55)), ((0, 0, 0), (9.14, 9.14, 0)))
    data = log.pushes()
    np.testing.assert_allclose(data.contact_m, [[-0.05, -0.05]])
    np.testing.assert_allclose(data.normal, [[0.5**0.5] * 2], atol=1e-9)
    assert data.length_m[0] == pytest.approx(0.020 - 0.005 * 2**0.5)
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    round_log = Log("mm", 50 * np.column_stack([np.cos(angle), np.sin(angle)]), tool_radius=5)
    for a in np.random.default_rng(0).uniform(0, 2 * np.pi, 10):
        out = np.array([math.cos(a), math.sin(a)])
        round_log.add((0, 1), (70 * out, 45 * out), ((0, 0, 0), (*-8 * out, 0)))
    np.testing.assert_allclose(round_log.pushes().length_m, 0.010, atol=8e-5)


def test_edges_on_one_line_do_not_cross():
    letter = ((-60, 0), (60, 0), (60, 30), (15, 30), (15, 120), (-15, 120), (-15, 30), (-60, 30))
    assert Log("mm", letter).origin_m == pytest.approx((0.0, 0.2565 / 6.3))
    folded = ((0, 0), (40, 0), (40, 20), (20, 20), (20, 0), (0, 40))
    bow = ((0, 0), (150, 150), (150, 0), (0, 150))
    for outline, corner in ((folded, 4), (bow, 2)):
        with pytest.raises(ValueError, match=f"crosses itself: .* 0 and from corner {corner}"):
            Log("mm", outline)


def test_a_log_has_pushes_enough_and_of_one_kind():
    log = Log("mm", TRIANGLE_MM)
    with pytest.raises(ValueError, match="log is empty"):
        log.pushes()
    for _ in range(8):
        log.add(**one(group="all"))
    for other in ({"load": 1.0}, {"surface": 3.0}):
        with pytest.raises(ValueError, match=r"push \d+ .*context .* same names and kinds"):
            log.add(**one(context=other))
    with pytest.raises(ValueError, match=r"at least 10 pushes .*'all': 8"):
        cross_validate(log.pushes())
    errors = cross_validate(log.pushes(), models=(), folds=2)
    assert sorted(errors["push"].unique()) == list(range(8))
    assert {row["n"] for row in summary(errors)} == {8}


@pytest.mark.parametrize("late_mm", [0.0, 0.5, 1.5])
def test_a_recording_may_begin_at_the_contact(late_mm):
    """Contact, direction and length are nearly those of the whole recording."""
    whole, late = shipped_log(), shipped_log()
    assert not whole.add_all(shipped())
    pushes = whole.pushes()
    for k, push in enumerate(shipped()):
        left = np.linalg.norm(push["tool_xy"] - push["tool_xy"][-1], axis=1)
        rows = left <= 1e3 * pushes.length_m[k] - late_mm
        late.add(**push | {name: push[name][rows] for name in ("tool_t", "tool_xy")})
    np.testing.assert_allclose(late.pushes().length_m, pushes.length_m, atol=4e-4)
    assert np.abs(late.pushes().contact_m - pushes.contact_m).max() < 2e-3


DAMAGED = {
    "order of the quaternion": lambda ends: [(x, y, 0.0) for x, y, _ in ends],
    "sign of the yaw": lambda ends: [(x, y, -yaw) for x, y, yaw in ends],
    "a quaternion's z as the yaw": lambda ends: [(x, y, np.sin(yaw / 2)) for x, y, yaw in ends],
    "held": lambda ends: [ends[0], ends[0]],
    "seen half way": lambda ends: [ends[0], np.mean(ends, axis=0)],
}


@pytest.mark.parametrize("name", DAMAGED)
def test_spoiled_poses_do_not_become_a_log(name):
    log = shipped_log()
    refused = log.add_all(p | {"poses": DAMAGED[name](p["poses"])} for p in shipped())
    assert len(refused) >= 20
    assert len(log) == 50 - len(refused) == len(log.names)
    assert refused == log.refused
    said = ("likely causes", "a frame, unit and clock", "way back", "way aside", "must lie in")
    assert all(any(word in why for word in said) for why in refused.values())


def test_all_refusals_are_known_after_one_run_by_name():
    pushes = shipped()
    for k in (5, 11, 44):
        pushes[k]["poses"][1] = pushes[k]["poses"][1] + [300, 0, 0]
    log = shipped_log()
    refused = log.add_all(p | {"name": f"take {k}"} for k, p in enumerate(pushes))
    assert [*refused] == ["take 5", "take 11", "take 44"]
    assert log.names[4:6] == ["take 4", "take 6"]
    again = log.add_all([pushes[5] | {"name": "take 5"}, pushes[6] | {"name": "take 6"}])
    assert [*again] == ["take 5", "take 6"]
    assert "another push has this name" in again["take 6"]
    mixed = shipped_log()
    assert not mixed.add_all([pushes[0] | {"name": "1"}, *pushes[1:4]])
    assert mixed.names == ["1", "2", "3", "4"]


@pytest.mark.parametrize("up", ["z", "y", "x"])
@pytest.mark.parametrize("order", ["xyzw", "wxyz"])
def test_poses_in_space_become_poses_in_the_plane(up, order):
    yaw, shift = np.array([-3.0, 0.4, 2.9]), {"z": 0, "y": -1, "x": 1}[up]
    axis = np.roll([0.0, 0.0, 1.0], shift)
    q = np.column_stack([np.sin(yaw / 2)[:, None] * axis, np.cos(yaw / 2)])
    q = q if order == "xyzw" else np.roll(q, 1, axis=1)
    at = np.roll([[1.0, 2.0, 0.1]] * 3, shift, axis=1)
    both = np.hstack([at, q])
    expected = np.column_stack([[1.0] * 3, [2.0] * 3, yaw])
    np.testing.assert_allclose(planar(both, order, up), expected, atol=1e-12)
    np.testing.assert_allclose(planar(at, up=up), [[1, 2]] * 3)
    with pytest.raises(ValueError, match=r"must point up, but in row \d .* another order"):
        planar(both, {"xyzw": "wxyz", "wxyz": "xyzw"}[order], up)


@pytest.mark.parametrize("turn_deg", [0.0, 3.0, 8.0, 12.0])
@pytest.mark.parametrize(("order", "about"), [("xyzw", 0.0), ("wxyz", math.pi)])
def test_a_turn_is_not_read_as_a_tilt(order, about, turn_deg):
    """About these yaws another order looks upright, but its tilt varies as the yaw should."""
    yaw = about + np.radians([-1.0, turn_deg - 1.0])
    q = np.column_stack([[0.004, -0.004], [0, 0.004], np.sin(yaw / 2), np.cos(yaw / 2)])
    rows = np.hstack([np.zeros((2, 3)), q if order == "xyzw" else np.roll(q, 1, axis=1)])
    turn = np.diff(np.unwrap(planar(rows, order)[:, 2]))
    assert np.degrees(turn) == pytest.approx(turn_deg, abs=0.1)
    if turn_deg > 6:
        with pytest.raises(ValueError, match=r"varies by .* another order"):
            planar(rows, {"xyzw": "wxyz", "wxyz": "xyzw"}[order])


def test_the_pushes_that_fit_worst_are_those_whose_pose_jumped():
    pushes = shipped()
    for k in (3, 21):
        pushes[k]["poses"][1] = pushes[k]["poses"][1] + [0, 0, -0.35]
    log = shipped_log()
    log.add_all(pushes)
    errors = cross_validate(log.pushes(), models=(), folds=3)
    spoiled = {name for name in ("3", "21") if name in log.names}
    assert spoiled
    worst = errors[errors["model"] == "physics_gp"].nlargest(3, "error_over_std")
    assert spoiled <= {log.names[k] for k in worst["push"]}
    with pytest.raises(ValueError, match="table of cross_validate"):
        summary(errors.drop(columns="yaw_rad"))


@pytest.fixture(scope="module")
def cells():
    path = repo_root() / "notebooks" / "09_a_log_of_your_own.ipynb"
    return {c["id"]: "".join(c["source"]) for c in json.loads(path.read_text())["cells"]}


def run(cells, ids, folder, logs="data/own_log", **known):
    names = {"seed": 0, "folds": 2, "out_dir": str(folder), "logs": str(logs)}
    names |= {"outline": SHIPPED_MM, "tool_radius": 1.5} | known
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
    np.testing.assert_allclose(fitted.predict(pushes), names["model"].predict(pushes), atol=1e-6)

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


def test_a_damaged_log_of_pushes_is_named(tmp_path):
    packed = (repo_root() / "data" / "own_log" / "felt_mid.txt.xz").read_bytes()
    text = lzma.decompress(packed)
    for name, content in (
        ("a.txt.xz", packed[:-100]),
        ("b.txt.xz", text),
        ("c.txt", text[:-4000]),
        ("d.txt", text.replace(b".", b",", 1)),
        ("e.txt", packed),
        ("f.txt", b""),
    ):
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(ValueError, match=f"{name} is damaged, or is not a log of pushes"):
            list(pushes_of(path))
