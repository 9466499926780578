"""Drag, grasp, rotate and lever-up, the arm's reach, and worlds that vary."""

import math
from dataclasses import dataclass

import numpy as np
import psutil
import pytest

from affordlib.geometry import unit_vector
from affordlib.interactions.recipes import RECIPES, Variation, interact
from affordlib.planning import EffectMap
from affordlib.primitives import Drag, Grasp, LeverUp, Move, Push, Rotate, min_jerk, radians
from affordlib.world import CATEGORIES, Cuboid, LyingCylinder, Prism, Sphere, Tabletop, WorldConfig
from affordlib.world.objects import CHAMFER_M
from tests.waiting import printed

EXAMPLES = (Push(0.3), Drag(0.3), Grasp(0.05), Rotate(), LeverUp(-0.08, 0.0, 0.0, 0.16))


@pytest.mark.parametrize("primitive", EXAMPLES, ids=lambda p: p.name)
def test_a_path_is_smooth_and_passes_its_keyframes(primitive):
    phase = np.linspace(0, 1, 3751)
    path = primitive.path(phase)
    assert np.abs(np.diff(path[:, :3], axis=0)).max() * 1000 < 0.75  # m/s
    for segment, begin in zip(primitive.segments, primitive.segment_phases, strict=False):
        np.testing.assert_allclose(primitive.path(begin)[0], segment.start[:5], atol=1e-9)
    assert sum(segment.seconds for segment in primitive.segments) == pytest.approx(3.75)


def test_push_path_is_the_papers():
    push = Push(theta=0.7)
    path = push.path(np.linspace(0, 1, 301))[:, :2]
    np.testing.assert_allclose(path[0], 0.2 * unit_vector(0.7), atol=1e-12)
    np.testing.assert_allclose(path[-1], -0.05 * unit_vector(0.7), atol=1e-12)
    assert np.hypot(*np.diff(path, axis=0).T).argmax() in (149, 150)
    assert min_jerk(np.array([0.0, 0.5, 1.0])).tolist() == [0.0, 0.5, 1.0]
    assert Push.towards(0.4).direction_rad == pytest.approx(0.4)


def test_the_lever_turns_about_the_far_edge():
    """The blade's tip keeps its distance from the far edge, about which the object turns."""
    lever = LeverUp(-0.08, 0.0, 0.0, 0.16)
    path = lever.path(np.linspace(lever.segment_phases[1], 1, 50))
    edge = np.array([path[0, 0] + 0.16, 0, path[0, 2]])
    np.testing.assert_allclose(np.linalg.norm(path[:, :3] - edge, axis=1), 0.16, atol=1e-9)
    raised = math.asin((path[-1, 2] - path[0, 2]) / 0.16)
    assert math.degrees(raised) == pytest.approx(65)


@pytest.mark.parametrize("category", CATEGORIES.values(), ids=lambda f: f.category)
def test_objects_rest_where_they_are_placed(world, category):
    for seed in range(4):
        obj = category.sample(np.random.default_rng(seed))
        world.place(obj, (0.1, -0.2), 0.7)
        before = np.array(world.object_state())
        world.arm.wait(120)
        np.testing.assert_allclose(world.object_state()[:3], before[:3], atol=4e-4)
        assert not world.placed.fell()
        assert world.placed.rolls() == obj.rollable == (category in (LyingCylinder, Sphere))


def test_a_prism_is_an_extruded_polygon_about_its_centroid():
    square = Prism(((0.0, 0.0), (0.06, 0.0), (0.06, 0.06), (0.0, 0.06)), 0.05)
    np.testing.assert_allclose(square.footprint_m.mean(axis=0), 0.0, atol=1e-12)
    width, rise = CHAMFER_M
    inner = 0.06 - 2 * width
    chamfer = rise * (0.06**2 - (0.06**2 + inner**2 + 0.06 * inner) / 3)  # a frustum is missing
    assert square.volume_m3 == pytest.approx(0.06**2 * 0.05 - chamfer)
    edges = {len(Prism.sample(np.random.default_rng(k)).corners) for k in range(60)}
    assert edges == {3, 4, 5, 6, 7, 8}


def test_grasps_lift_what_fits_and_leave_what_does_not(world):
    world.place(Cuboid(0.05, 0.05, 0.06))
    small = world.execute_primitive(Grasp())
    world.place(Cuboid(0.118, 0.118, 0.06))
    large = world.execute_primitive(Grasp())
    assert small.success
    assert small.rest_effect[2] == pytest.approx(Grasp.lift_m, abs=0.01)
    assert not large.success
    assert not large.faults
    # The fingers stopped when they felt the object's top.
    assert large.tool[:14, 2].min() > 0.06 - 0.003


