"""A widget to pick a goal, see the plan, execute it in the world, and disturb it.

It is a view on plain objects: everything it does can be done with a planner, `execute_plan` and
`Tabletop.shove`.
"""

import itertools
import math
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import ipywidgets as widgets
import numpy as np

from affordlib.geometry import unit_vector, wrap_angle
from affordlib.paths import resolve_out_dir
from affordlib.planning import Planner, Skills
from affordlib.results import load_plan, save_plan
from affordlib.show.drawing import Drawing, WithPicture
from affordlib.show.executors import Executor, Stopped, closed_loop, measured, open_loop
from affordlib.show.table_view import (
    HALF_WIDTH_M,
    LIMIT_M,
    PickerControls,
    draw_goal,
    draw_ground,
    draw_object,
    draw_path,
    draw_plan,
    outcome_in_words,
    plan_in_words,
    to_mm,
)
from affordlib.types import Goal, Outcome, Plan, check_count, check_on_table
from affordlib.world import Tabletop

REST_S = 0.05
"""Time [s] without motion of the goal after which a drag counts as finished."""

POSE_EVERY = 12
"""Simulation steps (1/240 s) between two poses of the animated motion."""

_MOVED = 1e-4
_LABEL = (
    "Table from above. The goal is at x = {:.1f}, y = {:.1f} cm, the object at x = {:.1f}, y = "
    "{:.1f} cm. Arrow keys move the goal by 1 cm, with Shift by 1 mm; Enter runs the plan, Escape "
    "stops it."
)


