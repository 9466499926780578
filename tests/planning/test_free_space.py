"""What is free of obstacles: against brute force, by execution, and for every planner."""

import math

import numpy as np
import pytest
import torch
from matplotlib.path import Path

from affordlib import planning
from affordlib.geometry import unit_vector
from affordlib.perception import adapt_to_object, outline_of
from affordlib.planning import corners_of
from affordlib.planning.effect_map import poses_along
from affordlib.planning.free_space import FAR_M, N_POSES, START_M, FreeSpace, gaps_m, hand_m, placed
from affordlib.planning.move_planner import MovePlanner
from affordlib.primitives import Drag, Grasp, Push, Rotate, min_jerk
from affordlib.types import Goal, Observation, Obstacle, Step
from affordlib.world import Cuboid, Sphere
from experiments.field_baselines import plan_cem
from tests.planning.point_robot import KnownDynamics, PointRobot, disc_image, point_skills

PLANNERS = (planning.plan_astar, planning.plan_continuous, planning.plan_gradient, plan_cem)
AT, THREE = (0.0, 0.0), planning.PlanMode(3, partial=True)
BOX = 0.5 * np.array([[0.06, 0.05], [-0.06, 0.05], [-0.06, -0.05], [0.06, -0.05]])


def drawn(rng, within_m=0.12):
    """A random disc, box or triangle."""
    at = tuple(rng.uniform(-within_m, within_m, 2))
    kind, size = rng.integers(3), rng.uniform(0.01, 0.06, 2)
    if kind == 0:
        return Obstacle.disc(at, size[0])
    if kind == 1:
        return Obstacle.box(at, tuple(2 * size), rng.uniform(0, math.pi))
    turn = rng.uniform(0, 2 * math.pi)
    corners = [at + size[0] * unit_vector(turn + a) for a in (0.0, 1.8, 4.0)]
    return Obstacle(tuple(map(tuple, corners)))


def filled(corners, step_m=0.001):
    """Points (n, 2) all over a polygon, its rim included, one every millimetre."""
    edges = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    rim = [np.linspace(a, b, 2 + math.ceil(np.hypot(*(b - a)) / step_m)) for a, b in edges]
    low, high = corners.min(axis=0), corners.max(axis=0)
    grid = np.stack(np.meshgrid(*map(np.arange, low, high, [step_m] * 2)), -1).reshape(-1, 2)
    return np.vstack([*rim, grid[Path(corners).contains_points(grid)]])


def overlaps(outline, poses, points):
    """Whether an outline covers any of the points at any of the poses."""
    return any(Path(at).contains_points(points).any() for at in placed(outline, poses))


def between(poses, n=12):
    """The poses, and n between every two of them."""
    at = np.linspace(0, len(poses) - 1, n * (len(poses) - 1) + 1)
    return np.stack([np.interp(at, np.arange(len(poses)), column) for column in poses.T], axis=1)


def test_gaps_are_those_of_brute_force():
    """Of 1,000 motions, those predicted free never overlap; few others stay farther than 3 mm."""
    rng, wrong = np.random.default_rng(0), 0
    for _ in range(1000):
        poses = np.cumsum(rng.normal(0, (0.008, 0.008, 0.05), (N_POSES, 3)), axis=0)
        one = drawn(rng, 0.09)
        gap = gaps_m([corners_of(one)], placed(BOX, poses[None])).min()
        points = filled(corners_of(one), 0.003)
        assert not (gap > 0 and overlaps(BOX, between(poses, 6), points))
        wrong += gap < -0.003 and not overlaps(BOX, between(poses, 6), points)
    assert wrong < 10


def test_gaps_are_distances_along_the_normals_of_edges():
    here = placed(BOX, np.zeros((1, 2, 3)))
    for gap in (-0.01, 0.004, 2 * FAR_M):
        wall = corners_of(Obstacle.box((0.03 + gap + 0.01, 0.0), (0.02, 0.3)))
        assert gaps_m([wall], here, FAR_M)[0, 0] == pytest.approx(min(gap, FAR_M), abs=1e-12)
    thin = corners_of(Obstacle.box((0.1, 0.0), (0.005, 0.3)))
    jump = placed(BOX, np.array([[[0.0, 0.0, 0.0], [0.2, 0.0, 0.0]]]))
    assert gaps_m([thin], jump)[0, 0] < 0  # no pose touches it, the way does
    disc = corners_of(Obstacle.disc(AT, 0.04))
    assert (np.hypot(*disc.T) >= 0.04).all()


