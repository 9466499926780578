"""Pick a goal by hand, see the plan redrawn, run it in the world, disturb it.

A view on plain objects: everything it does can be done with a planner, `execute_plan` and
`Tabletop.shove`.
"""

from __future__ import annotations

import asyncio
import html
import math
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import ipywidgets as widgets
import numpy as np

from affordlib.paths import resolve_out_dir
from affordlib.plan_files import load_plan, plan_file, save_plan
from affordlib.planning import execute_plan
from affordlib.primitives import wrap_angle
from affordlib.show.executors import Executor, Planner, Stopped, open_loop
from affordlib.show.figure_widget import Pictured
from affordlib.show.picker_controls import PickerControls, outcome_in_words, plan_in_words
from affordlib.show.plots import table_picture
from affordlib.show.table_view import (
    TableView,
    draw_way,
    make_scene,
    moving_part,
    pose_recorder,
    rounded,
    whole_mm,
)
from affordlib.types import Goal, Outcome, Plan, check_count, check_on_table
from affordlib.world import Tabletop

HALF_WIDTH_M, LIMIT_M = 0.36, 0.35
REST_S = 0.05
"""A hand that has asked for nothing new for so long has come to rest."""


class GoalPicker(Pictured, widgets.VBox):
    """The table from above, where a goal is picked by mouse, keyboard or sliders.

    planners: name → function (image, start_xy_m, goal) → Plan. executors: name → function (world,
    plan, planner, tell) → Outcome that carries a plan out, or plans again with the planner that
    made it; see `Tell`. `Stopped` is to be let through. The default is `open_loop` alone. draft: a
    quick planner whose plan is shown while the hand moves the goal; that of the chosen one takes
    its place when the hand rests. seed: of the disturbances. folder: where plans are saved.

    `plan` and `outcome` hold what is shown; `pick`, `ask_pose`, `run`, `stop`, `shove_object`,
    `move_goal`, `start_over`, `save` and `load` do what mouse and buttons do, and return when done.
    What mouse and buttons ask for is done in the background, one after the other, *Run* at a pace
    that can be watched; leave the world alone until it is done.
    """

    def __init__(
        self,
        world: Tabletop,
        planners: dict[str, Planner],
        goal_xy_m: tuple[float, float] = (0.12, 0.10),
        *,
        executors: dict[str, Executor] | None = None,
        draft: Planner | None = None,
        seed: int = 0,
        seconds_per_action: float = 1.2,
        folder: str = "runs/lab",
    ) -> None:
        self.world, self.planners = world, planners
        self.executors, self.draft = executors or {"open loop": open_loop}, draft
        self.seconds_per_action, self.folder = seconds_per_action, folder
        self.plan: Plan | None = None
        self.outcome: Outcome | None = None
        self._rng = np.random.default_rng(check_count("seed", seed, least=0))
        self._pose = self._start = self._first_pose = world.object_pose()
        self._turn_from = self._pose[2]  # what a wanted turn is counted from
        self._goal = Goal(whole_mm(*check_on_table("goal_xy_m", goal_xy_m)))
        self._running = self._setting = self._lifted = False
        self._owed = False  # a plan of the chosen planner, for the goal that is shown
        self._asked = self._answered = 0  # numbers of goals: only the last is planned for
        self._alone = threading.RLock()
        self._queue = PageQueue(
            lambda why: self.controls.say(f"<b>This did not work:</b> {html.escape(why)}")
        )
        self._stop = threading.Event()
        self._waiting: list[Callable[[], None]] = []
        self._poses: list[tuple[float, ...]] = []  # of the film since the last action
        self._walked: list[np.ndarray] = []  # the object's paths since the plan was made
        super().__init__(self._build())
        self.add_class("affordlib-picker")
        self._queue.attempt(self._make_plan)

    def pick(self, x_m: float, y_m: float) -> None:
        """Set the goal [m], to the nearest millimetre, and make the plan anew."""
        self._ask_for(replace(self._goal, xy_m=whole_mm(x_m, y_m)))
        self._settle()

    def ask_pose(self, turn_deg: float = 0.0, height_cm: float = 0.0) -> None:
        """Ask for a turn and a height beside the position; 0 asks for none. Plans anew."""
        self._ask_for(self._posed_goal(turn_deg, height_cm))
        self._settle()

    def run(self) -> None:
        """Carry the plan out and show what came of it; the next plan starts from there."""
        self._refuse_while_running()
        self._set_running(True)
        self._run(seconds_per_action=0.0)

    def stop(self) -> None:
        """Let the action that is under way end, and carry out nothing more."""
        self._stop.set()

    def shove_object(self) -> None:
        """Disturb: shove the object 2 to 4 cm to some side; while running, after this action."""
        self._disturb(self._shove)

    def move_goal(self) -> None:
        """Disturb: move the goal 4 to 8 cm to some side; while running, after this action."""
        self._disturb(self._move_goal)

    def start_over(self) -> None:
        """Put the object back where it stood when the picker was made."""
        self._refuse_while_running()
        x, y, yaw = self._first_pose
        self.world.place(self.world.obj, (x, y), yaw)
        self._make_plan()

    def save(self, name: str = "plan.json") -> None:
        """Save the plan and its goal as JSON in the picker's folder."""
        path = plan_file(resolve_out_dir(self.folder), name)
        self._settle()
        if self.plan is None:
            raise RuntimeError("there is no plan to save; pick a goal that can be planned for")
        save_plan(path, self.plan)
        self.controls.say(f"Saved the plan as {html.escape(f'{self.folder}/{name}')}.")

    def load(self, name: str = "plan.json") -> None:
        """Show a saved plan with its goal, to be run as it is."""
        self._refuse_while_running()
        plan = load_plan(plan_file(resolve_out_dir(self.folder), name))
        self._let_go()
        self._set_goal(plan.goal)
        self._pose, self.plan, self.outcome = self.world.object_pose(), plan, None
        self._start, self._turn_from = (*plan.start_xy_m, self._pose[2]), self._pose[2]
        self._walked.clear()
        away_m = np.hypot(*np.subtract(plan.start_xy_m, self._pose[:2]))
        note = f" The object is {1000 * away_m:.0f} mm from where this plan starts."
        self.controls.say(f"Loaded. {plan_in_words(plan)}{note if away_m > 0.002 else ''}")
        self._owed = False
        self._show()

    def _posed_goal(self, turn_deg: float, height_cm: float) -> Goal:
        turn = math.radians(turn_deg) if turn_deg else None
        height = height_cm / 100 if height_cm else None
        return replace(self._goal, turn_rad=turn, height_m=height)

    def _ask_for(self, goal: Goal) -> None:
        """A new goal, for which there is no plan yet."""
        self._set_goal(goal)
        self._owed, self._asked = True, self._asked + 1
        if self._running:  # the executor is told of it after this action
            self._answered = self._view.asked[2]
        if self._running or self.draft is None:
            self._show(planning=not self._running)

    def _follow(self, x_m: float, y_m: float) -> None:
        """Pick as the hand moves: a draft at once, where there is one, and the plan when it rests.

        Where no page waits for an answer (a script) there is the plan at once.
        """
        self._ask_for(replace(self._goal, xy_m=whole_mm(x_m, y_m)))
        if self.draft is None or not self._queue.page_waits():
            return self._queue.do(self._settle)
        number = self._asked

        def rest():
            if number == self._asked:
                self._settle()

        def follow():
            if self._owed and number == self._asked and not self._running:
                try:
                    self._make_plan(self.draft)
                finally:
                    self._queue.put(rest, REST_S)

        self._queue.put(follow)

    def _settle(self) -> None:
        """Plan for the goal that is shown, where that is owed; what runs hears of it later."""
        if self._owed and not self._running:
            self._make_plan()

    def _make_plan(self, draft: Planner | None = None) -> None:
        with self._alone:
            if draft is None:
                self._show(planning=True)
            planner, plan = draft or self.planners[self.controls.planner.value], None
            goal, number = self._goal, self._view.asked[2]
            self._let_go()
            self._pose = self._start = self.world.object_pose()
            self._turn_from = self._pose[2]
            self._owed = draft is not None
            try:
                plan = planner(self.world.depth_image(), self._pose[:2], goal)
                self.controls.say(plan_in_words(plan))
            finally:
                self.plan, self.outcome = plan, None
                self._owed, self._answered = self._owed or goal != self._goal, number
                self._walked.clear()
                self._show(draft is not None, planning=goal != self._goal)

    def _let_go(self) -> None:
        """Put down what the last run has lifted."""
        if self._lifted:
            self.world.park()
            self._lifted = False
            self._poses.clear()

    def _set_goal(self, goal: Goal) -> None:
        """Set the goal everywhere; the sliders are told, and what they echo is not listened to."""
        self._setting = True
        try:
            self._goal = goal
            self.controls.show(goal)
        finally:
            self._setting = False

    def _refuse_while_running(self) -> None:
        if self._running:
            raise RuntimeError("the robot is still at work; press Stop or wait")

    def _run(self, seconds_per_action: float) -> None:
        planner, before, done = self.planners[self.controls.planner.value], self.world.on_step, 0

        def tell(plan=None):
            nonlocal done
            if plan is not None:
                self._follow_plan(plan, done)
                return self._goal
            done += 1
            self.controls.show_progress(done)
            self._play(seconds_per_action)
            while self._waiting and not self._stop.is_set():
                self._waiting.pop(0)()
            if self._stop.is_set():
                raise Stopped
            return self._goal

        self._alone.acquire()
        try:
            if self._owed or self.plan is None or self.outcome is not None:
                self._make_plan()
            self.controls.show_progress(0, max(1, len(self.plan.steps)))
            yaw, z = self.world.object_pose()[2], self.world.object_state()[2]
            self.world.on_step = pose_recorder(self._poses, before)
            try:
                execute = self.executors[self.controls.executor.value]
                if self._stop.is_set():
                    raise Stopped
                outcome, how = execute(self.world, self.plan, planner, tell), "Done,"
                self.controls.show_progress(done, max(1, done))
            except Stopped:
                outcome, how = (
                    execute_plan(self.world, replace(self.plan, steps=())),
                    "Stopped after",
                )
            self.outcome = replace(
                outcome.with_goal(self._goal),
                turned_rad=wrap_angle(self.world.object_pose()[2] - yaw),
                lifted_m=self.world.object_state()[2] - z,
            )
            self._lifted = bool(self._goal.height_m)
            if self.plan.goal == self._goal or self.outcome.distance_m <= self._goal.tolerance_m:
                self._owed = False  # it has followed a goal that was moved
            self.controls.say(outcome_in_words(self.outcome, self._goal, how, done))
        except Exception:
            self.plan = None  # the next run plans from where this one broke off
            raise
        finally:
            self.world.on_step = before
            self._waiting.clear()
            self._play(0.0)
            self._pose = self.world.object_pose()
            self._set_running(False)
            self._show()
            self._alone.release()

    def _follow_plan(self, plan: Plan, done: int) -> None:
        """Show a plan that was made on the way, after so many actions."""
        arrives = self._goal.distance_m(plan.predicted_end_xy_m) <= self._goal.tolerance_m
        self.plan = plan = replace(plan, goal=self._goal, reaches_goal=arrives)
        self._pose = self.world.object_pose()
        self._start = (*plan.start_xy_m, self._pose[2])
        self.controls.show_progress(done, done + len(plan.steps))
        so_far = f"On the way, after {done} action{'s' * (done != 1)}."
        self.controls.say(f"{so_far} {plan_in_words(plan)}")
        self._show()

    def _play(self, seconds: float) -> None:
        """Play what was filmed since the last time; a film of an object at rest is skipped."""
        poses = moving_part(self._poses)
        self._poses.clear()
        if len(poses):
            self._view.film = {"poses": rounded(poses), "seconds": seconds}
            self._stop.wait(seconds)
            self._walked.append(poses[:, :2])
            self._pose = tuple(poses[-1])

    def _set_running(self, running: bool) -> None:
        self._running = running
        self._stop.clear()
        self.controls.set_running(running)

    def _disturb(self, disturbance: Callable[[], None]) -> None:
        if self._running:
            self._waiting.append(disturbance)
            return
        with self._alone:
            disturbance()
            self._make_plan()

    def _shove(self) -> None:
        dx, dy = draw_way(self._rng, self.world.object_pose()[:2], 0.02, 0.04, LIMIT_M)
        self.world.shove(dx, dy, float(self._rng.uniform(-0.5, 0.5)))
        self._pose = self.world.object_pose()
        self._poses.clear()
        self._show()
        self.controls.say(f"The object was shoved by {1000 * np.hypot(dx, dy):.0f} mm.")

    def _move_goal(self) -> None:
        dx, dy = draw_way(self._rng, self._goal.xy_m, 0.04, 0.08, LIMIT_M)
        x, y = self._goal.xy_m
        self._set_goal(replace(self._goal, xy_m=whole_mm(x + dx, y + dy)))
        self._show()
        self.controls.say(f"The goal was moved by {1000 * np.hypot(dx, dy):.0f} mm.")

    def _build(self) -> list[widgets.Widget]:
        self._view = TableView(layout={"width": "480px", "max_width": "100%"})
        self.controls = controls = PickerControls(
            self._goal, list(self.planners), list(self.executors), LIMIT_M
        )
        for slider in (controls.x, controls.y):
            slider.observe(self._slid, names="value")
        for slider in (controls.turn, controls.height):
            slider.observe(self._posed, names="value")
        controls.planner.observe(
            lambda _: self._hear(lambda: self.pick(*self._goal.xy_m)), names="value"
        )
        self._view.observe(self._clicked, names="asked")
        self._view.on_msg(self._pressed)
        controls.run.on_click(lambda _: self._run_in_background())
        controls.stop.on_click(lambda _: self.stop())
        for button, action in {
            controls.shove: self.shove_object,
            controls.move_goal: self.move_goal,
            controls.start_over: self.start_over,
            controls.save: lambda: self.save(controls.name.value),
            controls.load: lambda: self.load(controls.name.value),
        }.items():
            button.on_click(lambda _, action=action: self._hear(action))
        layout = {"flex_flow": "row wrap", "grid_gap": "12px"}
        return [widgets.HBox([self._view, controls.box()], layout=layout)]

    def _hear(self, action: Callable[[], None]) -> None:
        (self._queue.attempt if self._running else self._queue.do)(action)

    def _clicked(self, change: dict[str, Any]) -> None:
        self._queue.attempt(lambda: self._follow(*change["new"][:2]))

    def _slid(self, change: dict[str, Any]) -> None:
        xy_m = whole_mm(*self.controls.place_m(self._goal, change))
        if not self._setting and xy_m != self._goal.xy_m:  # the page echoes what it was told
            self._queue.attempt(lambda: self._follow(*xy_m))

    def _posed(self, change: dict[str, Any]) -> None:
        """Set the goal at once, or the slider would be told an older one; plan when idle."""
        if not self._setting:
            pose = self.controls.pose(self._goal, change)
            self._queue.attempt(lambda: self._ask_for(self._posed_goal(*pose)))
            self._hear(self._settle)

    def _pressed(self, _: object, content: dict[str, Any], __: object) -> None:
        presses = {"run": self._run_in_background, "stop": self.stop}
        if content.get("press") in presses:
            presses[content["press"]]()

    def _run_in_background(self) -> None:
        """Run the plan of the goal that is shown, when it is made; a second press does nothing."""
        if not self._running:
            self._set_running(True)
            self._queue.put(lambda: self._run(self.seconds_per_action))

    def _show(self, draft: bool = False, planning: bool = False) -> None:
        self._view.scene = make_scene(
            self.world.obj,
            self._pose,
            self._goal,
            self.plan.steps if self.plan else (),
            self._start,
            self._turn_from,
            self._walked,
            HALF_WIDTH_M,
            LIMIT_M,
            answered=self._answered,
            running=self._running,
            draft=draft,
            planning=planning,
        )

    def picture(self) -> bytes:
        """What is shown, as a PNG."""
        return table_picture(self.world.obj, self._pose, self.plan, self.outcome, HALF_WIDTH_M)


class PageQueue:
    """A thread for what a page asks for, so that the next click is heard meanwhile.

    say: is told, in words, what did not work; `last`: the future of what was asked for last.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say, self._thread = say, ThreadPoolExecutor(1)
        self.last: Future | None = None

    @staticmethod
    def page_waits() -> bool:
        """Whether this is called for a page, whose messages come by an event loop."""
        try:
            asyncio.get_running_loop()
        except RuntimeError:
            return False
        return True

    def do(self, action: Callable[[], None]) -> None:
        """Do what is asked for: now in a script, for a page after all that it has asked before."""
        if self.page_waits():
            self.put(action)
        else:
            self.attempt(action)

    def put(self, action: Callable[[], None], after_s: float = 0.0) -> None:
        """Do it in the background, and not before so many seconds."""
        if after_s:
            timer = threading.Timer(after_s, self.put, [action])
            timer.daemon = True
            timer.start()
        else:
            self.last = self._thread.submit(self.attempt, action)

    def attempt(self, action: Callable[[], None]) -> None:
        """Do it now, and say what did not work."""
        try:
            action()
        except Exception as error:
            self._say(str(error) or type(error).__name__)
