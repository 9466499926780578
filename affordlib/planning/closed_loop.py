"""Execution of plans, open or closed loop, on anything that implements `Robot`.

`execute_plan` executes a plan without observing. `run_closed_loop` observes after every action
(Section 3.4 of the paper): is the object where it was predicted to be, has it fallen, have goal or
obstacles moved? If so, it plans again from a new image. Rotation is estimated from two images,
height from the hand; what neither shows is computed from the executed actions (dead reckoning).
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from affordlib.geometry import wrap_angle
from affordlib.perception import adapt_to_object, looks_fallen, turn_between
from affordlib.planning.continuous import plan_continuous
from affordlib.planning.free_space import FreeSpace
from affordlib.planning.grasp_rotate import PosePlanner, released_yaw
from affordlib.planning.move_planner import Ending, MovePlanner
from affordlib.planning.problem import PlanMode, Planner
from affordlib.planning.robot import Execution, Robot
from affordlib.planning.skills import Skills
from affordlib.primitives import EMPTY_M, Drag, Grasp, Rotate
from affordlib.types import (
    Checked,
    Goal,
    GoalError,
    NothingSeenError,
    Observation,
    Outcome,
    Plan,
    Step,
    UnreachableError,
    check_count,
    count,
    on_table,
    parameter,
)

SURPRISE_M, DISPLACED_M = 0.002, 0.03
"""Distances [m] of the object from its predicted position above which it is planned for again, and
above which others have displaced it."""

AT_REST_M, OBSERVE_EVERY_S, MAX_OBSERVATIONS = 0.001, 0.25, 20
"""The loop then waits until it moves less [m] between two observations, so far apart [s]."""

MOVE_M, SPARE_ACTIONS, MAX_LIFTS = 0.05, 3, 2
"""Default limits: one action for each such distance [m] to the goal, spare ones, and grasps."""


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


@dataclass(frozen=True)
class ClosedLoopConfig(Checked):
    """Patience and callbacks of a closed loop.

    mode: of its plans. max_actions: by default it grows with the distance, and is renewed when the
    goal moves or, up to max_renewals times, when somebody displaces the object. n_images: number of
    images averaged per observation; eight of the Kinect give the rotation to one degree. on_action:
    called after each action with the plan and the number of actions so far; on_plan: called with a
    plan before its first action.
    """

    mode: str | PlanMode = "multi_partial"
    max_actions: int | None = parameter(partial(check_count, least=0), None)
    max_renewals: int = count(3, 0)
    n_images: int = count(1, 1, 100)
    on_action: Callable[[Plan, int], None] = lambda *_: None
    on_plan: Callable[[Plan], None] = lambda *_: None


@dataclass(frozen=True)
class ClosedLoopResult:
    """The result of a closed loop, as the robot observed it.

    status: "reached"; "unconfirmed", where all is within its tolerance by what the robot knows, but
    was not observed so exactly; "unreachable", "gave_up" or "lost". goal: the final one; errors:
    what is left of it. end_pose: (x, y, rotation since the start) of the object; reckoned: which of
    "position" and "orientation" were not observed at the end but computed from the motion of the
    hand. steps: the executed actions, and object_paths_xy_m, the path (n, 2) of the object in each,
    as recorded; plans: all that were made to positions; seen_xy_m: before every decision.
    """

    goal: Goal
    status: str
    message: str
    errors: dict[str, GoalError]
    steps: tuple[Step, ...]
    object_paths_xy_m: tuple[np.ndarray, ...]
    plans: tuple[Plan, ...]
    seen_xy_m: tuple[tuple[float, float], ...]
    end_pose: tuple[float, float, float]
    reckoned: tuple[str, ...]

    @property
    def reached(self) -> bool:
        """Whether the object was observed as the goal requires."""
        return self.status == "reached"

    @property
    def distance_m(self) -> float:
        """Distance [m] of the object from the goal."""
        return self.errors["position"].left


def run_closed_loop(
    robot: Robot,
    goal: Goal | Callable[[], Goal],
    skills: Skills,
    planner: Planner = plan_continuous,
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
        planner: Planner,
        config: ClosedLoopConfig,
    ) -> None:
        self.robot, self.goal_now, self.skills, self.config = robot, goal_now, skills, config
        self.moves = MovePlanner(robot, skills, planner, PlanMode.of(config.mode))
        self.goal = self.acted_for = goal_now()  # updated before each action and after a lift
        self.steps: list[Step] = []
        self.executions: list[Execution] = []
        self.plans: list[Plan] = []
        self.seen_xy_m: list[tuple[float, float]] = []
        self.plan: Plan | None = None  # the current one
        self.queue: list[Step] = []  # its remaining steps
        self.turned_by_plan_rad = 0.0
        self.renewals, self.turn_allowed = config.max_renewals, False
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
        return ClosedLoopResult(
            goal=self.goal,
            status=ending.status,
            message=ending.message,
            errors=self._errors(),
            steps=tuple(self.steps),
            object_paths_xy_m=tuple(done.object_path[:, :2] for done in self.executions),
            plans=tuple(self.plans),
            seen_xy_m=tuple(self.seen_xy_m),
            end_pose=(*self.seen.xy_m, self._turned_rad()),
            reckoned=self._reckoned(),
        )

    def _observe(self) -> Ending | None:
        """Observe, and check whether the plan is still valid."""
        seen = self._mean_of_images()
        off_m, fell = self._surprise(seen)
        if off_m > DISPLACED_M or fell:
            seen = self._wait(seen)
            off_m, fell = self._surprise(seen)
        was_displaced = off_m > DISPLACED_M
        self.disturbed = was_displaced or fell
        obstacle_moved = seen.obstacles != self.seen.obstacles
        self.seen = self._with_yaw(seen, fell, was_displaced)
        self.seen_xy_m.append(seen.xy_m)
        if not (seen.image[1].any() and on_table(np.array(seen.xy_m))):
            return Ending("lost", f"the object is no longer on the table, after {self._count()}")
        self.goal = self.goal_now()
        goal_moved = self.acted_for != self.goal
        if goal_moved or (was_displaced and self.renewals > 0):
            self.renewals -= not goal_moved
            self.turn_allowed &= not goal_moved  # a new goal may need a full rotation again
            self.limit = max(self.limit, len(self.steps) + self._limit_from(seen.xy_m))
        if off_m > SURPRISE_M or goal_moved or fell or obstacle_moved:
            self.queue = []
        return None

    def _surprise(self, seen: Observation) -> tuple[float, bool]:
        """Distance [m] of the object from where it was predicted, and whether it has fallen."""
        if not self.steps:
            return 0.0, False
        off_m = math.dist(self.steps[-1].predicted_end_xy_m, seen.xy_m)
        return off_m, looks_fallen(self.seen.image, seen.image)

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
            seen_turn = None if fell else turn_between(self.first.image, seen.image, expected)
            turn, std = seen_turn or (self.reckoned_rad - self.first.yaw_rad, None)
            seen = replace(seen, yaw_rad=self.first.yaw_rad + turn, yaw_std_rad=std)
        self.expected_rad = self.reckoned_rad = seen.yaw_rad
        self.first = seen if fell else self.first
        return seen

    def _decide_and_act(self) -> Ending | None:
        """Act towards the first part of the goal that is not met; an `Ending` if all are, or
        nothing helps.
        """
        errors = self._errors()
        turn = errors.get("orientation")
        if turn and not turn.is_met() and not self.turn_allowed:
            # Up to a full rotation, in sweeps of 60°, each of which may move it from its position.
            sweeps = math.ceil((turn.left % (2 * math.pi)) / Rotate.sweep_rad)
            self._allow(2 * sweeps + SPARE_ACTIONS)
            self.turn_allowed = True
        part = next((name for name, error in errors.items() if not error.is_met()), None)
        if part is None:
            return self._arrived()
        if part != "height":
            return self._act(part)
        lifts = sum(isinstance(step.primitive, Grasp) for step in self.steps)
        if lifts >= MAX_LIFTS:
            return self._give_up("height")
        self._allow(1)
        return self._act("height") or self._judge_lift(last=lifts + 1 == MAX_LIFTS)

    def _judge_lift(self, last: bool) -> Ending | None:
        """Check whether the held object is as the goal requires; otherwise put it down."""
        tool = self.executions[-1].tool
        self.held = bool(tool[-1, 4] > EMPTY_M)
        self.lifted_m = float(tool[-1, 2] - tool[:, 2].min()) if self.held else 0.0
        self.goal = self.goal_now()
        errors = self._errors()
        missed = [name for name, error in errors.items() if not error.is_met()]
        if "height" in errors and missed == []:
            return self._arrived()
        if "height" in errors and missed == ["position"] and last:
            return self._give_up("position")
        self.robot.park()
        self.lifted_m, self.held = 0.0, False
        return None

    def _act(self, part: str) -> Ending | None:
        """Execute the next step towards a part of the goal, if limit and arm allow it."""
        if len(self.steps) >= self.limit:
            return self._give_up(part)
        self.acted_for = self.goal
        if self.queue and self.seen.obstacles:
            step = self.queue[0]
            if isinstance(step.primitive, Drag):  # the hand closes as it has opened, and as planned
                yaw = float(self.executions[-1].tool[-1, 3])
                step = replace(step, primitive=replace(step.primitive, grip_yaw=yaw))
            self.queue = [step, *self.queue[1:]] if self.moves.passes(step, self.seen) else []
        if part != "position" or not self.queue:
            if part == "position":
                plan = self.moves.plan(self.seen, self.goal, self._grip_yaw())
                self.plans += [plan] * isinstance(plan, Plan)
            else:
                plan = self._plan_pose(part)
            if isinstance(plan, Ending):
                return plan
            self.plan, self.turned_by_plan_rad = plan, 0.0
            self.queue = list(plan.steps)
            self.config.on_plan(plan)
        step = self.queue.pop(0)
        try:
            execution = self.robot.execute(step, self.seen)
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

    def _plan_pose(self, part: str) -> Plan | Ending:
        """Plan the next rotation, or the lift, with a yaw of the hand that the arm can reach."""
        began, (x, y), obstacles = time.perf_counter(), self.seen.xy_m, self.seen.obstacles
        error, refused = self._errors()[part], set()
        space = FreeSpace(obstacles, self.seen.image, (x, y)) if obstacles else None

        def can_act(step):
            primitive = adapt_to_object(step.primitive, self.seen.image)
            can = self.robot.can_reach(primitive, step.stop_phase, self.seen.xy_m)
            can &= space is None or space.is_free(step)
            if not can:
                refused.add(primitive.name)
            return can

        poses = PosePlanner(self.seen.image, self.skills.model, can_act)
        if part == "orientation":
            step = poses.turn(error.left, (x, y))
        else:
            step = poses.lift(error.left, (x, y), grip_yaw=self._grip_yaw())
        if step:
            seconds = time.perf_counter() - began
            return Plan(self.goal, (x, y), (step,), "pose", True, seconds)
        why = "no action is predicted to have this effect"
        if refused:
            why = f"the arm cannot {' or '.join(sorted(refused))} at ({x:.3f}, {y:.3f}) m"
            why += " beside the obstacles" * bool(obstacles)
        return Ending("unreachable", f"the {part}, with {error.text} left: {why}")

    def _grip_yaw(self) -> float | None:
        """Yaw of the hand that has just released a rotated object, if nothing has moved it since.

        Closing again at this yaw does not rotate the object, so it can be dragged to its position.
        """
        last = self.steps[-1] if self.steps else None
        if last is None or self.disturbed or not isinstance(last.primitive, Rotate | Drag):
            return None
        if last.primitive.grip_yaw is None:  # chosen from an image before the object moved
            return None
        return released_yaw(last)

    def _limit_from(self, xy_m: Sequence[float]) -> int:
        if self.config.max_actions is not None:
            return self.config.max_actions
        return math.ceil(self.goal.distance_m(xy_m) / MOVE_M - 1e-9) + SPARE_ACTIONS

    def _allow(self, further: int) -> None:
        """Raise the action limit, unless the configuration sets it."""
        if self.config.max_actions is None:
            self.limit += further

    def _turned_rad(self) -> float:
        return wrap_angle(self.seen.yaw_rad - self.start_yaw_rad)

    def _errors(self) -> dict[str, GoalError]:
        return self.goal.errors(self.seen.xy_m, self._turned_rad(), self.lifted_m)

    def _reckoned(self) -> tuple[str, ...]:
        hidden = {"position": self.held, "orientation": self.held or self.seen.yaw_std_rad is None}
        return tuple(part for part, is_hidden in hidden.items() if is_hidden)

    def _count(self) -> str:
        n = len(self.steps)
        return f"{n} action{'s' * (n != 1)}"

    def _where(self) -> str:
        texts = [error.text for error in self._errors().values()]
        return f"{', '.join(texts)} from the goal after {self._count()}"

    def _arrived(self) -> Ending:
        """All parts are met; those are named that were not observed, or not exactly enough."""
        std = {"position": self.seen.std_m, "orientation": self.seen.yaw_std_rad or 0.0}
        whys: dict[str, list[str]] = {}
        for name, error in self._errors().items():
            if name in self._reckoned():
                whys.setdefault("computed, not observed", []).append(name)
            elif not error.is_met(std.get(name, 0.0)):
                whys.setdefault("observed less exactly than required", []).append(name)
        if whys:
            parts = [f"the {' and '.join(names)} {why}" for why, names in whys.items()]
            return Ending("unconfirmed", f"{self._where()}: {'; '.join(parts)}")
        return Ending("reached", self._where())

    def _give_up(self, part: str) -> Ending:
        return Ending("gave_up", f"{self._where()}: the {part} is not reached")
