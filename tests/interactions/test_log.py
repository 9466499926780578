"""A user's own log: errors are reported in one sentence, and results do not depend on the frame."""

import numpy as np
import pytest

from affordlib.evaluation import cross_validate
from affordlib.evaluation.cross_validate import mirrors
from affordlib.geometry import rotated
from affordlib.interactions import Log
from affordlib.paths import repo_root
from affordlib.perception import outline_image, outline_of
from affordlib.world import Prism
from affordlib.world.camera import depth_crop
from experiments.real_pushes import planar, pushes_of

TRIANGLE_MM = ((0, 0), (150, 0), (0, 150))
CENTRE_MM = np.array([50.0, 50.0])
PUSH = {
    "start": (600.0, -20.0, 0.3),
    "tool_t": np.linspace(0, 6.6, 12),
    "end": (605.0, -14.0, 0.38),
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
    log = Log("mm", TRIANGLE_MM, 0.24)
    log.add(**one())
    data = log.tensors()
    np.testing.assert_allclose(data.contact_m[0], [(30.625 - 50) / 1e3, -0.05], atol=1e-9)
    np.testing.assert_allclose(data.normal, [[0, 1]], atol=1e-12)
    np.testing.assert_allclose(data.direction, [[5, 16] / np.hypot(5, 16)], atol=1e-9)
    assert data.length_m[0] == pytest.approx(0.014 * np.hypot(5, 16) / 16)
    after, before = (
        rotated(CENTRE_MM, p[2]) + np.array(p[:2]) for p in (PUSH["end"], PUSH["start"])
    )
    np.testing.assert_allclose(data.displacement_m[0], rotated(after - before, -0.3) / 1e3)
    assert data.turn_rad[0] == pytest.approx(0.08)
    assert np.isnan(data.effect[0, 1:-1]).all()
    assert np.isfinite(data.effect[0, [0, -1]]).all()
    assert data.interaction_tensors().effect.shape == (1, 2, 3)


def test_units_frames_and_poses_in_between_change_nothing():
    log = Log("mm", TRIANGLE_MM, 0.24)
    log.add(**one())
    x, y, yaw = PUSH["end"]
    elsewhere = {
        "start": (0.0, 0.0, -40.0),
        "end": (*rotated(np.array([x, y]) - (600, -20), np.radians(-40) - 0.3) / 1e3, None),
        "tool_xy": rotated(tool(0.0, (0, 0)), np.radians(-40)) / 1e3,
    }
    elsewhere["end"] = (*elsewhere["end"][:2], -40 + np.degrees(yaw - 0.3))
    other = Log("m", np.array(TRIANGLE_MM) / 1e3, 0.24, angle_unit="deg")
    other.add(**one(**elsewhere))
    between = Log("mm", TRIANGLE_MM, 0.24)
    times, poses = np.array([0.0, 3.3, 6.6]), np.array([PUSH["start"], PUSH["start"], PUSH["end"]])
    between.add(**one(end=None, poses=(times, poses)))
    for name in ("contact_m", "normal", "direction", "length_m", "displacement_m", "turn_rad"):
        for data in (other.tensors(), between.tensors()):
            expected = getattr(log.tensors(), name)
            np.testing.assert_allclose(getattr(data, name), expected, atol=1e-9)
    assert np.isfinite(between.tensors().effect).all()


def test_the_pose_of_the_centroid_is_that_of_the_logged_effects():
    log = Log("mm", TRIANGLE_MM, 0.24)
    log.add(**one())
    before, after = (np.array(log.centroid_pose(PUSH[name])) for name in ("start", "end"))
    np.testing.assert_allclose(before, (*np.add(rotated(CENTRE_MM, 0.3), (600, -20)) / 1e3, 0.3))
    data = log.tensors()
    np.testing.assert_allclose(rotated((after - before)[:2], -0.3), data.displacement_m[0])
    assert after[2] - before[2] == pytest.approx(data.turn_rad[0])


BAD = {
    "millimetres as metres": ({}, {"unit": "m"}, r"outline is \d+ m wide; is it in m\?"),
    "another outline's unit": (
        {},
        {"unit": "m", "outline": np.array(TRIANGLE_MM) / 1e3},
        r"interaction 0 .*tool_xy never enters .*share a frame and unit",
    ),
    "degrees as radians": (
        {"start": (600.0, -20.0, 17.2)},
        {},
        r"interaction 0 .*start has a yaw of 17.2 rad, .*angle_unit",
    ),
    "degrees of the end alone": (
        {"end": (605.0, -14.0, 4.5)},
        {},
        r"interaction 0 .*end is turned by .* rad, but .*rad",
    ),
    "absolute tool, relative object": (
        {"start": (0.0, 0.0, 0.0)},
        {},
        r"interaction 0 .*tool_xy never enters the outline .*share a frame",
    ),
    "a pose of another push": (
        {"end": (700.0, -14.0, 0.38)},
        {},
        r"interaction 0 .*pose 1 of start and end is .* m away, but the tool moves 0.0147 m",
    ),
    "a missing column": (
        {"tool_xy": np.zeros(12)},
        {},
        r"interaction 0 .*tool_xy must hold x and y at each of the 12 times",
    ),
    "a missing column of the pose": (
        {"end": (605.0, -14.0)},
        {},
        r"interaction 0 .*end must be x, y and yaw",
    ),
    "repeated times": (
        {"tool_t": np.array([0, 1, 2, 3, 4, 5, 5, 7, 8, 9, 10, 11.0])},
        {},
        r"interaction 0 .*tool_t must increase, but row 6 .*remove",
    ),
    "a gap": (
        {"tool_xy": np.vstack([tool()[:-1], [[np.nan, 0]]])},
        {},
        r"interaction 0 .*tool_xy must be finite",
    ),
    "effects that do not begin at zero": (
        {"end": None, "poses": (np.array([0, 6.6]), np.array([(610, -20, 0.3), PUSH["end"]]))},
        {},
        r"interaction 0 .*first of poses is .*effects start at zero",
    ),
    "a whole session": (
        {"tool_t": np.arange(1e5), "tool_xy": np.zeros((100_000, 2))},
        {},
        r"interaction 0 .*tool_t has 100000 rows, .*split the recording",
    ),
    "the way back": (
        {"tool_t": np.arange(13.0), "tool_xy": np.vstack([tool(), tool()[:1]])},
        {},
        r"interaction 0 .*goes back: it is 0.014 m .* but -0.002 m at the end; cut tool_xy",
    ),
    "a way aside": (
        {"tool_t": np.arange(13.0), "tool_xy": np.vstack([tool(), np.add(tool()[-1:], (30, 10))])},
        {},
        r"interaction 0 .*not straight: .* at most 0.0\d+ m is expected; cut tool_xy",
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
    given = {"unit": "mm", "outline": TRIANGLE_MM, "crop_width_m": 0.24} | settings
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
    log = Log("mm", outline, 0.24, tool_radius=1.5)
    for poses, t, xy in pushes_of(condition):
        start, end = map(planar, poses)
        across = np.array([xy[0, 1] - xy[-1, 1], xy[-1, 0] - xy[0, 0]])
        for then in (xy[0], (xy[0] + xy[-1]) / 2, 20 * xy[0] - 19 * xy[-1], xy[-1] + 2 * across):
            with pytest.raises(ValueError, match=r"goes back|not straight"):
                log.add(start, np.append(t, t[-1] + 1), np.vstack([xy, then]), end)
        log.add(start, t, xy, end)
    assert len(log) == 50


def test_one_interaction_is_too_few():
    log = Log("mm", TRIANGLE_MM, 0.24)
    with pytest.raises(ValueError, match="log is empty"):
        log.tensors()
    log.add(**one())
    with pytest.raises(ValueError, match=r"at least 10 interactions .*'felt_mid': 1"):
        cross_validate(log.tensors())
    with pytest.raises(ValueError, match=r"context names .*'load'.*that of interaction 0"):
        log.add(**one(context={"load": 1.0}))


def test_pushes_without_a_group_are_summarised_once():
    log = Log("mm", TRIANGLE_MM, 0.24)
    for _ in range(8):
        log.add(**one(group="all"))
    table = cross_validate(log.tensors(), models=(), folds=2)
    assert table["group"].unique().tolist() == ["all"]
    assert table["model"].is_unique


def test_outlines_are_drawn_as_the_camera_sees_them(one_world):
    prism = Prism(((0.0, 0.0), (0.07, 0.0), (0.0, 0.08)), 0.05)
    one_world.place(prism, (0.0, 0.0), 0.0)
    seen, drawn = depth_crop(one_world.client, (0.0, 0.0)), outline_image(prism.footprint_m)
    assert np.abs(seen[1] - drawn[1]).mean() < 0.005
    for image in (seen, drawn):  # to a tenth of a pixel, of 3.3 mm
        corners = outline_of(image)
        assert len(corners) == 3
        off = np.linalg.norm(corners[:, None] - prism.footprint_m, axis=2)
        assert off.min(axis=1).max() < 0.001


def test_the_mirrors_of_outlines():
    square = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * 0.03
    assert len(mirrors(square)) == 4
    assert not mirrors(np.array([[0.0, 0.05], [-0.04, -0.01], [0.04, -0.04]]))