class GoalPicker(WithPicture, widgets.HBox):
    """The table from above, where a goal is picked by mouse, keyboard or sliders.

    skills: what the robot can do. planners: name → function of a `PlanningProblem` that returns a
    plan. draft: a fast planner whose plan is shown while the goal is dragged; the chosen planner's
    plan replaces it afterwards. seed: of the disturbances. folder: where plans are saved.

    `executors`: name → function (world, plan, planner, report) → Outcome that executes a plan, or
    replans with the planner that made it; see `executors.Report`. `goal`, `plan` and `outcome` are
    those shown. Methods do what mouse and buttons do, and return
    when done; mouse and buttons queue it in the background, *Run* with `seconds_per_action`.
    """

    seconds_per_action = 1.2

    def __init__(
        self,
        world: Tabletop,
        skills: Skills,
        planners: dict[str, Planner],
        goal_xy_m: tuple[float, float] = (0.12, 0.10),
        draft: Planner | None = None,
        seed: int = 0,
        folder: str = "runs/lab",
    ) -> None:
        self.world, self.skills, self.planners = world, skills, planners
        self.draft, self.folder = draft, folder
        self.executors: dict[str, Executor] = {
            "open loop": open_loop,
            "closed loop": closed_loop(skills),
        }
        self.plan: Plan | None = None
        self.outcome: Outcome | None = None
        self._rng = np.random.default_rng(check_count("seed", seed, least=0))
        self._first_pose = self._pose = self._plan_pose = world.object_pose()
        self._turn_from = self._pose[2]  # the yaw to which the goal's rotation is relative
        self._running = self._lifted = False
        self._stale = True  # the shown plan is not the chosen planner's for the shown goal
        self._answered = 0  # the number of the last goal from the page with a plan
        self._alone = threading.RLock()  # held while planning or moving something in the world
        self._queue = ThreadPoolExecutor(1)
        self._goal_moved, self._stop = threading.Event(), threading.Event()
        self._disturbances: list[Callable[[], None]] = []  # pending until the action ends
        self._poses: list[tuple[float, ...]] = []  # of the object since the last action
        self._paths: list[np.ndarray] = []  # of the object since the plan was made
        self._news = ""  # of disturbances, until the next action or plan
        self._view = Drawing(keyboard=True)
        self._view.add_class("affordlib-table")
        goal = Goal(_whole_mm(check_on_table("goal_xy_m", goal_xy_m)))
        self.controls = PickerControls(goal, list(planners), list(self.executors), self._follow)
        self._listen()
        below = [self._view, self.controls.progress, self.controls.words]
        table = widgets.VBox(below, layout={"flex": "1 1 300px", "max_width": "480px"})
        layout = {"flex_flow": "row wrap", "grid_gap": "12px"}
        super().__init__([table, self.controls], layout=layout)
        self.add_class("affordlib-picker")
        for _ in range(2):  # what is slow only once is then not part of the time shown
            self._attempt(self._make_plan)

    @property
    def goal(self) -> Goal:
        """The shown goal."""
        return self.controls.goal

    def pick(self, x_m: float, y_m: float) -> None:
        """Set the goal [m], rounded to millimetres, and replan."""
        self._set_goal(replace(self.goal, xy_m=_whole_mm((x_m, y_m))))
        self._update_plan()

    def set_pose(self, turn_deg: float = 0.0, height_cm: float = 0.0) -> None:
        """Set rotation and height of the goal (0: not part of the goal), and replan."""
        turn, height = math.radians(turn_deg) or None, height_cm / 100 or None
        self._set_goal(replace(self.goal, turn_rad=turn, height_m=height))
        self._update_plan()

    def run(self) -> None:
        """Execute the plan and show the outcome; the next plan starts from there."""
        self._refuse_while_running()
        self._set_running(True)
        self._run(seconds_per_action=0.0)

    def stop(self) -> None:
        """Stop after the current action."""
        self._stop.set()

    def shove_object(self) -> None:
        """Shove the object 2 to 4 cm in a random direction; during a run, after this action."""
        self._disturb(self._shove)

    def move_goal(self) -> None:
        """Move the goal 4 to 8 cm in a random direction; during a run, after this action."""
        self._disturb(self._move_goal)

    def start_over(self) -> None:
        """Put the object back where it was when the picker was created."""
        self._refuse_while_running()
        with self._alone:
            x, y, yaw = self._first_pose
            self.world.place(self.world.obj, (x, y), yaw)
            self._make_plan()

    def save(self, name: str = "plan.json") -> None:
        """Save the plan and its goal as JSON in the picker's folder."""
        path = self._file(name)
        self._update_plan()
        if self.plan is None:
            raise RuntimeError("there is no plan to save; pick another goal first")
        save_plan(path, self.plan)
        self.controls.say(f"Saved the plan as {self.folder}/{name}.")

    def load(self, name: str = "plan.json") -> None:
        """Show a saved plan with its goal, ready to be executed."""
        self._refuse_while_running()
        plan = load_plan(self._file(name))
        with self._alone:
            self._set_goal(plan.goal)
            self._put_down()
            self._begin(plan)
            away_m = math.dist(plan.start_xy_m, self._pose[:2])
            note = f" The object is {1000 * away_m:.0f} mm from the start of this plan."
            self.controls.say(f"Loaded. {plan_in_words(plan)}{note if away_m > 0.002 else ''}")
            self._stale = False
            self._show()

    def picture(self) -> str:
        """The shown drawing, as an SVG."""
        scene = self._view.scene
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{scene["box"]}" width="480" '
            'role="img" aria-label="The table from above, with goal and plan" '
            f'style="background: white; font-family: sans-serif"><style>{Drawing._css}</style>'
            f'<g class="affordlib-table">{scene["inside"]}</g></svg>'
        )

    # Requests from the page

    def _listen(self) -> None:
        controls = self.controls

        def place(change):
            _, x, y, _ = change["new"]
            self._follow(replace(self.goal, xy_m=_whole_mm((x / 1000, -y / 1000))))

        self._view.observe(place, names="wanted")
        presses = {"run": self._run_in_background, "stop": self.stop}
        self._view.on_msg(lambda _, message, __: presses[message["press"]]())
        controls.planner.observe(lambda _: self._follow(self.goal), names="value")
        controls.run.on_click(lambda _: self._run_in_background())
        controls.stop.on_click(lambda _: self.stop())
        for button, action in {
            controls.shove: self.shove_object,
            controls.move_goal: self.move_goal,
            controls.start_over: self.start_over,
            controls.save: lambda: self.save(controls.name.value),
            controls.load: lambda: self.load(controls.name.value),
        }.items():
            button.on_click(lambda _, action=action: self._soon(action))

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
            self._queue.submit(self._attempt, partial(self._run, self.seconds_per_action))
            self._queue.submit(self._attempt, self._plan_after_run)

    def _plan_after_run(self) -> None:
        """Show a plan from here if the goal was moved and the run did not follow it."""
        if self._stale and self.outcome is not None:
            self._news = self.controls.said
            self._update_plan()

    def _follow(self, goal: Goal) -> None:
        """Set the goal; soon show a draft for it, and the full plan when the drag is finished."""
        goal = replace(goal)  # a new object, which identifies this request
        self._set_goal(goal)

        def plan():
            self._goal_moved.clear()
            if goal is not self.goal or self._running:
                return
            if self.draft is not None:
                self._make_plan(draft=True)
                if self._goal_moved.wait(REST_S):
                    return
            self._update_plan()

        if not self._running:
            self._soon(plan)

    # Goals and plans

    def _set_goal(self, goal: Goal) -> None:
        """Show a goal that has no plan yet."""
        self.controls.show(goal)
        self._stale = True
        self._goal_moved.set()
        if self._running:  # the executor gets it after this action
            self._answered = self._view.wanted[3]
        if self._running or self.draft is None:
            self._show(planning=not self._running)

    def _update_plan(self) -> None:
        """Plan for the shown goal, if it has no plan yet and the robot is idle."""
        if self._stale and not self._running:
            self._make_plan()

    def _make_plan(self, draft: bool = False) -> None:
        with self._alone:
            self.controls.say(f"{self._news} Planning with {self.controls.planner.value} …")
            if not draft:
                self._show(planning=True)
            planner = self.draft if draft else self._planner()
            goal, number, plan = self.goal, self._view.wanted[3], None
            self._put_down()
            try:
                plan = planner(self.skills.problem(self.world.depth_image(), self._pose[:2], goal))
                if not draft:  # whose words belong to another planner
                    self.controls.say(f"{self._news} {plan_in_words(plan)}")
                    self._news = ""
            finally:
                self._begin(plan)
                self._answered = number
                self._stale = draft or goal is not self.goal
                self._show(draft, planning=goal is not self.goal)

    def _put_down(self) -> None:
        """Prepare the table for a new plan."""
        self.controls.show_progress(0)
        if self._lifted:
            self.world.park()
            self._lifted = False
        self._pose = self.world.object_pose()

    def _begin(self, plan: Plan | None) -> None:
        """Show a plan that starts at the object's current pose."""
        self.plan, self.outcome = plan, None
        self._poses.clear()
        self._paths.clear()
        self._plan_pose, self._turn_from = self._pose, self._pose[2]

    def _planner(self) -> Planner:
        return self.planners[self.controls.planner.value]

    # Execution

    def _refuse_while_running(self) -> None:
        if self._running:
            raise RuntimeError("the robot is still moving; press Stop or wait")

    def _set_running(self, running: bool) -> None:
        self._running = running
        self._stop.clear()
        self.controls.set_running(running)

    def _run(self, seconds_per_action: float) -> None:
        """Execute the plan, after making a new one if the shown one is outdated."""
        done, left = 0, []

        def report(plan=None):
            nonlocal done
            if plan is not None:
                left[:] = plan.steps
                self._replace_plan(plan, done)
                return self.goal
            done += 1
            name, of = left.pop(0).primitive.name if left else "action", done + len(left)
            self.controls.show_progress(done, of)
            self.controls.say(f"{name.replace('_', ' ').capitalize()} {done} of {of}.{self._news}")
            self._news = ""
            self._play(seconds_per_action)
            while self._disturbances and not self._stop.is_set():
                self._disturbances.pop(0)()
            if self._stop.is_set():
                raise Stopped
            return self.goal

        with self._alone:
            on_step = self.world.on_step
            try:
                if self._stale or self.plan is None or self.outcome is not None:
                    self._make_plan()
                left[:], self._news = self.plan.steps, ""
                yaw, z = self.world.object_pose()[2], self.world.object_state()[2]
                self.world.on_step = self._pose_log(on_step)
                try:
                    if self._stop.is_set():
                        raise Stopped
                    execute = self.executors[self.controls.executor.value]
                    outcome = execute(self.world, self.plan, self._planner(), report)
                    how = "Done,"
                    self.controls.show_progress(1)
                except Stopped:
                    outcome, how = measured(self.world, self.plan), "Stopped after"
                turned = wrap_angle(self.world.object_pose()[2] - yaw)
                lifted = self.world.object_state()[2] - z
                outcome = replace(outcome.with_goal(self.goal), turned_rad=turned, lifted_m=lifted)
                self.outcome, self._lifted = outcome, bool(self.goal.height_m)
                if self.plan.goal == self.goal or outcome.distance_m <= self.goal.tolerance_m:
                    self._stale = False  # the run has followed the goal
                self.controls.say(*outcome_in_words(outcome, self.goal, how, done))
            except Exception:
                self.plan = None  # the next run plans from the current pose
                raise
            finally:
                self.world.on_step = on_step
                self._disturbances.clear()
                self._play(0.0)
                self._pose = self.world.object_pose()
                self._set_running(False)
                self._show()

    def _replace_plan(self, plan: Plan, done: int) -> None:
        """Show a plan that was made during a run, after `done` actions."""
        arrives = self.goal.distance_m(plan.predicted_end_xy_m) <= self.goal.tolerance_m
        self.plan = plan = replace(plan, goal=self.goal, reaches_goal=arrives)
        self._pose = self.world.object_pose()
        self._plan_pose = (*plan.start_xy_m, self._pose[2])
        self._news += " New plan." * (done > 0)
        self._show()

    def _pose_log(self, also: Callable[[Tabletop], None] | None) -> Callable[[Tabletop], None]:
        """Make a callback for the world's steps that logs the object's poses and calls another."""
        steps = itertools.count()

        def log(world):
            if also is not None:
                also(world)
            if next(steps) % POSE_EVERY == 0:
                self._poses.append(world.object_pose())

        return log

    def _play(self, seconds: float) -> None:
        """Animate the poses logged since the last call, from the first motion to the last."""
        poses = np.array(self._poses).reshape(-1, 3)
        self._poses.clear()
        moves = np.flatnonzero(np.abs(np.diff(poses, axis=0)).max(axis=1, initial=0.0) > _MOVED)
        if len(moves):
            poses = poses[moves[0] : moves[-1] + 2]
            drawn = (poses * (1000, -1000, -180 / np.pi)).round(2)
            self._view.playback = {"poses": drawn.tolist(), "seconds": seconds}
            self._stop.wait(seconds)
            self._paths.append(poses[:, :2])
            self._pose = tuple(poses[-1])

    # Disturbances

    def _disturb(self, disturbance: Callable[[], None]) -> None:
        if self._running:
            self._disturbances.append(disturbance)
            return
        with self._alone:
            disturbance()
            self._make_plan()

    def _shove(self) -> None:
        dx, dy = self._displacement(self.world.object_pose()[:2], 0.02, 0.04)
        self.world.shove(dx, dy, float(self._rng.uniform(-0.5, 0.5)))
        self._pose = self.world.object_pose()
        self._poses.clear()
        self._show()
        self._news += f" The object was shoved by {1000 * np.hypot(dx, dy):.0f} mm."

    def _move_goal(self) -> None:
        by = self._displacement(self.goal.xy_m, 0.04, 0.08)
        self._set_goal(replace(self.goal, xy_m=_whole_mm(self.goal.xy_m + by)))
        self._news += f" The goal was moved by {1000 * np.hypot(*by):.0f} mm."

    def _displacement(self, xy_m: tuple[float, float], least_m: float, most_m: float) -> np.ndarray:
        """A random displacement (2,) [m], reversed where it would leave the shown area."""
        by = self._rng.uniform(least_m, most_m) * unit_vector(self._rng.uniform(0, 2 * np.pi))
        inside = np.abs(np.add(xy_m, by)) < LIMIT_M
        return np.where(inside, by, -np.copysign(by, xy_m))

    # Drawing

    def _show(self, draft: bool = False, planning: bool = False) -> None:
        obj, edge = self.world.obj, 1000 * HALF_WIDTH_M
        x, y = to_mm(self.goal.xy_m)
        limits = {"left": -1000 * LIMIT_M, "right": 1000 * LIMIT_M}
        limits |= {"top": limits["left"], "bottom": limits["right"], "step": 1}
        steps = self.plan.steps if self.plan else ()
        plan, labels = draw_plan(obj, steps, self._plan_pose, self.goal)
        drawing = [
            draw_ground(),
            draw_object(obj, self._pose),
            plan,
            *(draw_path(path, "truth") for path in self._paths),
            f'<polyline class="trail"/><g data-handle="goal" transform="translate({x} {y})">',
            draw_goal(obj, self.goal, self._turn_from),
            f'</g>{labels}<text class="busy" y="{40 - edge}">{"planning …" * planning}</text>',
        ]
        self._view.label = _LABEL.format(*np.multiply(100, (*self.goal.xy_m, *self._pose[:2])))
        self._view.scene = {
            "inside": "".join(drawing),
            "box": f"{-edge} {-edge} {2 * edge} {2 * edge}",
            "handles": [{"name": "goal", "x": x, "y": y, "anywhere": True} | limits],
            "answered": self._answered,
            "running": self._running,
            "draft": draft,
            "planning": planning,
        }

    def _file(self, name: str) -> Path:
        """Path of a plan in the folder; ValueError for a name that is not a plain file name."""
        if not name or name in (".", "..") or Path(name).name != name or "\\" in name:
            raise ValueError(f"name must be a plain file name such as plan.json, got {name!r}")
        return resolve_out_dir(self.folder) / name


def _whole_mm(xy_m: Any) -> tuple[float, float]:
    """Round a position [m] to whole millimetres."""
    x, y = np.round(xy_m, 3).tolist()
    return x, y
