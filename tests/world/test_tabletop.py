"""The tabletop: arm, camera, primitives, obstacles, worlds that vary, and estimates from images."""

import gc
import math
from dataclasses import dataclass

import numpy as np
import psutil
import pybullet
import pytest
from pybullet_utils.bullet_client import BulletClient

from affordlib import perception
from affordlib.geometry import unit_vector
from affordlib.interactions.recipes import RECIPES, Variation, interact
from affordlib.planning import EffectMap
from affordlib.primitives import Drag, Grasp, LeverUp, Move, Push, Rotate, min_jerk, radians
from affordlib.types import CROP_WIDTH_M, IMAGE_PIXELS, NothingSeenError, Obstacle, UnreachableError
from affordlib.world import CATEGORIES, Tabletop, WorldConfig
from affordlib.world.objects import CHAMFER_M, Cuboid, LyingCylinder, Prism, Sphere, UprightCylinder
from affordlib.world.robot import HOME, TOOL_LENGTH_M, inverse_kinematics, load_robot
from experiments.t_on_arm import TBlock
from tests.waiting import printed

OBJECTS = (Cuboid(0.05, 0.07, 0.06), UprightCylinder(0.06, 0.05))
LEVER = LeverUp(-0.03, 0.0, 0.0, 0.06)
STAR = tuple((0.05 * math.cos(a), 0.05 * math.sin(a)) for a in 0.8 * math.pi * np.arange(5))
EXAMPLES = (Push(0.3), Drag(0.3), Grasp(0.05), Rotate(), LeverUp(-0.08, 0.0, 0.0, 0.16))


def test_inverse_kinematics_agrees_with_the_description():
    client = BulletClient(pybullet.DIRECT)
    arm = load_robot(client)
    rng = np.random.default_rng(0)
    for _ in range(50):
        xyz = rng.uniform([-0.4, -0.5, 0.01], [0.4, 0.5, 0.2])
        yaw = rng.uniform(-math.pi, math.pi)
        joints = inverse_kinematics(xyz, yaw, HOME)
        for joint, angle in enumerate(joints):
            client.resetJointState(arm, joint, angle)
        state = client.getLinkState(arm, 6, computeForwardKinematics=True)
        axes = np.array(pybullet.getMatrixFromQuaternion(state[5])).reshape(3, 3)
        tip = np.array(state[4]) + TOOL_LENGTH_M * axes[:, 2]
        np.testing.assert_allclose(tip, xyz, atol=1e-6)
        np.testing.assert_allclose(axes[:2, 0], [math.cos(yaw), math.sin(yaw)], atol=1e-6)


