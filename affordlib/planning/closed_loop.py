"""Carrying plans out in the world; the only part of planning that acts.

`execute_plan` trusts a plan. `run_closed_loop` looks after every action (Section 3.4 of the paper):
is the object where it should be, has the goal changed, has the object fallen? If so a new image, a
new plan. It ends in one of four ways, and says so.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from affordlib.perception import adapt_to_object, looks_fallen
from affordlib.planning.continuous import plan_continuous
from affordlib.planning.disturbances import Disturbance, DisturbanceSchedule
from affordlib.planning.grasp_rotate import (
    GRIPPER_YAWS_RAD,
    TURN_TOLERANCE_RAD,
    aligned_gripper_yaws,
    plan_lift,
    plan_turn,
)
from affordlib.planning.move_planner import Ended, MovePlanner
from affordlib.planning.problem import PlanMode, PlanningProblem, is_on_table
from affordlib.planning.skills import Skills
from affordlib.primitives import Grasp, Rotate, wrap_angle
from affordlib.types import (
    Goal,
    Interaction,
    NothingSeenError,
    Observation,
    Outcome,
    Plan,
    Step,
    UnreachableError,
    check_count,
    check_field,
    check_within,
)

if TYPE_CHECKING:
    import affordlib.world

Replan = Callable[[np.ndarray, tuple[float, float], Goal], Plan]
"""A planner as (image, start_xy_m, goal) → Plan."""

ENOUGH_M = 0.0003
"""What a corrective action leaves anyway; nearer to the goal than this, none is tried."""

SURPRISE_M = 0.002
"""An object that is farther than this from where the plan has it makes the plan worthless."""

DISPLACED_M = 0.03
"""An object that is farther than this from where it should be was moved by somebody else."""

AT_REST_M, BETWEEN_LOOKS_S, MOST_LOOKS = 0.001, 0.25, 20
"""An object rests that is in the same place a quarter of a second later; after 5 s none is waited
for."""

SHIFTED_M = 0.005
"""Closing fingers may shift what they lift by so much, and it still is where it should be."""

RENEWALS = 3
MOVE_M = 0.05
SPARE_ACTIONS = 3
MAX_LIFTS = 2
STATUSES = ("reached", "unreachable", "gave_up", "lost")


def execute_plan(
    world: affordlib.world.Tabletop,
    plan: Plan,
    corrections: int = 0,
    replan: Replan | None = None,
    enough_m: float = ENOUGH_M,
) -> Outcome:
    """Execute a plan's steps, as planned, and measure where the object rests.

    Open loop: the plan is not revised. Each action is carried out relative to where the object
    then stands, as actions are defined. The distance is taken after the gripper has retreated,
    unless it holds the object, and the object has rested 0.5 s. Raises UnreachableError when the
    arm cannot follow a step; it has the outcome of those before.

    corrections: after the last step, so many single actions at most, each the first of a plan that
    `replan` makes anew from what is then seen, and each only if the object is seen, and farther
    than enough_m [m] from the goal, the plan expects to bring it nearer, and the arm can do it.
    There are none after a plan that ends with the object in the hand.
    """
    if corrections and replan is None:
        raise ValueError(f"corrections = {corrections} need a planner; give replan as well")
    yaw_rad, z_m = world.object_pose()[2], world.object_state()[2]
    paths: list[np.ndarray] = []

    def measured():
        pose = world.object_pose()
        distance = plan.goal.distance_m(pose[:2])
        turned, lifted = wrap_angle(pose[2] - yaw_rad), world.object_state()[2] - z_m
        return Outcome(plan, distance, pose, world.object_tilt_rad(), tuple(paths), turned, lifted)

    for step in plan.steps:
        try:
            paths.append(path_on_table(world.execute(step)))
        except UnreachableError as error:
            error.outcome = measured()
            raise
    held = bool(plan.steps) and plan.steps[-1].primitive.holds
    for _ in range(0 if held else corrections):
        try:
            seen = world.observe()
        except NothingSeenError:
            break
        off = plan.goal.distance_m(seen.xy_m)
        if off <= enough_m or not is_on_table(np.array([seen.xy_m]))[0] or not seen.image[1].any():
            break
        # A planner content within the goal's tolerance would have nothing to correct.
        exactly = replace(plan.goal, tolerance_m=min(plan.goal.tolerance_m, enough_m))
        steps = replan(seen.image, seen.xy_m, exactly).steps[:1]
        if not steps or plan.goal.distance_m(steps[0].predicted_end_xy_m) >= off:
            break
        if not world.can_reach(steps[0].primitive, steps[0].stop_phase):
            break
        paths.append(path_on_table(world.execute(steps[0])))
    return measured()


@dataclass(frozen=True)
class ClosedLoopConfig:
    """How exactly a goal is to be met, and with how many actions.

    The position holds when the object is seen within the goal's own tolerance. max_actions: default
    `action_limit` of the distance, renewed when the goal moves or somebody displaces the object
    (that at most three times). horizon: the longest chain the planner is asked for. on_action:
    called with the plan and the number of actions taken, after each; it may return a new goal.
    on_plan: called with every plan before its first action.
    """

    turn_tolerance_rad: float = TURN_TOLERANCE_RAD
    height_tolerance_m: float = 0.003
    max_actions: int | None = None
    horizon: int = 3
    on_action: Callable[[Plan, int], Goal | None] | None = None
    on_plan: Callable[[Plan], None] | None = None

    def __post_init__(self) -> None:
        check_field(self, "height_tolerance_m", 1e-5, 0.1, "m")
        check_field(self, "turn_tolerance_rad", 1e-4, math.pi, "rad")
        check_count("horizon", self.horizon, 1, 10)
        if self.max_actions is not None:
            check_count("max_actions", self.max_actions, least=0)


@dataclass(frozen=True)
class ClosedLoopResult:
    """What came of a closed loop.

    status: one of `STATUSES`; message: the same in words; goal: as it was in the end; distance_m:
    between it and the object's true position; turn_error_rad, height_error_m: likewise, None where
    the goal does not ask; steps: the actions taken; object_paths_xy_m: one (n, 2) path of the
    object for each; plans: all that were made; seen_xy_m: where the object was seen before every
    decision; happened: the disturbances that came to pass; vetoes: planned actions that the arm's
    kinematics refused before any motion.
    """

    goal: Goal
    status: str
    message: str
    distance_m: float
    steps: tuple[Step, ...]
    object_paths_xy_m: tuple[np.ndarray, ...]
    plans: tuple[Plan, ...]
    seen_xy_m: tuple[tuple[float, float], ...]
    end_pose: tuple[float, float, float]
    happened: tuple[Disturbance, ...] = ()
    vetoes: int = 0
    turn_error_rad: float | None = None
    height_error_m: float | None = None

    @property
    def reached(self) -> bool:
        """Whether the object was seen where, and as, the goal wants it."""
        return self.status == "reached"


def action_limit(distance_m: float) -> int:
    """How many actions a distance is worth: one for every 5 cm, rounded up, and 3 more."""
    distance_m = check_within("distance_m", distance_m, 0.0, 10.0, "m")
    return math.ceil(distance_m / MOVE_M - 1e-9) + SPARE_ACTIONS


def path_on_table(done: Interaction) -> np.ndarray:
    """The object's path (n, 2) [m] while it was acted on, in the frame of the table."""
    return done.effect[:, :2] + done.start_pose[:2]


