"""A widget to pick a goal, see the plan, execute it in the world, and disturb it.

It is a view on plain objects: everything it does can be done with a planner, `execute_plan` and
`Tabletop.shove`.
"""

import itertools
import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any, Self

import ipywidgets as widgets
import numpy as np
from IPython.core.pylabtools import retina_figure
from matplotlib.figure import Figure

from affordlib import planning
from affordlib.geometry import unit_vector, wrap_angle
from affordlib.models import load_checkpoint
from affordlib.planning import (
    ClosedLoopConfig,
    PlanMode,
    Planner,
    PlanningProblem,
    Skills,
    run_closed_loop,
)
from affordlib.planning.gradient import Reading
from affordlib.show.picker_controls import PickerControls, outcome_in_words, plan_in_words
from affordlib.show.plots import NEUTRAL, plot_footprint, plot_plan, plot_table
from affordlib.show.scene import Scene
from affordlib.show.table_data import TableView, object_data, obstacle_data, plan_data, table_data
from affordlib.types import Goal, Obstacle, Outcome, Plan, check_count, check_on_table
from affordlib.world import Cuboid, Tabletop
from affordlib.world.trajectory import STEP_S

POSE_EVERY, SENT_TOGETHER = 12, 5
"""Simulation steps (1/240 s) between two poses of the shown motion, and poses in a message."""

LIMIT_M = 0.35
"""Largest coordinate of a goal [m]."""


class Stopped(Exception):
    """The user has pressed Stop."""