@pytest.mark.parametrize("kind", [Push, Drag])
def test_the_hand_is_checked_too(kind):
    """A post beside the object, in the way of the fingers only."""
    image = disc_image(radius_m=0.025)
    action = Push.towards(0.0) if kind is Push else Drag(0.0, grip_yaw=0.0)
    poses = np.zeros((1, N_POSES, 3))
    poses[0, :, 0] = np.linspace(0, 0.04, N_POSES)
    at = {Push: (-0.15, 0.03), Drag: (0.0, 0.075)}[kind]
    for xy, free in ((at, False), ((at[0], at[1] + 0.03), True)):
        space = FreeSpace([Obstacle.disc(xy, 0.008)], image, AT)
        spare = space.spare_m(action, np.zeros(1), np.ones(1), poses)
        assert (spare[0] > 0) == free
    assert hand_m(Push.towards(0.0))[:, 1].max() == pytest.approx(0.027)


@pytest.mark.parametrize("action", [Grasp(), Rotate()])
def test_the_open_hand_needs_room(action):
    step = Step(action, 1.0, (0.1, 0.0), np.zeros((2, 2)))
    post = Obstacle.disc((0.1, action.opening_m / 2 + 0.01), 0.01)
    image = disc_image()
    near = FreeSpace([post], image, AT)
    assert not near.is_free(step)
    np.testing.assert_array_equal(near.outline_m, outline_of(image))
    assert FreeSpace([Obstacle.disc((0.1, 0.15), 0.01)], image, AT).is_free(step)


def problem(goal, obstacles, mode=THREE, radius_m=0.02):
    effects = planning.EffectMap(KnownDynamics(), disc_image(radius_m=radius_m))
    return planning.PlanningProblem(AT, goal, effects, mode, obstacles=tuple(obstacles))


def test_an_obstacle_where_none_can_be_is_refused():
    fine = Obstacle.disc((-0.3, 0.3), 0.02)
    for obstacle, says in (
        (Obstacle.disc((0.02, 0.0), 0.02), r"obstacles\[1\] lies on the object at"),
        (Obstacle.box((0.12, 0.0), (0.05, 0.05)), r"obstacles\[1\] lies on the goal at"),
        (Obstacle.disc((0.2, 0.2), 0.02, 0.2), "the palm would touch what is higher than 13 cm"),
    ):
        with pytest.raises(ValueError, match=says):
            problem(Goal((0.12, 0.0)), [fine, obstacle])


@pytest.mark.filterwarnings("ignore:none of 5 random starts")
@pytest.mark.parametrize("plan", PLANNERS)
def test_no_plan_passes_a_wall(plan):
    """Random obstacles: neither disc nor hand touches them at any of many poses of any plan."""
    rng, n_steps, bent = np.random.default_rng(3), 0, 0
    pushed = 0.02 * np.array([*map(unit_vector, np.linspace(0, 2 * math.pi, 40))])
    for _ in range(12):
        goal = Goal(tuple(rng.uniform(-0.15, 0.15, 2)), 0.01)
        obstacles = [drawn(rng, 0.2) for _ in range(3)]
        try:
            posed = problem(goal, obstacles)
        except ValueError:
            continue
        points = np.vstack([filled(corners_of(one), 0.002) for one in obstacles])
        found, here = plan(posed), np.zeros(2)
        for step in found.steps:
            n_steps += 1
            path = np.insert(step.predicted_path_xy_m, 2, 0.0, axis=1)
            assert not overlaps(pushed, between(path, 4), points)
            angle = step.primitive.direction_rad
            travel = 0.25 * min_jerk(np.linspace(0, step.stop_phase, 80)) - 0.2
            hand = here + travel[:, None] * unit_vector(angle)
            poses = np.column_stack([hand, np.full(80, angle)])
            assert not overlaps(hand_m(step.primitive), poses, points)
            here = np.array(step.predicted_end_xy_m)
        free = plan(problem(goal, []))
        bent += [s.primitive for s in free.steps] != [s.primitive for s in found.steps]
    assert n_steps > 4
    assert bent > 3


def corridor(half_m=0.033, length_m=0.3):
    return [Obstacle.box((0.0, s * (half_m + 0.01)), (length_m, 0.02)) for s in (-1, 1)]


@pytest.mark.parametrize("plan", [planning.plan_astar, planning.plan_continuous])
def test_in_a_corridor_a_push_must_be_able_to_stop(plan):
    goal = Goal((0.05, 0.0), 0.005)
    modes = planning.PlanMode(4, partial=True), planning.PlanMode(4, partial=False)
    partial, full = (plan(problem(goal, corridor(), mode=mode)) for mode in modes)
    assert partial.predicted_distance_m < 0.005 < 0.02 < full.predicted_distance_m


