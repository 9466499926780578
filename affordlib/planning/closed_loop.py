"""Execution of plans, open or closed loop, on anything that implements `Robot`.

`execute_plan` executes a plan without observing. `run_closed_loop` observes after every action
(Section 3.4 of the paper): is the object where it was predicted to be, has the goal changed, has
the object fallen? If so, it plans again from a new image. Rotation is estimated from two images,
height from the hand; what neither shows is computed from the executed actions (dead reckoning).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from affordlib.geometry import wrap_angle
from affordlib.perception import adapt_to_object, looks_fallen, turn_between
from affordlib.planning import grasp_rotate
from affordlib.planning.continuous import plan_continuous
from affordlib.planning.grasp_rotate import GRIPPER_YAWS_RAD, TURN_TOLERANCE_RAD
from affordlib.planning.move_planner import Ending, MovePlanner
from affordlib.planning.problem import MODES, PlanningProblem, is_on_table
from affordlib.planning.robot import Execution, Robot
from affordlib.planning.skills import Skills
from affordlib.primitives import EMPTY_M, Drag, Grasp, Rotate
from affordlib.types import (
    Goal,
    NothingSeenError,
    Observation,
    Outcome,
    Plan,
    Step,
    UnreachableError,
    check_count,
    check_within,
)

SURPRISE_M = 0.002
"""Distance of the object from its predicted position above which it plans again [m]."""

DISPLACED_M = 0.03
"""Distance from the predicted position above which the object counts as displaced by others [m]."""

AT_REST_M, OBSERVE_EVERY_S, MAX_OBSERVATIONS = 0.001, 0.25, 20
"""An object is at rest if it moves less than 1 mm in 0.25 s; the loop waits for this for 20
observations (5 s) at most."""

MOVE_M, SPARE_ACTIONS = 0.05, 3
"""The action limit is one action per 5 cm of distance, and three more."""

MAX_RENEWALS = 3
"""How many times the action limit is renewed because the object was displaced."""

MAX_LIFTS = 2
HEIGHT_TOLERANCE_M = 0.003


def execute_plan(robot: Robot, plan: Plan) -> Outcome:
    """Execute a plan's steps as planned, each action relative to the object's current position.

    The outcome is what the robot recorded. Raises UnreachableError when the arm cannot follow a
    step; its `outcome` holds that of the steps before.
    """
    done: list[Execution] = []
    try:
        for step in plan.steps:
            done.append(robot.execute(step))
    except UnreachableError as error:
        error.outcome = _outcome(robot, plan, done)
        raise
    return _outcome(robot, plan, done)


def _outcome(robot: Robot, plan: Plan, done: Sequence[Execution]) -> Outcome:
    paths = [execution.object_path for execution in done]
    if paths:
        x, y, _, yaw = paths[-1][-1].tolist()
    else:
        seen = robot.observe()
        (x, y), yaw = seen.xy_m, seen.yaw_rad or 0.0
    return Outcome(
        plan,
        plan.goal.distance_m((x, y)),
        (x, y, yaw),
        tuple(path[:, :2] for path in paths),
        turned_rad=wrap_angle(yaw - paths[0][0, 3]) if paths else 0.0,
        lifted_m=float(sum(path[-1, 2] for path in paths)),
    )


def is_seen_on_table(seen: Observation) -> bool:
    """Whether the image shows an object and its position is on the table."""
    return bool(seen.image[1].any() and is_on_table(np.array([seen.xy_m]))[0])


@dataclass(frozen=True)
class ClosedLoopConfig:
    """Action limit, number of images per observation, and callbacks of a closed loop.

    max_actions: default `action_limit` of the distance, renewed when the goal moves or somebody
    displaces the object. n_images: number of images averaged per observation; eight of the Kinect
    give the rotation to one degree. on_action: called after each action with the plan and the
    number of actions so far; on_plan: called with a plan before its first action.
    """

    max_actions: int | None = None
    n_images: int = 1
    on_action: Callable[[Plan, int], None] = lambda *_: None
    on_plan: Callable[[Plan], None] = lambda *_: None

    def __post_init__(self) -> None:
        check_count("n_images", self.n_images, 1, 100)
        if self.max_actions is not None:
            check_count("max_actions", self.max_actions, least=0)


@dataclass(frozen=True)
class ClosedLoopResult:
    """The result of a closed loop, as the robot observed it.

    status: "reached", "unreachable", "gave_up" or "lost"; goal: the final one; end_pose: (x, y,
    rotation since the start) of the object, and turn_std_rad; reckoned: which of "position" and
    "orientation" were not observed at the end but computed from the motion of the hand;
    turn_error_rad, height_error_m: None if not part of the goal; steps: the executed actions, and
    executions, their recordings; plans: all that were made; seen_xy_m: before every decision;
    vetoes: planned actions that the arm's kinematics refused.
    """

    goal: Goal
    status: str
    message: str
    distance_m: float
    steps: tuple[Step, ...]
    executions: tuple[Execution, ...]
    plans: tuple[Plan, ...]
    seen_xy_m: tuple[tuple[float, float], ...]
    end_pose: tuple[float, float, float]
    turn_std_rad: float | None
    reckoned: tuple[str, ...]
    vetoes: int = 0
    turn_error_rad: float | None = None
    height_error_m: float | None = None

    @property
    def reached(self) -> bool:
        """Whether the object was observed as the goal requires."""
        return self.status == "reached"

    @property
    def object_paths_xy_m(self) -> tuple[np.ndarray, ...]:
        """Recorded path (n, 2) of the object in each action."""
        return tuple(execution.object_path[:, :2] for execution in self.executions)


def action_limit(distance_m: float) -> int:
    """Number of actions allowed for a distance: one per 5 cm, rounded up, and 3 more."""
    distance_m = check_within("distance_m", distance_m, 0.0, 10.0, "m")
    return math.ceil(distance_m / MOVE_M - 1e-9) + SPARE_ACTIONS


def run_closed_loop(
    robot: Robot,
    goal: Goal | Callable[[], Goal],
    skills: Skills,
    planner: Callable[[PlanningProblem], Plan] = plan_continuous,
    config: ClosedLoopConfig | None = None,
) -> ClosedLoopResult:
    """Bring the object to a goal (position, orientation, height) despite errors and disturbances.

    goal: a `Goal`, or a function that returns the current one. planner: such as plan_astar. Raises
    NothingSeenError where no object is seen at the start.
    """
    goal_now = (lambda: goal) if isinstance(goal, Goal) else goal
    if not isinstance(goal_now(), Goal):
        raise TypeError(f"goal must be a Goal, or a function that returns one, got {goal!r}")
    return _ClosedLoop(robot, goal_now, skills, planner, config or ClosedLoopConfig()).run()


class _ClosedLoop:
    """State of a running closed loop: observe, check the plan, plan again if necessary, act."""

    def __init__(
        self,
        robot: Robot,
        goal_now: Callable[[], Goal],
        skills: Skills,
        planner: Callable[[PlanningProblem], Plan],
        config: ClosedLoopConfig,
    ) -> None:
        self.robot, self.goal_now, self.skills, self.config = robot, goal_now, skills, config
        self.goal = goal_now()  # updated before each action and after a lift
        self.acted_for: Goal | None = None
        self.moves = MovePlanner(robot, skills, planner, MODES["multi_partial"])
        self.steps: list[Step] = []
        self.executions: list[Execution] = []
        self.plans: list[Plan] = []
        self.seen_xy_m: list[tuple[float, float]] = []
        self.plan: Plan | None = None  # the current one
        self.queue: list[Step] = []  # its remaining steps
        self.renewals, self.turn_allowed = MAX_RENEWALS, False
        self.lifted_m, self.held, self.disturbed = 0.0, False, False
        seen = self._mean_of_images()
        yaw_rad, std_rad = seen.yaw_rad or 0.0, seen.yaw_std_rad or 0.0
        self.seen = self.first = replace(seen, yaw_rad=yaw_rad, yaw_std_rad=std_rad)
        self.start_yaw_rad = self.expected_rad = self.reckoned_rad = yaw_rad
        self.limit = self._limit_from(self.seen.xy_m)

    def run(self) -> ClosedLoopResult:
        """Correct position, orientation, height in turn until all are reached or one cannot be."""
        ending = None
        while ending is None:
            try:
                ending = self._observe() or self._decide_and_act()
            except NothingSeenError:
                ending = Ending("lost", f"no object is seen on the table, after {self._count()}")
        goal, seen = self.goal, self.seen
        return ClosedLoopResult(
            goal=goal,
            status=ending.status,
            message=ending.message,
            distance_m=goal.distance_m(seen.xy_m),
            steps=tuple(self.steps),
            executions=tuple(self.executions),
            plans=tuple(self.plans),
            seen_xy_m=tuple(self.seen_xy_m),
            end_pose=(*seen.xy_m, wrap_angle(seen.yaw_rad - self.start_yaw_rad)),
            turn_std_rad=seen.yaw_std_rad,
            reckoned=self._reckoned(),
            vetoes=self.moves.vetoes,
            turn_error_rad=self._turn_left(),
            height_error_m=self._height_left(),
        )

    def _observe(self) -> Ending | None:
        """Observe, and check whether the plan is still valid."""
        before, seen = self.seen, self._mean_of_images()
        expected = self.steps[-1].predicted_end_xy_m if self.steps else None

        def surprise():
            off_m = math.inf if expected is None else math.dist(expected, seen.xy_m)
            fell = expected is not None and looks_fallen(before.image, seen.image)
            return off_m, fell

        off_m, fell = surprise()
        if DISPLACED_M < off_m < math.inf or fell:
            seen = self._wait(seen)
            off_m, fell = surprise()
        was_displaced = DISPLACED_M < off_m < math.inf
        self.disturbed = was_displaced or fell
        self.seen = self._with_yaw(seen, fell, was_displaced)
        self.seen_xy_m.append(self.seen.xy_m)
        if not is_seen_on_table(self.seen):
            return Ending("lost", f"the object is no longer on the table, after {self._count()}")
        self.goal = self.goal_now()
        goal_moved = self.acted_for is not None and self.acted_for != self.goal
        if goal_moved or (was_displaced and self.renewals > 0):
            self.renewals -= not goal_moved
            self.turn_allowed &= not goal_moved  # a new goal may need a full rotation again
            self.limit = max(self.limit, len(self.steps) + self._limit_from(self.seen.xy_m))
        if off_m > SURPRISE_M or goal_moved or fell:
            self.queue = []
        return None

    def _wait(self, seen: Observation) -> Observation:
        """Observe until an object that somebody has set in motion is at rest."""
        for _ in range(MAX_OBSERVATIONS):
            self.robot.settle(OBSERVE_EVERY_S)
            before, seen = seen, self._mean_of_images()
            if math.dist(before.xy_m, seen.xy_m) < AT_REST_M:
                break
        return seen

    def _mean_of_images(self) -> Observation:
        views = [self.robot.observe() for _ in range(self.config.n_images)]
        x, y = np.mean([view.xy_m for view in views], axis=0).tolist()
        image = np.mean([view.image for view in views], axis=0)
        return replace(views[-1], xy_m=(x, y), image=image)

    def _with_yaw(self, seen: Observation, fell: bool, displaced: bool) -> Observation:
        """Add the yaw to an observation: from the robot, from images since the first, or reckoned.

        An object that looks the same at every yaw is assumed to rotate with the hand.
        """
        if seen.yaw_rad is None:
            expected = None if displaced else self.expected_rad - self.first.yaw_rad
            told = None if fell else turn_between(self.first.image, seen.image, expected)
            turn, std = told or (self.reckoned_rad - self.first.yaw_rad, None)
            seen = replace(seen, yaw_rad=self.first.yaw_rad + turn, yaw_std_rad=std)
        self.expected_rad = self.reckoned_rad = seen.yaw_rad
        self.first = seen if fell else self.first
        return seen

    def _decide_and_act(self) -> Ending | None:
        """Act towards the first unreached part of the goal; return an `Ending` if all are reached
        or nothing helps.
        """
        turn_rad = self._turn_left()
        turns = turn_rad is not None and abs(turn_rad) > TURN_TOLERANCE_RAD
        if turns and not self.turn_allowed:  # up to a full rotation, in sweeps of 60°
            sweeps = math.ceil((turn_rad % (2 * math.pi)) / Rotate.sweep_rad)
            self._allow(2 * sweeps + SPARE_ACTIONS)  # each may move it from its position
            self.turn_allowed = True
        if self.goal.distance_m(self.seen.xy_m) > self.goal.tolerance_m:
            return self._act("position", self._move)
        if turns:
            return self._act("orientation", self._turn)
        if self.goal.height_m is None:
            return Ending("reached", self._where())
        lifts = sum(isinstance(step.primitive, Grasp) for step in self.steps)
        if lifts == MAX_LIFTS:
            return self._give_up("height")
        self._allow(1)
        return self._act("height", self._lift) or self._judge_lift(last=lifts + 1 == MAX_LIFTS)

    def _judge_lift(self, last: bool) -> Ending | None:
        """Check whether the held object is as the goal requires; otherwise put it down."""
        tool = self.executions[-1].tool
        self.held = bool(tool[-1, 4] > EMPTY_M)
        self.lifted_m = float(tool[-1, 2] - tool[:, 2].min()) if self.held else 0.0
        self.goal = self.goal_now()
        turn_rad, height_m = self._turn_left() or 0.0, self._height_left()
        lifted = height_m is not None and abs(height_m) <= HEIGHT_TOLERANCE_M
        if lifted and abs(turn_rad) <= TURN_TOLERANCE_RAD:
            if self.goal.distance_m(self.seen.xy_m) <= self.goal.tolerance_m:
                return Ending("reached", self._where())
            if last:
                return self._give_up("position")
        self.robot.park()
        self.lifted_m, self.held = 0.0, False
        return None

    def _act(self, part: str, choose: Callable[[], Step | Ending]) -> Ending | None:
        """Execute the chosen step, if the action limit and the arm allow it."""
        if len(self.steps) >= self.limit:
            return self._give_up(part)
        self.acted_for = self.goal
        step = choose()
        if isinstance(step, Ending):
            return step
        try:
            execution = self.robot.execute(step)
        except UnreachableError as error:  # the object is now seen at a slightly other position
            return Ending("unreachable", f"the {part}: {error}")
        self.steps.append(step)
        self.executions.append(execution)
        self._reckon(step, execution.tool)
        self.config.on_action(self.plan, len(self.steps))
        return None

    def _reckon(self, step: Step, tool: np.ndarray) -> None:
        """Update the expected yaw by the model and, after a rotation, by the motion of the hand."""
        by_rad = step.predicted_turn_rad - self.turned_by_plan_rad
        self.turned_by_plan_rad = step.predicted_turn_rad
        self.expected_rad = self.reckoned_rad = self.seen.yaw_rad + by_rad
        if isinstance(step.primitive, Rotate):
            phase, hand_rad = np.linspace(0, step.stop_phase, len(tool)), np.unwrap(tool[:, 3])
            closed_rad = np.interp(step.primitive.segment_phases[2], phase, hand_rad)
            self.reckoned_rad = self.seen.yaw_rad + float(hand_rad[-1] - closed_rad)

    def _move(self) -> Step | Ending:
        if not self.queue:
            plan = self.moves.plan(self.seen, self.goal, self._grip_yaw())
            if isinstance(plan, Ending):
                return plan
            self.plans.append(plan)
            self.queue = list(plan.steps)
            self._follow(plan)
        return self.queue.pop(0)

    def _grip_yaw(self) -> float | None:
        """Yaw of the hand that has just released a rotated object, if nothing has moved it since.

        Closing again at this yaw does not rotate the object, so it can be dragged to its position.
        """
        last = self.steps[-1] if self.steps else None
        if last is None or self.disturbed or not isinstance(last.primitive, Rotate | Drag):
            return None
        if last.primitive.grip_yaw is None:  # chosen from an image before the object moved
            return None
        return float(last.primitive.path(last.stop_phase)[0, 3])

    def _turn(self) -> Step | Ending:
        turn_rad = self._turn_left()
        model = self.skills.model(Rotate)
        predicted = grasp_rotate.predict_trajectories(model, self.seen.image, Rotate(), "yaw")
        return self._first_possible(
            grasp_rotate.candidate_turns(predicted, self.seen.xy_m, turn_rad),
            f"the orientation, with {math.degrees(turn_rad):.0f}° left",
            "no rotation is predicted to turn the object",
        )

    def _lift(self) -> Step | Ending:
        yaws, height_m, grip_yaw = GRIPPER_YAWS_RAD, self.goal.height_m, self._grip_yaw()
        if grip_yaw is not None:
            # The grasp has the yaw of the rotation's grip; another would rotate the object.
            yaws = grasp_rotate.aligned_gripper_yaws(grip_yaw)
        model = self.skills.model(Grasp)
        predicted = grasp_rotate.predict_trajectories(model, self.seen.image, Grasp(), "z", yaws)
        return self._first_possible(
            grasp_rotate.candidate_lifts(predicted, self.seen.xy_m, height_m),
            f"the height of {100 * height_m:.1f} cm",
            "no grasp is predicted to lift the object that high",
        )

    def _first_possible(
        self, candidates: Iterable[Step], wanted: str, hopeless: str
    ) -> Step | Ending:
        """Return the first of some steps, each with another gripper yaw, that the arm can reach."""
        at = self.seen.xy_m
        for step in candidates:
            primitive = adapt_to_object(step.primitive, self.seen.image)
            if self.robot.can_reach(primitive, step.stop_phase, at):
                self._follow(Plan(self.goal, at, (step,), primitive.name, False, 0.0))
                return step
            self.moves.vetoes += 1
            hopeless = f"the arm cannot {primitive.name} at ({at[0]:.3f}, {at[1]:.3f}) m"
        return Ending("unreachable", f"{wanted}: {hopeless}")

    def _follow(self, plan: Plan) -> None:
        self.plan, self.turned_by_plan_rad = plan, 0.0
        self.config.on_plan(plan)

    def _limit_from(self, xy_m: Sequence[float]) -> int:
        if self.config.max_actions is not None:
            return self.config.max_actions
        return action_limit(self.goal.distance_m(xy_m))

    def _allow(self, further: int) -> None:
        """Raise the action limit, unless the configuration sets it."""
        if self.config.max_actions is None:
            self.limit += further

    def _turn_left(self) -> float | None:
        if self.goal.turn_rad is None:
            return None
        return wrap_angle(self.goal.turn_rad - (self.seen.yaw_rad - self.start_yaw_rad))

    def _height_left(self) -> float | None:
        return None if self.goal.height_m is None else self.goal.height_m - self.lifted_m

    def _reckoned(self) -> tuple[str, ...]:
        hidden = {"position": self.held, "orientation": self.held or self.seen.yaw_std_rad is None}
        return tuple(part for part, is_hidden in hidden.items() if is_hidden)

    def _count(self) -> str:
        n = len(self.steps)
        return f"{n} action{'s' * (n != 1)}"

    def _where(self) -> str:
        parts = [f"{1000 * self.goal.distance_m(self.seen.xy_m):.1f} mm"]
        if self.goal.turn_rad is not None:
            parts.append(f"{math.degrees(abs(self._turn_left())):.1f}°")
        if self.goal.height_m is not None:
            parts.append(f"{1000 * abs(self._height_left()):.1f} mm in height")
        return f"{', '.join(parts)} from the goal after {self._count()}"

    def _give_up(self, part: str) -> Ending:
        return Ending("gave_up", f"{self._where()}: the {part} is not reached")
