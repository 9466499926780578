"""A user's own log: errors are reported in one sentence, and results do not depend on the frame."""

import math

import numpy as np
import pandas as pd
import pytest

from affordlib.geometry import rotated
from affordlib.logs import Log, cross_validate, summary
from affordlib.paths import repo_root
from experiments.real_pushes import planar, pushes_of

TRIANGLE_MM = ((0, 0), (150, 0), (0, 150))
CENTRE_MM = np.array([50.0, 50.0])
START, END = (600.0, -20.0, 0.3), (605.0, -14.0, 0.38)
PUSH = {
    "tool_t": np.linspace(0, 6.6, 12),
    "poses": (START, END),
    "context": {"surface": "felt"},
    "group": "felt_mid",
}


def tool(angle=0.3, at=(600.0, -20.0)):
    """A tool that comes from below, seen from the triangle, 30 mm from its corner."""
    way = np.stack([np.linspace(30, 35, 12), np.linspace(-2, 14, 12)], axis=1)
    return rotated(way, angle) + at


def one(**changed):
    """Arguments of a valid push, some of them changed."""
    return PUSH | {"tool_xy": tool()} | changed


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
    elsewhere = {
        "poses": ((0.0, 0.0, -40.0), (*away, -40 + np.degrees(yaw - 0.3))),
        "tool_xy": rotated(tool(0.0, (0, 0)), np.radians(-40)) / 1e3,
    }
    closed = [*TRIANGLE_MM, TRIANGLE_MM[0]]  # as other programs store outlines
    other = Log("m", np.array(closed) / 1e3, angle_unit="deg")
    other.add(**one(**elsewhere))
    # The object is seen until after the tool has stopped, when someone takes it away.
    times, poses = [0.0, 3.3, 6.6, 9.0], [START, START, END, (0.0, 0.0, 0.0)]
    table = {"poses": pd.DataFrame(poses), "poses_t": pd.Series(times)}
    between = Log("mm", TRIANGLE_MM)
    between.add(**one(**table, tool_xy=pd.DataFrame(tool())))
    for name in ("contact_m", "normal", "direction", "length_m", "displacement_m", "turn_rad"):
        for data in (other.pushes(), between.pushes()):
            expected = getattr(log.pushes(), name)
            np.testing.assert_allclose(getattr(data, name), expected, atol=1e-9)