@pytest.mark.parametrize("name", ["push", "drag", "rotate", "grasp"])
def test_stopped_anywhere_it_rests_where_the_full_one_was(world, name):
    held, slipped = [], []
    for index, stop in enumerate((0.6, 0.7, 0.8, 0.9, 0.75)):
        _, full = interact(RECIPES[name], index, world)
        then = np.array([np.interp(stop, full.phase, effect) for effect in full.effect.T])
        start = full.start_pose
        world.place(world.obj, start[:2], start[2])
        part = world.execute_primitive(full.primitive, stop)
        lost = name == "grasp" and not full.success
        (slipped if lost else held).append(math.dist(part.rest_effect[:3], then[:3]))
    assert len(held) >= 2
    assert np.median(held) < 0.001
    assert max(held) < 0.003
    # An object that slipped from the fingers may still roll when the arm stops.
    assert max(slipped, default=0) < 0.015


def test_mass_off_the_centre_turns_a_push_and_not_the_frame(world):
    turned = []
    for offset in (0.0, 0.036):
        config = WorldConfig(com_offset_m=(0.0, offset, 0.0))
        world.place(Cuboid(0.06, 0.08, 0.05), (0.05, 0.1), 0.0, config=config)
        np.testing.assert_allclose(world.object_pose(), (0.05, 0.1, 0.0), atol=1e-9)
        seen = world.execute_primitive(Push.towards(0.0))
        np.testing.assert_allclose(seen.effect[0, :4], 0.0, atol=1e-6)
        turned.append(seen.effect[-1, 3])
    assert abs(turned[1]) > abs(turned[0]) + 0.01


@pytest.mark.parametrize("category", ["lying_cylinder", "sphere"])
def test_an_unbalanced_round_object_lies_on_its_heavy_side(world, category):
    rng = np.random.default_rng(0)
    for _ in range(5):
        obj = CATEGORIES[category].sample(rng)
        config = Variation().sample(obj, rng)
        world.place(obj, config=config)
        world.settle(3.0)
        assert math.hypot(*world.object_pose()[:2]) < 2e-4
    assert np.linalg.norm(config.com_offset_m) > 0.001


BITS = """
import hashlib
from affordlib.interactions.recipes import RECIPES, interact
from affordlib.world import Tabletop

def bits(world, name, index):
    seen = interact(RECIPES[name], index, world)[1]
    parts = (seen.effect.tobytes(), seen.image.tobytes(), seen.tool.tobytes())
    return hashlib.sha256(b"".join(parts)).hexdigest()
"""


@pytest.mark.slow
def test_no_episode_knows_of_the_one_before(world):
    """In another process or world, or after other episodes: the same bits, no memory leak."""
    space = {}
    exec(BITS, space)
    bits = space["bits"]
    names = ("push", "drag", "grasp", "rotate", "lever_up", "push_varied", "reach")
    jobs, first = [(name, index) for index in range(2) for name in names], {}
    for job in jobs:
        with Tabletop() as fresh:
            first[job] = bits(fresh, *job)
    code = f"{BITS}\nwith Tabletop() as world:\n    print(*(bits(world, *job) for job in {jobs}))"
    assert printed(code).split() == list(first.values())
    before = psutil.Process().memory_info().rss
    for job in [*reversed(jobs), *jobs, *reversed(jobs)]:
        assert bits(world, *job) == first[job]
    assert psutil.Process().memory_info().rss - before < 20e6


def test_a_primitive_is_one_class(film, cuboid_image):
    """Its parameters say how they are checked; whatever moves an object can be planned with."""

    @dataclass(frozen=True)
    class Tap(Move):
        grip: float = radians(0.0)
        seconds: float = 3.75

        name, segments = "tap", Push(0.0).segments

    tap = Tap(-1.0, grip=4.0, seconds=9.0)
    assert (tap.theta, tap.grip, tap.seconds) == (2 * math.pi - 1.0, 4.0 - 2 * math.pi, 9.0)
    with pytest.raises(ValueError, match=r"Tap\.grip must be a finite number"):
        Tap(0.0, grip=math.nan)
    assert EffectMap(film, cuboid_image, Tap).kind is Tap
