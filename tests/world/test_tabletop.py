import gc
import math

import numpy as np
import pybullet
import pytest
from pybullet_utils.bullet_client import BulletClient

from affordlib.primitives import Grasp, LeverUp, Push
from affordlib.types import CROP_WIDTH_M, IMAGE_PIXELS, Obstacle, UnreachableError
from affordlib.world import (
    Cuboid,
    LyingCylinder,
    Prism,
    Sphere,
    Tabletop,
    UprightCylinder,
    WorldConfig,
)
from affordlib.world.robot import HOME, TOOL_LENGTH_M, inverse_kinematics, load_robot

OBJECTS = (Cuboid(0.05, 0.07, 0.06), UprightCylinder(0.06, 0.05))
LEVER = LeverUp(-0.03, 0.0, 0.0, 0.06)
STAR = tuple((0.05 * math.cos(a), 0.05 * math.sin(a)) for a in 0.8 * math.pi * np.arange(5))


def test_inverse_kinematics_agrees_with_the_description():
    client = BulletClient(pybullet.DIRECT)
    arm = load_robot(client)
    rng = np.random.default_rng(0)
    for _ in range(50):
        xyz = rng.uniform([-0.4, -0.5, 0.01], [0.4, 0.5, 0.2])
        yaw = rng.uniform(-math.pi, math.pi)
        joints = inverse_kinematics(xyz, yaw, np.array(HOME))
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


@pytest.mark.parametrize(
    ("act", "words"),
    [
        (lambda w: w.execute_primitive(LEVER), r"'lever_up' needs the tool 'screwdriver'.*place\("),
        (lambda w: w.reset() or w.observe(), r"call place\(\.\.\.\) first"),
        (lambda w: Prism(STAR, 0.05), "convex polygon"),
        (lambda w: Obstacle(tuple(STAR)), "one point .a disc. or go counter-clockwise"),
        (lambda w: Obstacle.disc((0.0, 0.0), 0.0), "Obstacle.radius_m must lie in"),
        (lambda w: Obstacle.box((0.7, 0.0), (0.1, 0.1)), "lies off the table"),
    ],
)
def test_bad_input_is_named(world, act, words):
    world.place(OBJECTS[0])
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