class GoalPicker(widgets.HBox):
    """The table from above, where a goal is picked by mouse or keyboard.

    planners: name → planner; while a hand drags the goal, the browser plans over the effect map,
    and when it lets go, the chosen planner does. seed: of the disturbances. searched: an empty
    list, in which a planner may leave lines (n, 2) [m] of its search.

    Methods do what mouse and buttons do, and return when done. A run shows each pose for `pace_s`
    seconds.
    """

    pace_s = POSE_EVERY * STEP_S

    def __init__(
        self,
        world: Tabletop,
        skills: Skills,
        planners: dict[str, Planner],
        goal_xy_m: tuple[float, float] = (0.12, 0.10),
        seed: int = 0,
        searched: list[np.ndarray] | None = None,
    ) -> None:
        self.world, self.skills, self.planners = world, skills, planners
        self._searched = [] if searched is None else searched
        self._executors = {"open loop": self._open_loop, "closed loop": self._closed_loop}
        self.plan: Plan | None = None
        self.outcome: Outcome | None = None
        self._rng = np.random.default_rng(check_count("seed", seed, least=0))
        self._first_pose = self._pose = self._plan_pose = world.object_pose()
        self._turn_from = self._pose[2]  # the yaw to which the goal's rotation is relative
        self._running = False
        self._planned_for: Goal | None = None  # what the chosen planner has last planned for
        self._answered = 0  # the number of the last goal from the page with a plan
        self._alone = threading.RLock()  # held while planning or moving something in the world
        self._queue = ThreadPoolExecutor(1)
        self._stop = threading.Event()
        self._disturbances: list[Callable[[], None]] = []  # until the action ends
        self._motions: list[list[float]] = []  # of object and hand, not yet sent
        self._trail: list[tuple[float, float]] = []  # of the object since the plan was made
        self._marks: list[list[Any]] = []  # moves of object and goal that were not planned
        self._shown_until = 0.0
        self._n_done, self._left = 0, []  # actions of the run, and steps of its plan to execute
        self._news = ""  # of disturbances, until the next action or plan
        self._view = TableView(table=table_data(skills))
        self.scene = Scene(world)
        self.goal = self._first_goal = Goal(check_on_table("goal_xy_m", goal_xy_m))
        self._other: Plan | None = None
        self.controls = PickerControls(list(planners), list(self._executors))
        self._listen()
        below = {"flex": "1 1 320px", "max_width": "640px"}
        table = widgets.VBox([self._view, self.controls.words], layout=below)
        layout = {"flex_flow": "row wrap", "grid_gap": "12px"}
        super().__init__([table, self.controls, self.scene], layout=layout)
        self.add_class("affordlib-picker")
        self._attempt(self._make_plan)

    @classmethod
    def demo(cls, goal_xy_m: tuple[float, float] = (0.12, 0.08), seed: int = 0) -> Self:
        """Make a picker for a box, with the shipped models and the three planners of page 06."""
        skills, world = Skills.load(), Tabletop()
        world.place(Cuboid(0.07, 0.05, 0.05), (0.0, 0.0), 0.3)
        paper = skills.models | {"push": load_checkpoint("cnp_500")[0]}
        published, reading = replace(skills, models=paper), Reading(starts=4)

        def gradient(problem):  # the paper's planner, with the paper's network
            known = replace(problem, effects=published.effects(problem.effects.image))
            return planning.plan_gradient(known, seed=seed, reading=reading)

        continuous = partial(planning.plan_continuous, seed=seed)
        planners = {"continuous": continuous, "A*": planning.plan_astar, "gradient": gradient}
        return cls(world, skills, planners, goal_xy_m, seed)

    def pick(self, x_m: float, y_m: float) -> None:
        """Set the goal [m], rounded to millimetres, and replan."""
        check_on_table("goal", (x_m, y_m))
        self._set_goal(self._goal_at((x_m, y_m)))
        self._update_plan()

    def run(self) -> None:
        """Execute the plan and show the outcome; the next plan starts from there."""
        self._refuse_while_running()
        self._set_running(True)
        self._run()

    def shove_object(self) -> None:
        """Shove the object 2 to 4 cm in a random direction; during a run, after this action."""
        self._disturb(self._shove)

    def move_goal(self) -> None:
        """Move the goal 4 to 8 cm in a random direction; during a run, after this action."""
        self._disturb(self._move_goal)

    def start_over(self) -> None:
        """Put object and goal back where they were when the picker was created."""
        self._refuse_while_running()
        (x, y, yaw), obstacles = self._first_pose, self.world.obstacles.all
        self._marks.clear()
        self.controls.turn.value = self.controls.height.value = 0.0
        self._set_goal(self._first_goal)
        self._disturb(partial(self.world.place, self.world.obj, (x, y), yaw, obstacles=obstacles))

    def figure(self) -> Figure:
        """The table, object, goal and plan as a figure."""
        figure = Figure(figsize=(5.2, 5.2), layout="constrained")
        plan = self.plan or Plan(self.goal, self._pose[:2], (), "none", False, 0.0)
        ends = [step.predicted_end_xy_m for step in plan.steps]
        points = np.array([self.goal.xy_m, *ends, self._pose[:2]])
        low, high = points.min(axis=0), points.max(axis=0)
        ax = plot_table(figure.subplots(), (low + high) / 2, 0.12 + float((high - low).max()) / 2)
        for x, y in (100 * np.transpose(line) for line in self._searched):
            ax.plot(x, y, "." if len(x) == 1 else "-", color=NEUTRAL, lw=0.6, ms=2, alpha=0.4)
        plot_footprint(ax, self.world.obj, self._pose[:2], self._pose[2])
        return plot_plan(ax, plan, obj=self.world.obj, yaw_rad=self._plan_pose[2]).figure

    def _repr_mimebundle_(self, **kwargs: object) -> tuple[dict[str, object], dict[str, object]]:
        """The widget, and for a page without a kernel a picture at twice the resolution."""
        picture, size = retina_figure(self.figure(), base64=True, bbox_inches=None)
        bundle = super()._repr_mimebundle_(**kwargs) | {"text/plain": type(self).__name__}
        return bundle | {"image/png": picture}, {"image/png": size}

    def _goal_at(self, xy_m: Any) -> Goal:
        """A goal at a position [m] in whole millimetres, with the sliders' turn and height."""
        turn_deg, height_cm = self.controls.turn.value, self.controls.height.value
        more = {"turn_rad": math.radians(turn_deg) or None, "height_m": height_cm / 100 or None}
        return Goal(np.round(xy_m, 3), **more)

    # Requests from the page

    def _listen(self) -> None:
        controls = self.controls

        def adopt():
            parts = ((tuple(o["corners"]), o["radius"], o["height"]) for o in self._view.obstacles)
            wanted = tuple(Obstacle(*each) for each in parts)
            if wanted != self.world.obstacles.all:
                self._disturb(partial(self._set_obstacles, wanted))

        self._view.observe(lambda _: self._follow(self._goal_at(self._view.wanted[:2])), "wanted")
        self._view.observe(lambda _: self._soon(adopt), "obstacles")
        self._view.on_msg(lambda _, message, __: getattr(controls, message["press"]).click())
        for choice in (controls.planner, controls.other, controls.early):
            choice.observe(lambda _: self._follow(self.goal), names="value")
        for slider in (controls.turn, controls.height):
            slider.observe(lambda _: self._follow(self._goal_at(self.goal.xy_m)), names="value")
        controls.run.on_click(lambda _: self._run_in_background())
        controls.stop.on_click(lambda _: self._stop.set())
        controls.shove.on_click(lambda _: self._soon(self.shove_object))
        controls.move_goal.on_click(lambda _: self._soon(self.move_goal))
        controls.start_over.on_click(lambda _: self._soon(self.start_over))

    def _soon(self, action: Callable[[], None]) -> None:
        """Run an action in the background, after all earlier ones; during a run, immediately."""
        if self._running:
            self._attempt(action)
        else:
            self._queue.submit(self._attempt, action)

    def _attempt(self, action: Callable[[], None]) -> None:
        """Run an action, and show an error as text."""
        try:
            action()
        except Exception as error:
            self.controls.say(f"**Error:** {str(error) or type(error).__name__}")

    def _run_in_background(self) -> None:
        """Execute the plan of the shown goal when it is ready; a second press is ignored."""
        if not self._running:
            self._set_running(True)
            self._queue.submit(self._attempt, self._run)

    def _follow(self, goal: Goal) -> None:
        """Set the goal, and soon show a plan for it, unless another one follows."""
        self._set_goal(goal)
        self._soon(self._update_plan)

    def _set_goal(self, goal: Goal) -> None:
        """Show a goal that has no plan yet, even if it equals the last one."""
        self.goal = replace(goal)
        if self._running:  # the executor gets it after this action
            self._answered = self._view.wanted[2]
        self._show(planning=not self._running)

    def _update_plan(self) -> None:
        """Plan for the shown goal, if it has no plan yet and the robot is idle."""
        if self._is_outdated() and not self._running:
            self._make_plan()

    def _is_outdated(self) -> bool:
        return self._planned_for is not self.goal

    def _planned(self, problem: PlanningProblem, planner: str = "") -> Plan:
        """A plan by the chosen planner, or another one, whose actions may stop early or not."""
        mode = PlanMode(problem.mode.max_steps, self.controls.early.value)
        return self.planners[planner or self.controls.planner.value](replace(problem, mode=mode))

    def _make_plan(self) -> None:
        with self._alone:
            self.controls.say(f"{self._news} Planning with {self.controls.planner.value} …")
            self._show(planning=True)
            goal, number, plan = self.goal, self._view.wanted[2], None
            self._other = None
            self._searched.clear()
            if self.world.arm.raised_m:  # put it down
                self.world.park()
            self._pose = self.world.object_pose()
            try:
                seen = self.world.depth_image(), self._pose[:2]
                problem = self.skills.problem(*seen, goal, obstacles=self.world.obstacles.all)
                plan, other = self._planned(problem), self.controls.other.value
                words = plan_in_words(plan)
                if other != "nothing":
                    self._other = self._planned(problem, other)
                    n, off_mm = len(self._other.steps), 1000 * self._other.predicted_distance_m
                    words += f" By {other}, dashed: {n} actions, {off_mm:.1f} mm."
                self.controls.say(f"{self._news} {words}")
                self._news = ""
                self._view.object = object_data(self.world.obj, problem.effects, self._pose[2])
            finally:
                self.plan, self.outcome = plan, None
                self._trail.clear()
                self._plan_pose, self._turn_from = self._pose, self._pose[2]
                self.scene.mark(self.goal, plan, self._turn_from)
                self._answered, self._planned_for = number, goal
                self._show(planning=self._is_outdated())

    # Execution

    def _refuse_while_running(self) -> None:
        if self._running:
            raise RuntimeError("the robot is still moving; press Stop or wait")

    def _set_running(self, running: bool) -> None:
        self._running = running
        self._stop.clear()
        self.controls.set_running(running)

    def _run(self) -> None:
        """Execute the plan, after making a new one if the shown one is outdated."""
        with self._alone:
            on_step = self.world.on_step
            try:
                if self._is_outdated() or self.plan is None or self.outcome is not None:
                    self._make_plan()
                plan, self._news = self.plan, ""
                self._n_done, self._left = 0, list(plan.steps)
                self._marks.clear()
                self._show()
                yaw, z = self.world.object_pose()[2], self.world.object_state()[2]
                self.scene.begin()
                self.world.on_step = partial(self._log, itertools.count(), z)
                paths, words, how = (), "", "Stopped after"
                with suppress(Stopped):
                    self._begin_action()
                    paths, words = self._executors[self.controls.executor.value](plan)
                    how = "Done,"
                pose = self.world.object_pose()
                moved = wrap_angle(pose[2] - yaw), self.world.object_state()[2] - z
                outcome = Outcome(plan, self.goal.distance_m(pose[:2]), pose, paths, *moved, words)
                self.outcome = outcome
                if self.plan.goal == self.goal or outcome.distance_m <= self.goal.tolerance_m:
                    self._planned_for = self.goal  # the run has followed it
                self.controls.say(*outcome_in_words(outcome, self.goal, how, self._n_done))
            except BaseException:  # an interruption, too
                self.plan, self._disturbances = None, []  # the next run plans from the current pose
                raise
            finally:
                self.world.on_step = on_step
                self._wait_until_shown()
                self.scene.stop()
                self._set_running(False)
                self._show()
            if self._is_outdated() or self._disturbances:  # by a hand that the run did not follow
                self._news = self.controls.said
                self._disturb()

    def _open_loop(self, plan: Plan) -> tuple[tuple[np.ndarray, ...], str]:
        """Execute a plan as it is; return the object's path (n, 2) [m] in each action, and words.

        Like the closed loop, it raises `Stopped` where Stop has been pressed.
        """
        paths = []
        for step in plan.steps:
            paths.append(self.world.execute(step).object_path[:, :2])
            self._end_action()
        return tuple(paths), ""

    def _closed_loop(self, plan: Plan) -> tuple[tuple[np.ndarray, ...], str]:
        """Observe after every action, and plan again until the object is within 2 mm of the goal.

        It begins with a plan of its own.
        """

        def exact():
            return replace(self.goal, tolerance_m=0.002)

        config = ClosedLoopConfig(on_action=self._end_action, on_plan=self._follow_new_plan)
        done = run_closed_loop(self.world, exact, self.skills, self._planned, config)
        words = "" if done.reached else f"The loop ended as {done.status}: {done.message}."
        return done.object_paths_xy_m, words

    def _follow_new_plan(self, plan: Plan) -> None:
        self._left, self.plan = list(plan.steps), replace(plan, goal=self.goal)
        self._pose = self._plan_pose = self.world.object_pose()
        self._news += " New plan." * (self._n_done > 0)
        self._show()
        self.scene.mark(self.goal, plan, self._turn_from)

    def _end_action(self, *_: object) -> None:
        """Apply pending disturbances, and announce the next action."""
        self._n_done += 1
        del self._left[:1]
        self._wait_until_shown()
        while self._disturbances and not self._stop.is_set():
            self._disturbances.pop(0)()
        self._begin_action()

    def _begin_action(self) -> None:
        """Announce the next action; raises `Stopped` instead where Stop has been pressed."""
        if self._stop.is_set():
            raise Stopped
        if self._left:
            name, k = self._left[0].primitive.name.capitalize().replace("_", " "), self._n_done + 1
            self.controls.say(f"{name} {k} of {self._n_done + len(self._left)} …{self._news}")
            self._news = ""

    def _log(self, steps: Iterator[int], z_m: float, world: Tabletop) -> None:
        """Log a step of the simulation, and send what is logged; z_m: the object's first height."""
        self.scene(world)
        if next(steps) % POSE_EVERY == 0:
            pose, lift = world.object_pose(), world.object_state()[2] - z_m
            motion = [*pose, lift, *world.arm.tool_pose(), *self.scene.poses().flat]
            self._motions.append(np.round(motion, 4).tolist())
            self._trail.append(pose[:2])
            if len(self._trail) == 1 or len(self._motions) == SENT_TOGETHER:
                self._send_motions()

    def _send_motions(self) -> None:
        """Send the motions logged since the last call, to be shown as they come."""
        if self._motions:
            first = len(self._motions) == len(self._trail)
            bodies = [self.scene.name, [one.id for one in self.scene.bodies]]
            self._view.send({"motions": self._motions, "first": first, "bodies": bodies})
            from_s = max(self._shown_until, time.monotonic())
            self._shown_until = from_s + self.pace_s * len(self._motions)
            self._motions = []

    def _wait_until_shown(self) -> None:
        self._send_motions()
        self._stop.wait(self._shown_until - time.monotonic())
        self._pose, self._shown_until = self.world.object_pose(), 0.0

    # Disturbances

    def _disturb(self, *disturbances: Callable[[], None]) -> None:
        self._disturbances += disturbances
        if not self._running:
            with self._alone:
                pending, self._disturbances = self._disturbances, []  # if one raises, none is left
                for disturbance in pending:
                    disturbance()
                    self.scene.place()
                self._make_plan()

    def _shove(self) -> None:
        dx, dy = self._displacement(self.world.object_pose()[:2], 0.02, 0.04)
        before = self.world.object_pose()[:2]
        self.world.shove(dx, dy, float(self._rng.uniform(-0.5, 0.5)))
        self._pose = self.world.object_pose()
        self._marks.append([before, self._pose[:2]])
        self._show()
        self._news += f" The object was shoved by {1000 * np.hypot(dx, dy):.0f} mm."

    def _move_goal(self) -> None:
        by = self._displacement(self.goal.xy_m, 0.04, 0.08)
        goal = self._goal_at(self.goal.xy_m + by)
        self._marks.append([self.goal.xy_m, goal.xy_m])
        self._set_goal(goal)
        self._news += f" The goal was moved by {1000 * np.hypot(*by):.0f} mm."

    def _set_obstacles(self, obstacles: Sequence[Obstacle]) -> None:
        try:
            self.world.set_obstacles(obstacles)
            self._planned_for = None
        finally:
            self._view.obstacles = [obstacle_data(one) for one in self.world.obstacles.all]

    def _displacement(self, xy_m: tuple[float, float], least_m: float, most_m: float) -> np.ndarray:
        """A random displacement (2,) [m], reversed where it would leave the shown area."""
        by = self._rng.uniform(least_m, most_m) * unit_vector(self._rng.uniform(0, 2 * np.pi))
        return np.where(np.abs(np.add(xy_m, by)) < LIMIT_M, by, -np.copysign(by, xy_m))

    def _show(self, planning: bool = False) -> None:
        yaw = None if self.goal.turn_rad is None else self._turn_from + self.goal.turn_rad
        shown = () if planning else self._searched
        self._view.searched = [np.round(line, 4).tolist() for line in shown]
        self._view.scene = {
            "pose": self._pose,
            "goal": {"xy": self.goal.xy_m, "tolerance": self.goal.tolerance_m, "yaw": yaw},
            "steps": plan_data(self.plan, self._plan_pose[2]) if self.plan else [],
            "other": plan_data(self._other, self._plan_pose[2]) if self._other else [],
            "partial": self.controls.early.value,
            "trail": list(self._trail),
            "marks": list(self._marks),
            "answered": self._answered,
            "running": self._running,
            "planning": planning,
            "pace": self.pace_s,
        }