@pytest.mark.parametrize("obj", OBJECTS)
def test_a_push_ends_beyond_the_gripper(world, obj):
    """The gripper stops 5 cm past the centre, so the object ends at 5 cm plus half its extent."""
    world.place(obj, (0.0, 0.0), 0.0)
    seen = world.execute_primitive(Push.towards(0.0))
    half, finger = np.ptp(obj.footprint_m[:, 0]) / 2, 0.01
    if isinstance(obj, UprightCylinder):  # it sinks in between the fingers, 3 cm apart
        half = math.sqrt(half**2 - 0.015**2)
    assert seen.effect[-1, 0] == pytest.approx(0.05 + finger + half, abs=0.003)
    assert abs(seen.effect[-1, 1]) < 0.004
    assert seen.tracking_error_m < 1e-3
    assert np.abs(seen.effect[: 301 // 2, :2]).max() < 1e-4  # nothing moves before contact


@pytest.mark.parametrize("obj", OBJECTS)
@pytest.mark.parametrize("xy", [(0.0, 0.0), (0.21, -0.33)])
def test_camera_measures_the_object(world, obj, xy):
    world.place(obj, xy, 0.5)
    depth, mask = world.depth_image()
    pixel = CROP_WIDTH_M / IMAGE_PIXELS
    true_area = obj.volume_m3 / obj.height_m
    # The renderer draws a cylinder 0.9 mm larger than it is.
    assert mask.sum() * pixel**2 == pytest.approx(true_area, rel=0.06)
    seen_height = np.median(depth.max() - depth[mask > 0.5])
    assert seen_height == pytest.approx(obj.height_m, abs=1e-3)
    at = np.arange(IMAGE_PIXELS) - 23.5
    centre = np.array([mask.sum(axis=0) @ at, -(mask.sum(axis=1) @ at)]) / mask.sum() * pixel
    assert np.hypot(*centre) < 0.0002
    # The rim is not jagged: pixels there are covered in part.
    assert ((mask > 0) & (mask < 1)).sum() > 20


def test_marks_and_obstacles_are_in_pictures_only_and_obstacles_are_felt(world):
    world.place(OBJECTS[0])
    seen, plain = world.depth_image(), world.picture()
    world.mark((0.05, 0.0), (0.0, 0.45, 0.7), scale=1.3)
    picture = world.picture()
    assert (picture != plain).any()
    obstacles = Obstacle.box((0.14, 0.0), (0.02, 0.2)), Obstacle.disc((0.0, 0.15), 0.03)
    world.set_obstacles(obstacles)
    np.testing.assert_array_equal(world.depth_image(), seen)
    assert (world.picture() != picture).any()
    world.execute_primitive(Push.towards(0.0))
    assert not world.obstacles.touched
    world.execute_primitive(Push.towards(0.0))
    assert (0, "object") in world.obstacles.touched
    assert not any(k == 1 for k, _ in world.obstacles.touched)
    with pytest.raises(ValueError, match=r"obstacles\[0\] lies on the object"):
        world.set_obstacles([Obstacle.disc(world.object_pose()[:2], 0.02)])
    assert world.obstacles.all == obstacles
    world.place(OBJECTS[0])
    assert world.obstacles.all == ()


def test_unreachable_raises_or_is_recorded_and_moves_nothing(world):
    world.place(OBJECTS[0], (0.45, 0.5), 0.0)
    before = world.object_state()
    with pytest.raises(UnreachableError, match="cannot reach"):
        world.execute_primitive(Push(math.pi / 4), approach=True)
    seen = world.execute_primitive(Push(math.pi / 4), record_unreachable=True)
    assert not seen.reached
    assert not seen.effect.any()
    assert world.object_state() == before


def test_bad_input_is_named(world):
    world.place(OBJECTS[0])
    for act, words in (
        (lambda w: w.execute_primitive(LEVER), r"'lever_up' needs the tool 'screwdriver'.*place\("),
        (lambda w: Prism(STAR, 0.05), "convex polygon"),
        (lambda w: Obstacle(tuple(STAR)), "one point .a disc. or go counter-clockwise"),
        (lambda w: Obstacle.disc((0.0, 0.0), 0.0), "Obstacle.radius_m must lie in"),
        (lambda w: Obstacle.box((0.7, 0.0), (0.1, 0.1)), "lies off the table"),
        (lambda w: TBlock(height=math.nan), "TBlock.height must be"),
        (lambda w: w.reset() or w.observe(), r"call place\(\.\.\.\) first"),
    ):
        with pytest.raises((RuntimeError, TypeError, ValueError), match=words):
            act(world)


def test_a_shoved_object_moves_turns_and_rests(world):
    obj = Cuboid(0.06, 0.04, 0.07)
    world.place(obj, (0.05, 0.02), 0.3, config=WorldConfig(com_offset_m=(0.01, 0.0, 0.0)))
    z = world.object_state()[2]
    world.shove(0.1, -0.05, 0.5)
    np.testing.assert_allclose(world.object_pose(), (0.15, -0.03, 0.8), atol=5e-4)
    assert abs(world.object_state()[2] - z) < 5e-4
    with pytest.raises(ValueError, match="off the table"):
        world.shove(0.0, 5.0)
    np.testing.assert_allclose(world.object_pose(), (0.15, -0.03, 0.8), atol=5e-4)


@pytest.mark.parametrize("obj", [*OBJECTS, LyingCylinder(0.05, 0.07), Sphere(0.06)])
def test_what_is_held_stays_in_the_hand_and_is_put_down(world, obj):
    """Held by friction alone, it slips by up to 3 mm in 10 s."""
    world.place(obj, (0.05, 0.1))
    world.execute_primitive(Grasp(), 0.7, approach=True)
    held, heights = world.object_state(), []
    assert held[2] > obj.height_m / 2 + 0.05
    world.settle(10.0)
    assert world.object_state()[2] == pytest.approx(held[2], abs=2e-4)
    world.on_step = lambda world: heights.append(world.object_state()[2])
    world.park()
    assert -np.diff(heights).min() * 240 < 0.4  # m/s; a fall from there has 1.3
    assert math.dist(held[:2], world.object_state()[:2]) < 0.001
    assert world.object_state()[2] == pytest.approx(obj.height_m / 2, abs=5e-4)


@pytest.mark.parametrize("yaw_rad", [0.0, math.pi / 4])
def test_what_rolls_on_a_level_table_comes_to_rest(world, yaw_rad):
    """Without rolling friction, Bullet's cylinders gain speed."""
    roll_on = []
    for braked in (True, False):
        world.place(LyingCylinder(0.08, 0.05), yaw_rad=yaw_rad)
        speed = -0.1 * math.sin(yaw_rad), 0.1 * math.cos(yaw_rad), 0.0
        world.client.resetBaseVelocity(world.placed.body, speed)
        world.settle(2.0) if braked else world.arm.wait(480)
        before = world.object_pose()[:2]
        world.arm.wait(120)
        roll_on.append(math.dist(before, world.object_pose()[:2]))
    assert roll_on[0] < 1e-4
    assert roll_on[1] > 0.05


def test_a_world_that_is_closed_or_forgotten_is_disconnected():
    one, other = Tabletop(), Tabletop()
    numbers = one.client._client, other.client._client
    one.close()
    one.close()
    del other
    gc.collect()
    assert not any(pybullet.isConnected(number) for number in numbers)
    with pytest.raises(RuntimeError, match="this world is closed; make a new Tabletop"):
        one.place(Cuboid(0.06, 0.05, 0.05))


@pytest.mark.parametrize("primitive", EXAMPLES, ids=lambda p: p.name)
def test_a_path_is_smooth_and_passes_its_keyframes(primitive):
    phase = np.linspace(0, 1, 3751)
    path = primitive.path(phase)
    assert np.abs(np.diff(path[:, :3], axis=0)).max() * 1000 < 0.75  # m/s
    for segment, begin in zip(primitive.segments, primitive.segment_phases, strict=False):
        np.testing.assert_allclose(primitive.path(begin)[0], segment.start[:5], atol=1e-9)
    assert sum(segment.seconds for segment in primitive.segments) == pytest.approx(3.75)


def test_push_path_is_the_papers_and_the_lever_turns_about_the_far_edge():
    push = Push(theta=0.7)
    path = push.path(np.linspace(0, 1, 301))[:, :2]
    np.testing.assert_allclose(path[0], 0.2 * unit_vector(0.7), atol=1e-12)
    np.testing.assert_allclose(path[-1], -0.05 * unit_vector(0.7), atol=1e-12)
    assert np.hypot(*np.diff(path, axis=0).T).argmax() in (149, 150)
    assert min_jerk(np.array([0.0, 0.5, 1.0])).tolist() == [0.0, 0.5, 1.0]
    assert Push.towards(0.4).direction_rad == pytest.approx(0.4)
    lever = LeverUp(-0.08, 0.0, 0.0, 0.16)
    path = lever.path(np.linspace(lever.segment_phases[1], 1, 50))
    edge = np.array([path[0, 0] + 0.16, 0, path[0, 2]])
    np.testing.assert_allclose(np.linalg.norm(path[:, :3] - edge, axis=1), 0.16, atol=1e-9)
    raised = math.asin((path[-1, 2] - path[0, 2]) / 0.16)
    assert math.degrees(raised) == pytest.approx(65)


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


def _seen(world, obj, yaw=0.3, xy=(0.0, 0.0), **config):
    world.place(obj, xy, yaw, config=WorldConfig(**config))
    return world.observe()


@pytest.mark.parametrize("category", CATEGORIES.values(), ids=lambda f: f.category)
def test_objects_rest_where_they_are_placed_and_round_tops_look_rollable(world, category):
    rng = np.random.default_rng(7)
    for _ in range(10):
        obj, yaw = category.sample(rng), rng.uniform(-math.pi, math.pi)
        image, before = _seen(world, obj, yaw, (0.1, -0.2)).image, world.object_state()[:3]
        world.arm.wait(120)
        np.testing.assert_allclose(world.object_state()[:3], before, atol=4e-4)
        assert not world.placed.fell()
        assert world.placed.rolls() == obj.rollable == (category in (LyingCylinder, Sphere))
        assert perception.looks_rollable(image) == obj.rollable
        assert perception.object_height_m(image) == pytest.approx(obj.height_m, abs=0.003)
        if category is LyingCylinder:
            off = math.remainder(perception.long_axis_rad(image) - yaw, math.pi)
            assert abs(math.degrees(off)) < 2


def test_a_fallen_cylinder_is_known_to_roll(world):
    """Pushed above its centre, a slender cylinder topples."""
    high = WorldConfig(tip_offset_m=0.06, table_friction=1.0)
    world.place(UprightCylinder(0.034, 0.11), config=high)
    before = world.depth_image()
    assert not world.placed.rolls()
    assert not perception.looks_rollable(before)
    seen = world.execute_primitive(Push.towards(0.0))
    assert (seen.fell, seen.rolls, world.placed.fell(), world.placed.rolls()) == (True,) * 4
    after = world.depth_image()
    assert perception.looks_fallen(before, after)
    assert perception.looks_rollable(after)
    assert not perception.looks_fallen(before, before)


@pytest.mark.parametrize("obj", [Cuboid(0.06, 0.05, 0.05), Sphere(0.06), LyingCylinder(0.07, 0.05)])
def test_a_kinect_finds_the_object_anywhere(world, obj):
    rng = np.random.default_rng(9)
    errors = []
    for k in range(12):
        xy = rng.uniform([-0.3, -0.5], [0.5, 0.5])
        observation = _seen(world, obj, 0.4, tuple(xy), camera="kinect", noise_seed=k)
        errors.append(math.dist(observation.xy_m, xy))
        height = 1.0 - observation.image[0][observation.image[1] > 0]
        assert np.quantile(height, 0.9) == pytest.approx(obj.height_m, abs=0.012)
    assert 0.0001 < np.median(errors) < 0.003
    assert max(errors) < 0.008


@pytest.mark.parametrize(
    ("camera", "n_images", "spread_deg"), [("ideal", 1, 0.25), ("kinect", 8, 0.5)]
)
@pytest.mark.parametrize("category", CATEGORIES)
def test_turns_are_seen_between_two_images(world, category, camera, n_images, spread_deg):
    """Within five times the measured spread; for prisms 0.5° (ideal) and 1.2° (Kinect).

    A cuboid, symmetric under 180°, is assumed to have turned within some 30° of what is expected.
    """
    rng, spread_deg = np.random.default_rng(17), spread_deg * (2.2 if category == "prism" else 1)
    for _ in range(3):
        obj, turn = CATEGORIES[category].sample(rng), rng.uniform(-math.pi, math.pi)
        images = []
        for yaw in (0.4, 0.4 + turn):
            xy, seed = tuple(rng.uniform(-0.12, 0.12, 2)), int(rng.integers(2**31))
            _seen(world, obj, yaw, xy, camera=camera, noise_seed=seed)
            images.append(np.mean([world.observe().image for _ in range(n_images)], axis=0))
        found = perception.turn_between(*images, turn + rng.uniform(-0.5, 0.5))
        if not CATEGORIES[category].has_yaw:
            assert found is None
            continue
        seen, std = found
        off = math.degrees(abs(math.remainder(seen - turn, 2 * math.pi)))
        assert off < max(5 * spread_deg, 3 * math.degrees(std))
        assert math.degrees(std) < 5
    if CATEGORIES[category].has_yaw:
        same = perception.turn_between(images[0], images[0])
        assert same == pytest.approx((0.0, 0.0), abs=1e-3)


def test_an_outline_is_found_to_a_fraction_of_a_pixel(world):
    prism = Prism(((0.0, 0.0), (0.07, 0.0), (0.0, 0.08)), 0.05)
    corners = perception.outline_of(_seen(world, prism, yaw=0.0).image)
    with pytest.raises(NothingSeenError, match="image shows no object"):
        perception.outline_of(np.zeros((2, 48, 48)))
    assert len(corners) == 3
    off = np.linalg.norm(corners[:, None] - prism.footprint_m, axis=2)
    assert off.min(axis=1).max() < 0.001  # a third of a pixel
