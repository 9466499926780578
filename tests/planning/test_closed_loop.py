"""Closed loop and execution: all endings, termination, and vetoes before motion."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from affordlib import planning
from affordlib.perception import adapt_to_object
from affordlib.planning import execute_plan, plan_astar, plan_continuous, run_closed_loop
from affordlib.planning.closed_loop import DISPLACED_M
from affordlib.planning.grasp_rotate import GRIPPER_YAWS_RAD
from affordlib.planning.skills import Reachability
from affordlib.primitives import Drag, Grasp, Push, Rotate
from affordlib.types import Goal, Plan, Step, UnreachableError
from affordlib.world import Cuboid, LyingCylinder, Sphere, UprightCylinder, WorldConfig
from affordlib.world.execution import put_down
from affordlib.world.objects import PlacedObject
from experiments.closed_loop import Trial, _stays_feasible, sample_disturbance
from experiments.disturbances import Disturbance, DisturbanceSchedule
from experiments.planning import corrected
from tests.planning.point_robot import PointRobot, point_skills, problem_of

PLANNERS = pytest.mark.parametrize("planner", [plan_astar, plan_continuous, planning.plan_gradient])
EXACT_M = 0.002
BOX, TUBE, BALL = Cuboid(0.06, 0.05, 0.05), UprightCylinder(0.05, 0.07), Sphere(0.06)
TURN, LIFT = {"turn_rad": 0.6}, {"height_m": 0.1}
TASKS = [(BOX, {}), (BALL, {}), (BOX, TURN), (BALL, TURN), (LyingCylinder(0.07, 0.05), TURN)]
TASKS += [(TUBE, LIFT), (BOX, TURN | LIFT)]
SHIFTS = [((0.0,), 1, "unconfirmed"), ((0.02,), 2, "unconfirmed")]
SHIFTS += [((0.02, 0.02), 2, "gave_up"), ((None,), 1, "reached")]


def loop(robot, goal, skills=None, planner=plan_continuous, ends=None, **config):
    """Run a closed loop, by default with models of a `PointRobot` without its overshoot.

    ends: the status that it must have at its end, if not any.
    """
    config = planning.ClosedLoopConfig(**config)
    went = run_closed_loop(robot, goal, skills or point_skills(), planner, config=config)
    assert ends in (None, went.status), went.message
    assert went.reached == (went.status == "reached")
    return went


def disturbed(world, goal, skills, *disturbances, ends="reached"):
    schedule = DisturbanceSchedule(world, goal, disturbances)
    return loop(schedule, schedule.current_goal, skills, ends=ends), schedule


@PLANNERS
def test_every_planner_brings_a_pose_about(planner):
    robot, goal = PointRobot(), Goal((0.21, -0.06), 0.01, turn_rad=1.3, height_m=0.1)
    assert isinstance(robot, planning.Robot)
    went = loop(robot, goal, planner=planner, ends="unconfirmed")  # what the hand holds is not seen
    assert went.message.endswith("the position and orientation computed, not observed")
    kinds = [type(step.primitive) for step in went.steps]
    assert kinds == [Push] * (len(kinds) - 3) + [Rotate, Rotate, Grasp]  # in sweeps of 60°
    assert robot.executed == list(went.steps)
    assert went.distance_m == goal.distance_m(robot.xy_m) <= 0.01
    assert went.errors["orientation"].left == pytest.approx(1.5 - robot.yaw_rad)
    assert went.end_pose[2] == pytest.approx(robot.yaw_rad - 0.2)
    assert abs(went.errors["orientation"].left) < math.radians(2)
    assert abs(went.errors["height"].left) < 0.003
    assert "from the goal after" in went.message
    assert len(went.steps) == len(went.object_paths_xy_m) <= 8 + 6
    # It plans in its mode, and goes as near as asked; if the object is at the goal, nothing moves.
    went = loop(PointRobot(), Goal((0.15, 0.0), EXACT_M), mode="single_partial", ends="reached")
    assert {len(plan.steps) for plan in went.plans} == {1}
    for within_m, n_pushes in ((0.01, 1), (0.001, 2)):
        assert len(loop(PointRobot(), Goal((0.08, 0.0), within_m)).steps) == n_pushes
    assert loop(robot, Goal(robot.xy_m, EXACT_M)).steps == ()


@pytest.mark.parametrize("pose", [{}, {"turn_rad": -0.5}, {"height_m": 0.1}])
def test_no_more_actions_than_were_allowed(pose):
    for limit in (0, 1):
        far = 0.3 * (limit if pose else 1)
        went = loop(PointRobot(), Goal((far, 0.0), EXACT_M, **pose), max_actions=limit)
        assert (went.status, len(went.steps)) == ("gave_up", limit), went.message
    assert "after 1 action:" in went.message


def test_an_object_that_always_escapes_ends_the_loop():
    robot = PointRobot()
    away = {"on_action": lambda *_: setattr(robot, "xy_m", (0.0, 0.0))}
    went = loop(robot, Goal((0.06, 0.0), EXACT_M), **away, ends="gave_up")
    assert 5 < len(went.steps) <= 4 * 5


@pytest.mark.parametrize(("n_steps", "ends_mm"), [(0, "100.0"), (1, "99.9")])
def test_a_planner_that_does_not_help_is_given_up_and_it_is_said_why(n_steps, ends_mm):
    def planner(problem):
        step = Step(Push(math.pi), 0.6, (0.0001, 0.0), np.zeros((2, 2)))
        return Plan(problem.goal, problem.start_xy_m, (step,) * n_steps, "lazy", False, 0.0)

    went = loop(PointRobot(), Goal((0.1, 0.0), EXACT_M), planner=planner)
    assert (went.status, went.steps) == ("gave_up", ())
    assert f"the best ends {ends_mm} mm from it, and planning again" in went.message


def test_nothing_is_reached_that_the_camera_cannot_tell():
    class Blurred(PointRobot):
        def observe(self):
            return replace(super().observe(), std_m=0.0005)

    went = loop(Blurred(), Goal((0.08, 0.0), 0.0005), ends="unconfirmed")
    assert went.message.endswith("the position observed less exactly than required")
    loop(Blurred(), Goal((0.08, 0.0), 0.02), ends="reached")


@pytest.mark.parametrize("change", [{"xy_m": (0.75, 0.0)}, {"visible": False}])
def test_an_object_that_is_gone_is_lost(change):
    robot = PointRobot()
    went = loop(robot, Goal((0.2, 0.0)), on_action=lambda *_: vars(robot).update(change))
    assert (went.status, len(went.steps)) == ("lost", 1)


@PLANNERS
def test_a_goal_that_moves_is_followed(planner):
    goal, robot = Goal((0.1, 0.0), EXACT_M, turn_rad=-0.4), PointRobot(yaw_rad=0.0)
    goals = [Goal((0.1, 0.08), EXACT_M, turn_rad=turn) for turn in (-0.4, -0.8, -1.2)]

    def move(plan, n):
        nonlocal goal
        off = abs(math.remainder(goal.turn_rad - robot.yaw_rad, 2 * math.pi))
        if goals and (off < 0.05 or goal.xy_m == (0.1, 0.0)):
            goal = goals.pop(0)

    went = loop(robot, lambda: goal, on_action=move, planner=planner, ends="reached")
    assert (goals, went.goal) == ([], goal)
    assert goal.distance_m(robot.xy_m) < EXACT_M
    with pytest.raises(TypeError, match="goal must be a Goal"):
        loop(robot, lambda: (0.1, 0.1))


def test_what_somebody_has_set_rolling_is_waited_for():
    robot = PointRobot()

    def knock(plan, n):
        if n == 1:
            x, y = robot.xy_m
            robot.xy_m, robot.velocity = (x, y + DISPLACED_M + 0.01), (0.0, 0.2)

    went = loop(robot, Goal((0.16, 0.0), EXACT_M), on_action=knock, ends="reached")
    assert robot.velocity[1] < 0.01
    assert went.seen_xy_m[1][1] > DISPLACED_M + 0.09


def test_it_acts_on_the_mean_of_the_images_that_it_planned_with():
    rng, acted_on = np.random.default_rng(0), []

    class Noisy(PointRobot):
        def observe(self):
            seen = super().observe()
            return replace(seen, xy_m=(seen.xy_m[0] + rng.normal(0, 0.002), seen.xy_m[1]))

        def execute(self, step, seen=None):
            acted_on.append(seen.xy_m)
            return super().execute(step, seen)

    went = loop(Noisy(), Goal((0.1, 0.0), 0.01), n_images=4)
    assert [] != acted_on == list(went.seen_xy_m[: len(went.steps)])


def test_a_veto_is_remembered_and_another_plan_made():
    refused = []

    def refuses(primitive, at):
        refused.append(primitive.direction_rad)
        return abs(refused[-1] - refused[0]) < 0.05

    went = loop(PointRobot(refuses=refuses), Goal((0.1, 0.05), EXACT_M), ends="reached")
    assert abs(went.steps[0].primitive.direction_rad - refused[0]) > 0.05


def test_what_the_arm_cannot_do_is_refused_before_any_motion():
    robot = PointRobot((0.5, 0.3), refuses=lambda primitive, at: at[1] > 0.45)
    went = loop(robot, Goal((0.5, 0.62), EXACT_M), ends="unreachable")
    assert "the position (0.500, 0.620) m: the arm cannot bring it there" in went.message
    robot = PointRobot((0.5, 0.3))
    went = loop(robot, Goal((0.5, 0.69)))
    assert (went.status, robot.executed) == ("unreachable", [])
    assert "too near the rim" in went.message
    hands = PointRobot(refuses=lambda primitive, at: primitive.name != "push")
    went = loop(hands, Goal((0.0, 0.0), height_m=0.1))
    assert (went.status, went.steps) == ("unreachable", ())
    assert went.message.endswith("left: the arm cannot grasp at (0.000, 0.000) m")
    tried = []
    hands.refuses = lambda primitive, at: tried.append(primitive.grip_yaw) or len(tried) < 3
    went = loop(hands, Goal((0.0, 0.0), turn_rad=0.5), ends="reached")
    assert went.steps[0].primitive.grip_yaw == tried[-1]
    assert len(set(tried)) == 3


def test_a_far_goal_is_reached_round_what_the_arm_cannot_do():
    class Learned(Reachability):
        def probability(self, primitive, xy_m, direction_rad=None):
            return 1.0 - ((xy_m[:, 0] > 0.1) & (np.abs(xy_m[:, 1]) < 0.06))

    robot, skills = PointRobot((0.2, -0.3)), replace(point_skills(), reachability=Learned(["push"]))
    went = loop(robot, Goal((0.2, 0.25), EXACT_M), skills, max_actions=20, ends="reached")
    assert min(path[0, 0] for path in went.object_paths_xy_m) < 0.1


@pytest.mark.parametrize(("shifts_m", "lifts", "status"), SHIFTS)
def test_what_is_held_aside_of_its_goal_is_put_down_and_lifted_there(shifts_m, lifts, status):
    """The goal moves by this much after each lift, or requires no height any longer (None)."""
    goal, left = Goal((0.06, 0.0), EXACT_M, height_m=0.1), list(shifts_m)

    def move_goal(plan, n):
        nonlocal goal
        if plan.steps[-1].primitive.name == "grasp" and left:
            by_m = left.pop(0)
            new = {"height_m": None} if by_m is None else {"xy_m": (goal.xy_m[0] + by_m, 0.0)}
            goal = replace(goal, **new)

    went = loop(PointRobot(), lambda: goal, on_action=move_goal, ends=status)
    assert sum(isinstance(step.primitive, Grasp) for step in went.steps) == lifts
    aside_m = shifts_m[-1] if status == "gave_up" else 0.0
    assert went.distance_m == pytest.approx(aside_m, abs=0.005)
    assert ("height" in went.errors) == (status != "reached")
    assert status == "reached" or went.errors["height"].is_met()


@pytest.mark.parametrize("sees_yaw", [True, False])
def test_a_turn_that_nobody_sees_is_reckoned_by_the_hand_and_said_to_be(sees_yaw):
    """The image of a disc does not show its rotation."""
    robot = PointRobot(sees_yaw=sees_yaw)
    status = "reached" if sees_yaw else "unconfirmed"
    went = loop(robot, Goal((0.1, 0.0), EXACT_M, turn_rad=1.7), ends=status)
    assert robot.yaw_rad == pytest.approx(0.2 + 1.7, abs=math.radians(2))
    assert went.end_pose[2] == pytest.approx(robot.yaw_rad - 0.2, abs=math.radians(0.2))
    assert went.reckoned == (() if sees_yaw else ("orientation",))
    lifted = loop(robot, Goal(robot.xy_m, height_m=0.1), ends="unconfirmed")
    assert lifted.reckoned == ("position", "orientation")


@pytest.mark.parametrize(("shove_m", "kept"), [(0.0, True), (0.05, False)])
def test_the_grip_is_kept_unless_somebody_displaces_the_object(shove_m, kept):
    robot, goal = PointRobot(), Goal((0.0, 0.0), EXACT_M, turn_rad=0.5, height_m=0.1)

    def displace(plan, n):
        nonlocal goal
        if n == 1:
            goal, robot.xy_m = replace(goal, xy_m=(shove_m, 0.0)), (shove_m, 0.0)

    rotate, grasp = loop(robot, lambda: goal, on_action=displace).steps
    hand_rad = rotate.primitive.path(rotate.stop_phase)[0, 3]
    assert grasp.primitive.grip_yaw == (pytest.approx(hand_rad) if kept else GRIPPER_YAWS_RAD[0])


@pytest.mark.parametrize(("slips", "status"), [(1, "unconfirmed"), (2, "gave_up")])
def test_a_slip_is_noticed_by_the_fingers(slips, status):
    went = loop(PointRobot(slips=slips), Goal((0.0, 0.0), height_m=0.1), ends=status)
    assert [step.primitive.name for step in went.steps] == ["grasp"] * 2
    left_m = 0.0 if status == "unconfirmed" else 0.1
    assert went.errors["height"].left == pytest.approx(left_m, abs=0.003)


def test_corrections_bring_it_nearer_and_stop_where_enough():
    goal, tried = Goal((0.1, 0.04)), []

    def replan(image, xy, goal):
        tried.append(goal.tolerance_m)
        return plan_continuous(problem_of(point_skills().model(Push), image, xy, goal))

    robot = PointRobot()
    plan = plan_astar(problem_of(point_skills().model(Push), robot.observe().image, (0, 0), goal))
    open_loop = execute_plan(PointRobot(), plan)
    closed = corrected(robot, execute_plan(robot, plan), replan, 2)
    assert closed.distance_m == goal.distance_m(robot.xy_m) < 0.5 * open_loop.distance_m
    assert len(plan.steps) < len(closed.object_paths_xy_m) <= len(plan.steps) + 2
    assert set(tried) == {0.0003}
    none = Plan(goal, goal.xy_m, (), "none", True, 0.0)
    there = PointRobot(plan.goal.xy_m)
    assert corrected(there, execute_plan(there, none), replan, 2).object_paths_xy_m == ()


def test_what_was_done_before_the_arm_refused_is_kept():
    class Refuses(PointRobot):
        def execute(self, step, seen=None):
            if step.primitive.name == "grasp":
                raise UnreachableError("out of reach")
            return super().execute(step, seen)

    robot, path = Refuses(), np.zeros((2, 2))
    can, cannot = Step(Push(math.pi), 1.0, (0.09, 0.0), path), Step(Grasp(), 1.0, (0.0, 0.0), path)
    plan = Plan(Goal((0.1, 0.0)), (0.0, 0.0), (can, can, cannot), "by hand", True, 0.0)
    with pytest.raises(UnreachableError) as refused:
        execute_plan(robot, plan)
    outcome = refused.value.outcome
    assert len(outcome.object_paths_xy_m) == 2
    assert outcome.end_pose[:2] == robot.xy_m == pytest.approx((0.189, 0.0))
    assert outcome.distance_m == plan.goal.distance_m(robot.xy_m)
    once = execute_plan(robot, replace(plan, steps=(can,)))
    assert corrected(robot, once, lambda *_: replace(plan, steps=(cannot,)), 1) is once
    robot.refuses = lambda *_: False  # can_reach says yes, but execute fails
    went = loop(robot, Goal(robot.xy_m, height_m=0.1))
    assert (went.status, went.message) == ("unreachable", "the height: out of reach")


def test_the_kinematics_agrees_with_what_execution_refuses(world):
    rng = np.random.default_rng(4)
    refused, steps = 0, []
    for _ in range(60):
        xy, angle = rng.uniform([-0.45, -0.65], [0.65, 0.65]), rng.uniform(-math.pi, math.pi)
        action = (Push.towards(angle), Drag.towards(angle), Grasp(), Rotate())[rng.integers(4)]
        stop = rng.uniform(0.3, 1.0)
        world.place(BOX, tuple(xy))
        adapted = adapt_to_object(action, world.depth_image())
        if not world.can_reach(adapted, stop, tuple(xy)):
            world.on_step = steps.append
            with pytest.raises(UnreachableError):
                world.execute_primitive(action, stop, approach=True)
            world.on_step = None
            refused += 1
        elif rng.random() < 0.1:
            world.execute_primitive(action, stop, approach=True)
    assert (steps, refused > 8) == ([], True)


def test_the_arm_is_asked_about_the_grasp_that_it_will_execute(world, skills):
    """At the limit of its reach the hand's height matters, which depends on the object's."""
    for x, status in ((0.52, "unconfirmed"), (0.526, "unreachable")):
        world.place(Cuboid(0.05, 0.05, 0.08), (x, 0.0))
        went = loop(world, Goal((x, 0.0), EXACT_M, height_m=0.24), skills, ends=status)
        assert x == 0.52 or went.steps == ()


def test_disturbances_happen_as_scheduled_and_are_answered(world, skills):
    """What has toppled is dragged; what no camera sees is lost."""
    world.place(TUBE, (0.0, 0.0), 0.0)
    falls = Disturbance("topple", 1, 0.0, 1.0)
    went, schedule = disturbed(world, Goal((0.2, 0.0), EXACT_M), skills, falls)
    assert schedule.happened == [falls]
    assert world.placed.fell()
    assert [type(s.primitive) for s in went.steps][:2] == [Push, Drag]
    world.place(BOX, (0.0, 0.0), 0.3)
    moves = Disturbance("goal", 0, 0.0, 0.08, at_s=3.0)
    shove = Disturbance("shove", 1, -0.02, 0.07, turn=1.0)
    went, schedule = disturbed(world, Goal((0.1, 0.0), EXACT_M), skills, moves, shove)
    assert schedule.happened == [moves, shove]
    assert went.goal.xy_m == pytest.approx((0.1, 0.08))
    assert went.goal.distance_m(world.object_pose()[:2]) < 0.005
    world.place(BALL, (0.5, 0.0), config=WorldConfig(camera="kinect"))
    off = Disturbance("knock", 1, 1.5, 0.0)
    assert disturbed(world, Goal((0.4, 0.1), EXACT_M), skills, off, ends=None)[0].status == "lost"


def test_what_lies_can_be_toppled_again(world):
    world.place(Cuboid(0.04, 0.04, 0.08))
    for _ in range(2):
        x = world.object_pose()[0]
        Disturbance("topple", 0, 1.0, 0.0).apply(world, Goal((0.1, 0.0)))
        world.settle(2.0)
        assert world.object_pose()[0] > x + 0.05


def test_a_knock_in_the_middle_of_an_action_follows_mechanics(world):
    """It slides v²/(2 μ g) and stops; under the fingers it stays on the table."""
    world.place(BOX, (0.0, 0.0), 0.0)
    Disturbance("knock", 0, 0.5, 0.0).apply(world, Goal((0.1, 0.0)))
    world.settle(1.0)
    assert world.object_pose()[0] == pytest.approx(0.5**2 / (2 * 0.25 * 9.81), rel=0.05)
    # Time counts from the start of the arm's motion; the push makes contact after 4 s.
    world.place(BOX, (0.0, 0.0), 0.0)
    knock = Disturbance("knock", 0, 0.0, 0.4, at_s=2.0)
    schedule = DisturbanceSchedule(world, Goal((0.1, 0.0), EXACT_M), [knock])
    schedule.execute(Step(Push.towards(0.0), 0.8, (0.05, 0.0), np.zeros((2, 2))))
    assert schedule.happened == [knock]
    assert world.object_pose()[1] > 0.02
    assert world.on_step is None


def test_disturbances_of_all_kinds_are_drawn():
    drawn = [sample_disturbance(k, n_actions=3) for k in range(300)]
    assert {d.kind for d in drawn} == {"shove", "knock", "topple", "goal"}
    assert all(d.at_s is None for d in drawn if d.kind == "shove")
    assert all(d.action >= 1 for d in drawn if d.at_s is None)


def test_the_disturbance_and_not_the_robot_makes_a_goal_infeasible(world):
    """Feasibility is judged at the first observation after the disturbance."""
    goal, off_table = Goal((0.1, 0.0), EXACT_M), (0.9, 0.0)
    knock = Disturbance("knock", 0, 0.1, 0.3, at_s=2.0)
    moved = Disturbance("goal", 1, 0.05, 0.0)
    world.place(BOX)

    def feasible(status, seen, happened):
        trial = Trial(BOX, (0.0, 0.0), 0.0, goal, (happened,))
        went = SimpleNamespace(status=status, seen_xy_m=seen, goal=goal)
        return _stays_feasible(world, trial, went, (happened,))

    at, near = (0.0, 0.0), (0.05, 0.0)
    assert feasible("reached", (at, near), knock)
    assert not any(feasible("lost", seen, knock) for seen in ((at, off_table), (at,)))  # or unseen
    assert feasible("lost", (at, near, off_table), knock)  # it was reachable
    assert feasible("lost", (at, off_table), moved)  # only the robot has touched it


def knowing_only_what_it_measures(world, monkeypatch):
    """A tabletop as a `Robot` that reads the state only while it acts, not as it parks."""
    names = ("state", "pose", "fell", "rolls", "left_table")
    known = {name: getattr(PlacedObject, name) for name in names}

    def acting(act):
        def acts(*arguments):
            with pytest.MonkeyPatch.context() as patch:
                for name, method in known.items():
                    patch.setattr(PlacedObject, name, method)
                return act(*arguments)

        return acts

    def execute(step, seen):
        done = acting(world.execute)(step, seen)
        return SimpleNamespace(tool=done.tool, object_path=np.full((2, 4), np.nan))

    for name in names:
        monkeypatch.setattr(PlacedObject, name, lambda _: pytest.fail("the state was read"))
    free = {"park": lambda: put_down(world.arm), "can_reach": world.can_reach, "execute": execute}
    return SimpleNamespace(observe=acting(world.observe), settle=acting(world.settle), **free)


@pytest.mark.parametrize("camera", ["ideal", "kinect"])
@pytest.mark.parametrize(("obj", "pose"), TASKS)
def test_no_task_needs_the_state_of_the_simulator(world, skills, monkeypatch, camera, obj, pose):
    """Observation errors are at most 0.5° and 1 mm (ideal), 1.8° and 2.3 mm (Kinect, mean of 8)."""
    world.place(obj, (0.0, 0.0), 0.3, config=WorldConfig(camera=camera))
    goal = Goal((0.06, -0.03), 0.004, **pose)
    with monkeypatch.context() as patched:
        robot = knowing_only_what_it_measures(world, patched)
        went = loop(robot, goal, skills, n_images=1 if camera == "ideal" else 8)
    seen = goal.height_m is None and (goal.turn_rad is None or obj is not BALL)
    assert went.status in ("reached", "unconfirmed"), went.message
    assert went.reached or not (seen and camera == "ideal")
    x, y, yaw = world.object_pose()
    assert math.dist(went.goal.xy_m, (x, y)) < 0.01
    if camera == "ideal" and not pose:
        assert went.end_pose[:2] == (x, y)
        assert went.distance_m == goal.distance_m((x, y))
        assert {type(step.primitive) for step in went.steps} == {Drag if obj is BALL else Push}
        if obj is BOX:  # five times the spread of observed cuboids
            assert went.end_pose[2] == pytest.approx(yaw - 0.3, abs=math.radians(1))
    if goal.turn_rad is not None:
        off = math.remainder(yaw - 0.3 - goal.turn_rad, 2 * math.pi)
        assert abs(off) < math.radians(5 if camera == "ideal" else 10)
    if goal.height_m is not None:
        assert world.object_state()[2] - obj.height_m / 2 == pytest.approx(0.1, abs=0.006)
    assert ("orientation" in went.reckoned) == (obj in (BALL, TUBE) or goal.height_m is not None)


@pytest.mark.slow
def test_a_goal_across_the_table_is_reached_in_the_limit_or_refused(world, skills):
    world.place(BALL, (0.2, -0.4), 0.0)
    assert len(loop(world, Goal((0.2, 0.25), EXACT_M), skills, ends="reached").steps) <= 16
    world.place(BOX, (0.5, 0.3), 0.0)
    pose = world.object_pose()
    assert loop(world, Goal((0.65, 0.65), EXACT_M), skills, ends="unreachable").steps == ()
    assert world.object_pose() == pose