BAD = {
    "millimetres as metres": ({}, {"unit": "m"}, r"the radius of outline, in m, must lie in .*"),
    "another outline's unit": (
        {},
        {"unit": "m", "outline": np.array(TRIANGLE_MM) / 1e3},
        r"push 0 .*tool_xy never touches .*share a frame and unit",
    ),
    "degrees as radians": (
        {"poses": ((600.0, -20.0, 17.2), END)},
        {},
        r"push 0 .*yaws of poses, in rad, must lie in .* got 17.2",
    ),
    "degrees of the end alone": (
        {"poses": (START, (605.0, -14.0, 4.5))},
        {},
        r"push 0 .*the turn, in rad, of poses .* must lie in .* rad, got 2.08",
    ),
    "absolute tool, relative object": (
        {"poses": ((0.0, 0.0, 0.0), END)},
        {},
        r"push 0 .*tool_xy never touches the outline.*share a frame",
    ),
    "a pose of another push": (
        {"poses": (START, (700.0, -14.0, 0.38))},
        {},
        r"push 0 .*motion of poses after 0.0147 m .*another push's.* got 0.0952",
    ),
    "a missing column": (
        {"tool_xy": np.zeros(12)},
        {},
        r"push 0 .*tool_xy must have 2 to 20000 rows of 2 numbers, got \(12,\)",
    ),
    "a missing column of the pose": (
        {"poses": (START[:2], END[:2])},
        {},
        r"push 0 .*poses must have 2 to 20000 rows of 3 numbers",
    ),
    "repeated times": (
        {"tool_t": np.array([0, 1, 2, 3, 4, 5, 5, 7, 8, 9, 10, 11.0])},
        {},
        r"push 0 .*tool_t must increase, but row 6 .*remove",
    ),
    "a gap": (
        {"tool_xy": np.vstack([tool()[:-1], [[np.nan, 0]]])},
        {},
        r"push 0 .*tool_xy must be finite",
    ),
    "an object that is lost before the push ends": (
        {"poses_t": (0.0, 4.0)},
        {},
        r"push 0 .*poses_t are from 0 to 4, but the tool moves from 0 to 6.6: .*same clock",
    ),
    "poses without times": ({"poses": (START, START, END)}, {}, r"push 0 .*give their times"),
    "a tool inside": (
        {"tool_xy": tool()[8:], "tool_t": np.arange(4.0)},
        {},
        r"push 0 .*tool_xy begins inside the outline: the gap is -0.00964 m at first",
    ),
    "a context without a value": (
        {"context": {"m": None}},
        {},
        r"push 0 .*context 'm' must be finite numbers",
    ),
    "a context that is no number": (
        {"context": {"m": float("nan")}},
        {},
        r"push 0 .*context 'm' must be finite numbers",
    ),
    "too many feet": (
        {"context": {"feet": np.ones((36, 3))}},
        {},
        r"context feet must be .*up to 12, 3\), got \(36, 3\)",
    ),
    "a contour of an image": (
        {},
        {"outline": np.random.default_rng(0).random((30_000, 2))},
        r"outline must be three to 1000 corners .*every tenth point",
    ),
    "a whole session": (
        {"tool_t": np.arange(1e5), "tool_xy": np.zeros((100_000, 2))},
        {},
        r"push 0 .*tool_xy must have 2 to 20000 rows .*split the recording",
    ),
    "the way back": (
        {"tool_t": np.arange(13.0), "tool_xy": np.vstack([tool(), tool()[:1]])},
        {},
        r"push 0 .*way back \(cut it where the push ends\) must lie in .* got 0.016",
    ),
    "a way aside": (
        {"tool_t": np.arange(13.0), "tool_xy": np.vstack([tool(), np.add(tool()[-1:], (30, 10))])},
        {},
        r"push 0 .*way aside \(cut it where .* must lie in .* m, got 0.0",
    ),
    "an outline that crosses itself": (
        {},
        {"outline": ((0, 0), (150, 150), (150, 0), (0, 150))},
        r"outline crosses itself: .*corner 0 and from corner 2",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_wrong_is_said_in_a_sentence_and_not_added(name):
    changed, settings, says = BAD[name]
    given = {"unit": "mm", "outline": TRIANGLE_MM} | settings
    logs = []

    def read():
        logs.append(Log(**given))
        logs[0].add(**one(**changed))

    with pytest.raises(ValueError, match=says) as raised:
        read()
    assert "\n" not in str(raised.value)
    assert not any(map(len, logs))


def test_whatever_follows_a_recorded_push_is_noticed():
    """All shipped pushes are accepted, and none with a way back or aside; half of it suffices."""
    condition = repo_root() / "data" / "own_log" / "felt_left.txt.xz"
    outline = ((0, 0), (130, 0), (30, 110))
    log = Log("mm", outline, tool_radius=1.5)
    for poses, t, xy in pushes_of(condition):
        poses = [*map(planar, poses)]
        across = np.array([xy[0, 1] - xy[-1, 1], xy[-1, 0] - xy[0, 0]])
        for then in (xy[0], (xy[0] + xy[-1]) / 2, 20 * xy[0] - 19 * xy[-1], xy[-1] + 2 * across):
            with pytest.raises(ValueError, match=r"way back|way aside"):
                log.add(np.append(t, t[-1] + 1), np.vstack([xy, then]), poses)
        log.add(t, xy, poses)
    assert len(log) == 50


def test_a_round_tool_may_meet_a_corner_or_many_edges():
    square = np.array([[-50, -50], [50, -50], [50, 50], [-50, 50]])
    log = Log("mm", square, tool_radius=20)
    log.add((0, 1), ((-90, -90), (-55, -55)), ((0, 0, 0), (1, 1, 0)))
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
    with pytest.raises(ValueError, match="crosses itself"):
        Log("mm", folded)


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