def test_a_way_that_is_closed_is_unreachable_and_nothing_is_touched():
    bay = [*corridor(0.05, 0.12), Obstacle.box((0.07, 0.0), (0.02, 0.14))]
    bay.append(Obstacle.box((-0.07, 0.0), (0.02, 0.14)))
    robot = PointRobot(obstacles=tuple(bay))
    found = planning.run_closed_loop(robot, Goal((0.2, 0.0), 0.01), point_skills())
    assert (found.status, found.steps) == ("unreachable", ())
    assert "past the obstacles" in found.message
    robot.obstacles = (Obstacle.disc((0.2, 0.0), 0.03),)
    found = planning.run_closed_loop(robot, Goal((0.2, 0.0), 0.01), point_skills())
    assert "obstacles[0] lies on the goal" in found.message


def test_walls_that_are_long_or_appear_are_gone_round():
    robot = PointRobot(obstacles=(Obstacle.box((0.15, 0.05), (0.03, 0.4)),))
    assert planning.run_closed_loop(robot, Goal((0.25, 0.05), 0.005), point_skills()).reached
    wall = (Obstacle.box((0.13, 0.0), (0.02, 0.1)),)

    def before(robot):
        if len(robot.executed) == 1:
            robot.obstacles = wall

    goal = Goal((0.22, 0.0), 0.005)
    robots = PointRobot(too_far=0.0), PointRobot(too_far=0.0, before=before)
    straight, round_it = (planning.run_closed_loop(r, goal, point_skills()) for r in robots)
    assert (straight.status, round_it.status) == ("reached", "reached")
    assert len(round_it.plans) > len(straight.plans)
    paths = [between(path, 30) for path in round_it.object_paths_xy_m]
    assert not any(Path(corners_of(wall[0])).contains_points(path).any() for path in paths)


def test_of_what_is_predicted_to_pass_little_touches(world, skills):
    """Executed pushes beside an obstacle at the margin: a sample of `experiments.obstacles`."""
    rng, touched, n = np.random.default_rng(8), 0, 0
    for _ in range(12):
        obj = Cuboid.sample(rng)
        world.place(obj, AT, rng.uniform(-3, 3))
        effects = planning.EffectMap(skills.model(Push), world.depth_image())
        angle = rng.uniform(-3, 3)
        at = torch.tensor([angle]).double()
        poses = poses_along(effects, np.zeros((1, 3)), at, torch.ones(1).double(), N_POSES)
        # A disc at the margin from what the outline sweeps, in a random direction.
        away, middle = unit_vector(rng.uniform(-3, 3)), poses[0, -1, :2] * rng.uniform(0.4, 1)
        swept, ways = placed(effects.outline_m, poses), np.arange(0.0, 0.15, 0.0005)
        discs = (Obstacle.disc(tuple(middle + far * away), 0.015) for far in ways)
        one = next((d for d in discs if gaps_m([corners_of(d)], swept).min() > 0.004), None)
        if one is None:
            continue
        space = FreeSpace([one], effects.image, AT, effects.outline_m)
        if space.spare_m(Push.towards(angle), np.array([angle]), np.ones(1), poses)[0] < 0:
            continue
        world.set_obstacles([one])
        world.execute_primitive(Push.towards(angle), approach=True)
        touched, n = touched + bool(world.obstacles.touched), n + 1
    assert n >= 6
    assert touched == 0


def test_an_object_beside_an_obstacle_may_leave_it():
    wall, goal = Obstacle.box((-0.0388, 0.02), (0.02, 0.02)), Goal((0.03, 0.12), 0.005)
    posed = problem(goal, [wall], radius_m=0.03)
    assert posed.free_space.least_m < START_M
    assert planning.plan_continuous(posed).reaches_goal


@pytest.mark.parametrize(("grip_yaw", "free"), [(0.0, False), (math.pi / 2, True)])
def test_a_planned_drag_is_checked_again_with_its_own_grip(grip_yaw, free):
    """A post is in the way of the fingers, if they close along y."""
    skills = planning.Skills({"drag": KnownDynamics()})
    moves = MovePlanner(PointRobot(), skills, planning.plan_continuous, planning.PlanMode(1, True))
    seen = Observation(AT, disc_image(), obstacles=(Obstacle.disc((0.0, 0.075), 0.008),))
    step = Step(Drag(0.0, grip_yaw=grip_yaw), 0.9, (0.05, 0.0), np.zeros((2, 2)))
    assert moves.passes(step, seen) == free


def test_beside_obstacles_a_ball_is_dragged_on_with_the_hand_as_planned(world, skills, monkeypatch):
    """A ball looks the same at every yaw, so images do not tell at which the plan was checked."""
    world.place(Sphere(0.05), obstacles=[Obstacle.disc((0.2, 0.2), 0.02)])
    planned = adapt_to_object(Drag.towards(0.0), world.depth_image()).grip_yaw
    monkeypatch.setattr(planning.closed_loop, "SURPRISE_M", 0.05)
    first, second, *_ = planning.run_closed_loop(world, Goal((0.15, 0.0)), skills).steps
    assert first.primitive.grip_yaw is None
    assert abs(math.sin(second.primitive.grip_yaw - planned)) < 0.02