def run_closed_loop(
    world: affordlib.world.Tabletop,
    goal: Goal,
    skills: Skills,
    planner: Callable[[PlanningProblem], Plan] = plan_continuous,
    config: ClosedLoopConfig | None = None,
    disturbances: Sequence[Disturbance] = (),
) -> ClosedLoopResult:
    """Bring the object to a goal, whatever happens on the way: position, orientation, height.

    planner: such as plan_astar, plan_continuous, plan_gradient. disturbances: what shall happen.
    Never moves where the arm's kinematics says no.
    """
    config = config or ClosedLoopConfig()
    return _ClosedLoop(world, goal, skills, planner, config, disturbances).run()


class _ClosedLoop:
    """A closed loop while it lasts: look, judge whether the plan holds, plan anew, act."""

    def __init__(
        self,
        world: affordlib.world.Tabletop,
        goal: Goal,
        skills: Skills,
        planner: Callable[[PlanningProblem], Plan],
        config: ClosedLoopConfig,
        disturbances: Sequence[Disturbance],
    ) -> None:
        self.world, self.skills, self.config = world, skills, config
        self.script = DisturbanceSchedule(goal, disturbances)
        self.steps: list[Step] = []
        self.paths: list[np.ndarray] = []
        mode = PlanMode(config.horizon, partial=True)
        self.moves = MovePlanner(world, skills, planner, mode)
        self.places: list[tuple[float, float]] = []
        self.plan: Plan | None = None  # that is followed
        self.queue: list[Step] = []
        self.seen: Observation | None = None
        self.renewals = RENEWALS
        self.planned_for: Goal | None = None
        self.expected: tuple[float, float] | None = None
        self.yaw_rad = world.object_pose()[2]
        self.grip_yaws = GRIPPER_YAWS_RAD
        self.turns = self.limit = 0
        self.z_m = world.object_state()[2]

    @property
    def goal(self) -> Goal:
        return self.script.goal

    def run(self) -> ClosedLoopResult:
        """Position, orientation, height, again until all hold or one cannot be had."""
        try:
            self._run()
        except Ended as end:
            return self._ended(*end.args)
        raise AssertionError("a closed loop ends by saying how")

    def _run(self) -> None:
        lifts = 0
        self.limit = self._limit_from(self._perceived().xy_m)
        while True:
            self._look()
            if self.goal.distance_m(self.seen.xy_m) > self.goal.tolerance_m:
                self._act(self._next_move(), "position")
                continue
            off = self._turn_left()
            if off is not None and abs(off) > self.config.turn_tolerance_rad:
                # Behind it lies what takes a whole round, in sweeps of 60°.
                if self.turns == 0:
                    sweeps = math.ceil((off % (2 * math.pi)) / Rotate.sweep_rad)
                    self._allow(sweeps + SPARE_ACTIONS)
                self.turns += 1
                self._act(self._turn(off), "orientation")
                continue
            if self.goal.height_m is None:
                raise Ended("reached", self._where())
            if lifts == MAX_LIFTS:
                self._give_up("height")
            lifts += 1
            self._allow(1)
            self._act(self._lift(), "height")
            off = self._turn_left()
            turned = off is None or abs(off) <= self.config.turn_tolerance_rad
            if turned and abs(self._height_left()) <= self.config.height_tolerance_m:
                shifted = self.goal.distance_m(self.world.object_pose()[:2])
                if shifted <= max(self.goal.tolerance_m, SHIFTED_M):
                    raise Ended("reached", self._where())
                if lifts == MAX_LIFTS:
                    self._give_up("position")
            self.world.park()

    def _look(self) -> None:
        """Let happen what happens between actions; look, and judge whether the plan still holds."""
        self.script.before(self.world, len(self.steps))
        before, self.seen = self.seen, self._perceived()
        off, fell = self._surprise(before)
        if DISPLACED_M < off < math.inf or fell:
            self._wait()
            off, fell = self._surprise(before)
        self.places.append(self.seen.xy_m)
        if not (self.seen.image[1].any() and is_on_table(np.array([self.seen.xy_m]))[0]):
            raise Ended("lost", f"the object is no longer on the table, after {self._count()}")
        moved = self.planned_for is not None and self.planned_for != self.goal
        if moved or (self.expected is not None and off > DISPLACED_M and self.renewals > 0):
            self.renewals -= not moved
            if moved:
                self.turns = 0  # the goal may ask for a whole round again
            self.limit = max(self.limit, len(self.steps) + self._limit_from(self.seen.xy_m))
        if off > SURPRISE_M or moved or fell:
            self.queue = []

    def _perceived(self) -> Observation:
        try:
            return self.world.observe()
        except NothingSeenError:
            raise Ended("lost", f"no object is seen on the table, after {self._count()}") from None

    def _surprise(self, before: Observation | None) -> tuple[float, bool]:
        """How far the object is from where it should be [m], and whether it has fallen."""
        off = math.inf if self.expected is None else math.dist(self.expected, self.seen.xy_m)
        return off, before is not None and looks_fallen(before.image, self.seen.image)

    def _wait(self) -> None:
        """Look on until what somebody has set in motion rests."""
        for _ in range(MOST_LOOKS):
            self.world.settle(BETWEEN_LOOKS_S)
            before, self.seen = self.seen, self._perceived()
            if math.dist(before.xy_m, self.seen.xy_m) < AT_REST_M:
                return

    def _limit_from(self, xy_m: Sequence[float]) -> int:
        if self.config.max_actions is not None:
            return self.config.max_actions
        return action_limit(self.goal.distance_m(xy_m))

    def _allow(self, further: int) -> None:
        """More actions than the distance is worth, unless it was said how many there may be."""
        if self.config.max_actions is None:
            self.limit += further

    def _act(self, step: Step, part: str) -> None:
        """Carry out a step that the arm has agreed to."""
        if len(self.steps) >= self.limit:
            self._give_up(part)
        self.planned_for, self.expected = self.goal, step.predicted_end_xy_m
        with self.script.during(self.world, len(self.steps)):
            try:
                self.paths.append(path_on_table(self.world.execute(step)))
            except UnreachableError as error:  # of what it sees now, a hair off what it agreed to
                raise Ended("unreachable", f"the {part}: {error}") from error
        self.steps.append(step)
        self.grip_yaws = GRIPPER_YAWS_RAD
        if isinstance(step.primitive, Rotate):
            # A grasp takes an object as the rotation left it, or it would turn it back.
            self.grip_yaws = aligned_gripper_yaws(float(step.primitive.path(step.stop_phase)[0, 3]))
        if self.config.on_action is not None:
            self.script.goal = self.config.on_action(self.plan, len(self.steps)) or self.goal

    def _next_move(self) -> Step:
        if len(self.steps) >= self.limit:
            self._give_up("position")
        if not self.queue:
            self.queue = self.moves.steps(self.seen, self.goal, self._count())
            self._follow(self.moves.plans[-1])
        return self.queue.pop(0)

    def _follow(self, plan: Plan) -> None:
        self.plan = plan
        if self.config.on_plan is not None:
            self.config.on_plan(plan)

    def _turn_left(self) -> float | None:
        if self.goal.turn_rad is None:
            return None
        turned = self.world.object_pose()[2] - self.yaw_rad
        return wrap_angle(self.goal.turn_rad - turned)

    def _height_left(self) -> float:
        return self.goal.height_m - (self.world.object_state()[2] - self.z_m)

    def _turn(self, off_rad: float) -> Step:
        model = self.skills.model(Rotate)
        return self._agreed(
            GRIPPER_YAWS_RAD,
            lambda yaws: plan_turn(model, self.seen.image, self.seen.xy_m, off_rad, yaws),
            f"the orientation: {math.degrees(off_rad):.0f}° more",
            "no rotation is foreseen to turn the object",
        )

    def _lift(self) -> Step:
        self.z_m = self.world.object_state()[2]
        model, height = self.skills.model(Grasp), self.goal.height_m
        return self._agreed(
            self.grip_yaws,
            lambda yaws: plan_lift(model, self.seen.image, self.seen.xy_m, height, yaws),
            f"the height: {100 * height:.1f} cm",
            "no grasp is foreseen to lift it so high",
        )

    def _agreed(
        self,
        grip_yaws: Sequence[float],
        plan: Callable[[Sequence[float]], Step | None],
        wanted: str,
        hopeless: str,
    ) -> Step:
        """What is planned of the angles of the hand to which the arm agrees."""
        yaws, vetoed = list(grip_yaws), None
        while yaws:
            step = plan(yaws)
            if step is None:
                break
            asked = adapt_to_object(step.primitive, self.seen.image)
            if self.world.can_reach(asked, step.stop_phase, self.seen.xy_m):
                kind, at = step.primitive.name, self.seen.xy_m
                self._follow(Plan(self.goal, at, (step,), kind, False, len(grip_yaws), 0.0))
                return step
            self.moves.vetoes += 1
            vetoed = step.primitive
            yaws = [yaw for yaw in yaws if not math.isclose(yaw, vetoed.grip_yaw, abs_tol=1e-6)]
        if vetoed:
            x, y = self.seen.xy_m
            hopeless = f"the arm cannot {vetoed.name} at ({x:.3f}, {y:.3f}) m"
        raise Ended("unreachable", f"{wanted}{':' if vetoed else ', and'} {hopeless}")

    def _count(self) -> str:
        n = len(self.steps)
        return f"{n} action{'s' * (n != 1)}"

    def _where(self) -> str:
        parts = [f"{1000 * self.goal.distance_m(self.world.object_pose()[:2]):.1f} mm"]
        if self.goal.turn_rad is not None:
            parts.append(f"{math.degrees(abs(self._turn_left())):.1f}°")
        if self.goal.height_m is not None:
            parts.append(f"{1000 * abs(self._height_left()):.1f} mm in height")
        return f"{', '.join(parts)} from the goal after {self._count()}"

    def _give_up(self, part: str) -> None:
        raise Ended("gave_up", f"{self._where()}: the {part} is not what it should be")

    def _ended(self, status: str, message: str) -> ClosedLoopResult:
        """The loop as it ended, measured against the truth."""
        pose = self.world.object_pose()
        return ClosedLoopResult(
            goal=self.goal,
            status=status,
            message=message,
            distance_m=self.goal.distance_m(pose[:2]),
            steps=tuple(self.steps),
            object_paths_xy_m=tuple(self.paths),
            plans=tuple(self.moves.plans),
            seen_xy_m=tuple(self.places),
            end_pose=pose,
            happened=tuple(self.script.happened),
            vetoes=self.moves.vetoes,
            turn_error_rad=self._turn_left(),
            height_error_m=None if self.goal.height_m is None else self._height_left(),
        )
