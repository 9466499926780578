"""Table 3: plan to goals, execute the plans, and measure the final distance to the goal.

Each config is a `PlannerConfig`. Its outcomes on the frozen goals are stored by the runner; the
tables are made from all stored outcomes. A row of a table has the outcomes of all trainings of its
network.

    python -m experiments.planning --only config=continuous,astar
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import torch
from tqdm.auto import tqdm

from affordlib.models.base import EffectModel, condition_on_final_effect
from affordlib.models.checkpoint import load_checkpoint
from affordlib.models.evaluation import error_row
from affordlib.perception import adapt_to_object
from affordlib.planning import (
    EffectMap,
    Execution,
    PlanMode,
    Planner,
    PlanningProblem,
    Robot,
    Skills,
    execute_plan,
    plan_astar,
    plan_continuous,
    plan_gradient,
)
from affordlib.planning.astar import STOP_PHASES
from affordlib.planning.effect_map import checked_image
from affordlib.planning.gradient import Reading
from affordlib.planning.problem import MODES, OUR_TABLE
from affordlib.primitives import Drag, Push
from affordlib.types import NothingSeenError, Observation, Outcome, Plan, Step
from affordlib.world import ROLLABLE, STANDING, Tabletop, UnreachableError
from experiments import reported, runner
from experiments.commands import command
from experiments.field_baselines import LimitSurface, plan_astar_continuous, plan_cem
from experiments.literal import OTHER_SEEDS, OTHER_TRAININGS, trained
from experiments.oracle import oracle_effects
from experiments.runner import FOLDER, Job, Rows, interval, plain
from experiments.tasks import GOAL_SOURCES, PlanningTask, frozen_tasks, tasks_sha256

ENOUGH_M = 0.0003
"""Distance [m] from the goal below which no corrective action is tried, as none would help."""

POSITION_ERROR_M, YAW_ERROR_RAD = 0.001, math.radians(1.0)
GROUPS = {"all": STANDING + ROLLABLE, "standing": STANDING, "rollable": ROLLABLE} | {
    name: (name,) for name in STANDING + ROLLABLE
}
FINE_PHASES = tuple(round(0.5 + 0.05 * k, 2) for k in range(1, 11))


def plan_astar_full(problem: PlanningProblem) -> Plan:
    """A* without partial actions."""
    return plan_astar(problem, stop_phases=(1.0,))


def plan_continuous_full(problem: PlanningProblem) -> Plan:
    """Plan with the continuous planner, without partial actions."""
    return plan_continuous(replace(problem, mode=replace(problem.mode, partial=False)))


def plan_astar_recorded(problem: PlanningProblem) -> Plan:
    """A* with the segments 20, 40, … 100 % of what the paper records.

    It records "the parts of the interaction where the object is potentially going to be displaced".
    Our phase begins with the approach, in which the first segments would end.
    """
    return plan_astar(problem, stop_phases=phases_of_way(problem.effects, STOP_PHASES))


def phases_of_way(effects: EffectMap, shares: Sequence[float]) -> list[float]:
    """Phases at which full actions have moved the object by shares of its way, in the mean."""
    phase = torch.linspace(effects.kind.acts_from, 1, 201, dtype=torch.float64)
    direction = torch.arange(36, dtype=torch.float64) * (math.pi / 18)
    moved, _ = effects(*torch.meshgrid(direction, phase, indexing="ij"))
    way_m = np.maximum.accumulate(moved[..., :2].norm(dim=-1).mean(dim=0).numpy())
    return np.interp(np.multiply(shares, way_m[-1]), way_m, phase).tolist()


def plan_astar_fine(problem: PlanningProblem, heuristic: str = "goal") -> Plan:
    """A* with twice as many directions and stop phases, and a tolerance of 5 mm instead of 20."""
    problem = replace(problem, goal=replace(problem.goal, tolerance_m=0.005))
    return plan_astar(problem, 72, FINE_PHASES, heuristic)


def plan_continuous_with(problem: PlanningProblem, **settings: Any) -> Plan:
    """Plan with the continuous planner, with other values of its arguments, in capitals."""
    return plan_continuous(problem, **{name.lower(): value for name, value in settings.items()})


def decoded_kind(model: EffectModel, image: np.ndarray) -> type[Push] | type[Drag]:
    """Return the action that the paper's one network decodes for the object: push or drag.

    It is asked for the effects of full drags, which only few pushes have, in 36 directions. A drag
    starts above the object, a push 20 cm away.
    """
    angle = torch.arange(36) * (math.pi / 18)
    effect = torch.zeros(36, len(model.effect_channels))
    effect[:, :2] = Drag.length * torch.stack([angle.cos(), angle.sin()], dim=1)
    features = model.encode(checked_image(image))
    found = model.predict(features, condition_on_final_effect(model, effect), torch.zeros(36, 1))
    return Push if found.action_mean[..., :2].norm(dim=-1).median() > Push.radius / 2 else Drag


MADE: dict[str, Callable[[], EffectModel]] = {
    **{name: partial(trained, name) for name in OTHER_TRAININGS},
    "limit_surface": LimitSurface.fitted,
}
"""Models without a checkpoint, which the job trains (ten minutes, once) or fits on `push`."""

Pose = Callable[..., PlanningProblem]
"""Poses the problem of (image, start_xy_m, goal, mode), as `Skills.problem` does."""


VERSIONS: dict[Planner, int] = {plan_astar: 2, plan_astar_fine: 2}
"""Versions of planners (default 1); raise one when a change of code changes its numbers."""


@dataclass(frozen=True)
class PlannerConfig:
    """A planner, its model, and its goals.

    planner: a function of a `PlanningProblem`; arguments: its further arguments; execution: fields
    of `Attempt`. model: a checkpoint, one of `MADE`, or "simulator"; oracle: arguments of
    `oracle_effects` for "simulator". world, sources, modes: of the frozen goals; stride: use every
    stride-th goal; standing: exclude rollable objects.
    """

    planner: Callable[..., Plan]
    model: str = "film_5000"
    arguments: dict[str, Any] = field(default_factory=dict)
    execution: dict[str, Any] = field(default_factory=dict)
    oracle: dict[str, bool] = field(default_factory=dict)
    world: str = "clean"
    sources: tuple[str, ...] = ("constructed",)
    stride: int = 1
    standing: bool = False
    modes: tuple[str, ...] = tuple(MODES)

    @property
    def for_all(self) -> bool:
        """Whether the model is one network of pushes and drags, as in the paper."""
        return "mixed" in self.model

    @property
    def checkpoints(self) -> dict[str, str]:
        """Checkpoints by primitive: the model's, and one for drags if rollable objects occur."""
        if self.model in ("simulator", *MADE):
            return {}
        drags = self.model.startswith("film") and self.world not in ("perturbed", "outside")
        return {"push": self.model} | ({"drag": "drag_film_500"} if drags else {})

    @property
    def classes(self) -> tuple[str, ...]:
        """The object categories of its goals."""
        if self.world == "perturbed_rollable":
            return ROLLABLE
        drags = "drag" in self.checkpoints or self.model == "simulator" or self.for_all
        drags &= self.world in ("clean", "fresh") and not self.standing
        return STANDING + ROLLABLE if drags else STANDING

    def chosen(self, tasks: Sequence[PlanningTask]) -> list[int]:
        """Return the numbers of the tasks that it is evaluated on."""
        asked = [
            (t.goals in self.sources and t.mode in self.modes and t.obj.category in self.classes)
            for t in tasks
        ]
        return np.flatnonzero(asked)[:: self.stride].tolist()

    def columns(self) -> dict[str, str]:
        """Return the columns of the table that describe it."""
        return {"model": self.model, "world": self.world}

    def plan(self, problem: PlanningProblem) -> Plan:
        """Plan with this row's arguments."""
        return self.planner(problem, **self.arguments)

    def pose(self, world: Tabletop) -> Pose:
        """Return what poses the problems; only the model "simulator" reads the world's state."""
        models = {kind: load_checkpoint(name)[0] for kind, name in self.checkpoints.items()}
        if self.model in MADE:
            models["push"] = MADE[self.model]()
        skills, imagined = Skills(models), None if models else Tabletop()

        def pose(image, start_xy_m, goal, mode) -> PlanningProblem:
            if imagined:
                effects = oracle_effects(imagined, world, image, **self.oracle)
            elif self.for_all:
                effects = EffectMap(models["push"], image, decoded_kind(models["push"], image))
            else:
                kind = skills.kind_for(image) if "drag" in models else Push
                effects = EffectMap(skills.model(kind), image, kind)
            return PlanningProblem(start_xy_m, goal, effects, mode)

        return pose


ALL = {"sources": GOAL_SOURCES}
CORRECTED, BY_PLAN = {"execution": {"corrections": 2}}, {"execution": {"by_plan": True}}
RECEDING = {"execution": {"receding": True}}
DISC = {"heuristic": "disc"}
PERTURBED = {"model": "film_5000_perturbed", "world": "perturbed"}
ROLLING, OUTSIDE = (PERTURBED | {"world": world} for world in ("perturbed_rollable", "outside"))
ORACLE = {"model": "simulator"}
FRESH = {"world": "fresh"}
PAPERS = "cnp_mixed_500"
RISK_WEIGHTS = (0.0, 1.0, 10.0, 30.0)
RATES = {"gradient": (0.1, 0.3, 1.0), "gradient_adam": (0.002, 0.005, 0.01)}
"""Risk weights of the continuous planner, and rates of the gradient planner's descents, that are
tried on the validation goals."""

READINGS = {
    "gradient": Reading(),
    "gradient_starts": Reading(starts=4),
    "gradient_adam": Reading("adam", "circle", "point"),
}
"""Readings of the paper's planner: as printed, the best of four starts, Adam from 20 cm."""


def papers_configs(prefix: str, readings: Sequence[str], world: str) -> dict[str, PlannerConfig]:
    """Return configs of readings of the paper's planner, with its network.

    The network has three trainings (`_seed_1`, `_seed_2`) and one on pushes only (`_pushes`). Plans
    are executed as in the paper, each action placed by the plan; `_recentred`, placed at the object
    as it is then observed, which differs for several actions only.
    """
    models = {"": PAPERS, "_pushes": "cnp_500"} | {seed: PAPERS + seed for seed in OTHER_SEEDS}
    found = {}
    for reading, samples, (end, model) in product(readings, (100, 300), models.items()):
        how = {"samples": samples, "reading": READINGS[reading]}
        one = PlannerConfig(plan_gradient, model, how, **BY_PLAN, world=world)
        found[f"{prefix}{reading}_{samples}{end}"] = one
        if world == "clean":
            again = replace(one, execution={}, modes=("multi_partial",))
            found[f"{reading}_{samples}_recentred{end}"] = again
    return found


CONFIGS: dict[str, PlannerConfig] = {
    # The paper's planners on its own network.
    **papers_configs("", READINGS, "clean"),
    "astar_paper": PlannerConfig(plan_astar, PAPERS, **ALL),
    "astar_paper_recorded": PlannerConfig(plan_astar_recorded, PAPERS, **ALL),
    "astar_paper_pushes": PlannerConfig(plan_astar, "cnp_500", **ALL),
    "astar_paper_recorded_pushes": PlannerConfig(plan_astar_recorded, "cnp_500", **ALL),
    "continuous_paper": PlannerConfig(plan_continuous, PAPERS, **ALL),
    "gradient_100_yaw": PlannerConfig(plan_gradient, "cnp_yaw_mixed_500", **BY_PLAN),
    "continuous_paper_yaw": PlannerConfig(plan_continuous, "cnp_yaw_mixed_500"),
    # Our planner and A* on our best model.
    "continuous": PlannerConfig(plan_continuous, **ALL),
    "continuous_corrected": PlannerConfig(plan_continuous, **CORRECTED, **ALL),
    "continuous_by_plan": PlannerConfig(plan_continuous, **BY_PLAN, standing=True),
    "continuous_full": PlannerConfig(plan_continuous_full, **ALL),
    "astar": PlannerConfig(plan_astar, standing=True),
    "astar_corrected": PlannerConfig(plan_astar, **CORRECTED, standing=True),
    "astar_by_plan": PlannerConfig(plan_astar, **BY_PLAN, standing=True),
    "astar_full": PlannerConfig(plan_astar_full, standing=True),
    "astar_disc": PlannerConfig(plan_astar, arguments=DISC, **ALL),
    "astar_disc_corrected": PlannerConfig(plan_astar, arguments=DISC, **CORRECTED, **ALL),
    "astar_disc_fine": PlannerConfig(plan_astar_fine, arguments=DISC, **ALL),
    # Standard planners and a physics-based model.
    "astar_continuous": PlannerConfig(plan_astar_continuous, standing=True),
    "cem": PlannerConfig(plan_cem, standing=True),
    "mpc_cem": PlannerConfig(plan_cem, **RECEDING, standing=True),
    "mpc_continuous": PlannerConfig(plan_continuous, **RECEDING, standing=True),
    "continuous_limit_surface": PlannerConfig(plan_continuous, "limit_surface"),
    # Other networks, one of them recurrent, and a small error of the object's pose.
    "continuous_cnp_500": PlannerConfig(plan_continuous, "cnp_500", **ALL),
    "continuous_film_500": PlannerConfig(plan_continuous, "film_500", **ALL),
    "continuous_lstm_500": PlannerConfig(plan_continuous, "lstm_500"),
    "continuous_perturbed_start": PlannerConfig(
        plan_continuous, execution={"perturbed_start": True}
    ),
    # The simulator in place of a model.
    "oracle": PlannerConfig(plan_continuous, **ORACLE),
    "oracle_risk_averse": PlannerConfig(plan_continuous, **ORACLE, oracle={"risk_averse": True}),
    # The perturbed world with a noisy camera.
    "perturbed": PlannerConfig(plan_continuous, **PERTURBED),
    "perturbed_corrected": PlannerConfig(plan_continuous, **PERTURBED, **CORRECTED),
    "perturbed_averaged": PlannerConfig(
        plan_continuous, **PERTURBED, execution={"corrections": 2, "n_averaged_images": 8}
    ),
    "perturbed_film_5000": PlannerConfig(plan_continuous, world="perturbed"),
    "perturbed_rollable": PlannerConfig(plan_continuous, **ROLLING),
    "perturbed_rollable_corrected": PlannerConfig(plan_continuous, **ROLLING, **CORRECTED),
    "outside": PlannerConfig(plan_continuous, **OUTSIDE),
    "outside_corrected": PlannerConfig(plan_continuous, **OUTSIDE, **CORRECTED),
    "perturbed_oracle": PlannerConfig(plan_continuous, **ORACLE, world="perturbed", stride=5),
    "perturbed_oracle_nominal": PlannerConfig(
        plan_continuous, **ORACLE, oracle={"nominal_physics": True}, world="perturbed", stride=5
    ),
    # Constants of the planners, on the validation goals.
    **{
        f"RISK_WEIGHT={weight:g}": PlannerConfig(
            plan_continuous_with, arguments={"RISK_WEIGHT": weight}, world="validation"
        )
        for weight in RISK_WEIGHTS
    },
    **{
        f"{reading} rate={rate:g}": PlannerConfig(
            plan_gradient,
            "cnp_500",
            {"reading": replace(READINGS[reading], rate=rate)},
            **BY_PLAN,
            world="validation",
        )
        for reading, rates in RATES.items()
        for rate in rates
    },
    # Once, at the end, on goals that no choice has seen.
    **papers_configs("fresh_", ("gradient",), "fresh"),
    "fresh_astar_paper": PlannerConfig(plan_astar, PAPERS, **FRESH),
    "fresh_astar_paper_recorded": PlannerConfig(plan_astar_recorded, PAPERS, **FRESH),
    "fresh_continuous_paper": PlannerConfig(plan_continuous, PAPERS, **FRESH),
    "fresh_continuous_film_500": PlannerConfig(plan_continuous, "film_500", **FRESH),
    "fresh_continuous": PlannerConfig(plan_continuous, **FRESH),
}


@dataclass(frozen=True)
class Attempt:
    """How a plan is executed.

    corrections: largest number of single actions that correct the final position. perturbed_start:
    at execution, the object's estimated pose has an error of `POSITION_ERROR_M` and
    `YAW_ERROR_RAD`. n_averaged_images: number of images of which a position is the mean. by_plan:
    each action is relative to the object's predicted position instead of the observed one.
    receding: after each action, a new plan is made for the remaining number of actions
    (model-predictive control).
    """

    corrections: int = 0
    perturbed_start: bool = False
    n_averaged_images: int = 1
    by_plan: bool = False
    receding: bool = False


def corrected(
    robot: Robot, done: Outcome, replan: Callable[..., Plan], corrections: int
) -> Outcome:
    """Return the outcome of an executed plan after at most `corrections` single actions.

    Each of them is the first action of a plan that `replan` makes from a new image, and is executed
    only if it is predicted to bring the object nearer to the goal.
    """
    goal = done.plan.goal
    # With the goal's own tolerance, a planner would find nothing to correct.
    exactly = replace(goal, tolerance_m=min(goal.tolerance_m, ENOUGH_M))
    with suppress(NothingSeenError, UnreachableError):
        for _ in range(corrections):
            seen = robot.observe()
            distance_m = goal.distance_m(seen.xy_m)
            if distance_m <= ENOUGH_M or not OUR_TABLE.holds(np.array([seen.xy_m]))[0]:
                break
            plan = replan(seen.image, seen.xy_m, exactly)
            first = replace(plan, goal=goal, steps=plan.steps[:1])
            if not plan.steps or goal.distance_m(first.predicted_end_xy_m) >= distance_m:
                break
            again, step = robot.observe(), first.steps[0]
            action = adapt_to_object(step.primitive, again.image)
            if not robot.can_reach(action, step.stop_phase, again.xy_m):
                break
            done = _joined(done, execute_plan(robot, first))
    return done


def _joined(done: Outcome, more: Outcome) -> Outcome:
    """Return the outcome of a plan and of further actions executed after it."""
    paths = done.object_paths_xy_m + more.object_paths_xy_m
    return replace(more, plan=done.plan, object_paths_xy_m=paths)


def attempt(
    world: Tabletop, task: PlanningTask, pose: Pose, planner: Planner, **options: Any
) -> Outcome:
    """Plan and execute one task; options: fields of `Attempt`.

    The distance is the world's ground truth. If the arm cannot follow a plan, the distance after
    its last executed action counts.
    """
    how = Attempt(**options)
    world.place(task.obj, (0.0, 0.0), task.yaw_rad, config=task.config)
    once, at_xy_m = PlanMode(1, partial=True), None

    def observe() -> Observation:
        views = [world.observe() for _ in range(how.n_averaged_images)]
        return replace(views[0], xy_m=tuple(np.mean([v.xy_m for v in views], axis=0).tolist()))

    def execute(step: Step) -> Execution:
        nonlocal at_xy_m
        seen = replace(observe(), xy_m=at_xy_m) if how.by_plan else observe()
        at_xy_m = step.predicted_end_xy_m
        return world.execute(step, seen)

    robot = SimpleNamespace(observe=observe, execute=execute)
    for name in ("can_reach", "park", "settle"):
        setattr(robot, name, getattr(world, name))
    seen = robot.observe()
    plan = planner(pose(seen.image, seen.xy_m, task.goal, task.mode))
    if how.perturbed_start:
        side = POSITION_ERROR_M * np.array([math.cos(task.yaw_rad), math.sin(task.yaw_rad)])
        config = replace(task.config, bias_m=tuple(side))
        world.place(task.obj, (0.0, 0.0), task.yaw_rad + YAW_ERROR_RAD, config=config)
    at_xy_m = seen.xy_m
    now = replace(plan, steps=plan.steps[:1]) if how.receding else plan
    try:
        outcome = execute_plan(robot, now)
        outcome = corrected(robot, outcome, lambda *q: planner(pose(*q, once)), how.corrections)
        mode = MODES[task.mode]
        for left in range(mode.max_steps - 1, 0, -1) if how.receding else ():
            seen = robot.observe()
            if task.goal.distance_m(seen.xy_m) <= ENOUGH_M:
                break
            fewer = replace(mode, max_steps=left)
            again = planner(pose(seen.image, seen.xy_m, task.goal, fewer))
            more = execute_plan(robot, replace(again, steps=again.steps[:1]))
            outcome = replace(_joined(outcome, more), plan=plan)
    except UnreachableError as refused:
        outcome = refused.outcome
    end = world.object_pose()
    return replace(outcome, distance_m=task.goal.distance_m(end[:2]), end_pose=end)


def outcome_record(task: PlanningTask, outcome: Outcome) -> dict[str, Any]:
    """Return the columns of the tables for one outcome.

    predicted_m: the predicted final distance from the goal; prediction_error_m: the distance
    between the object's predicted and actual final positions.
    """
    plan = outcome.plan
    error = np.hypot(*np.subtract(plan.predicted_end_xy_m, outcome.end_pose[:2]))
    return {
        "goals": task.goals,
        "mode": task.mode,
        "object_class": task.obj.category,
        "distance_m": outcome.distance_m,
        "predicted_m": plan.predicted_distance_m,
        "prediction_error_m": float(error),
        "std_m": plan.steps[-1].std_m if plan.steps else 0.0,
        "steps": len(plan.steps),
        "actions": len(outcome.object_paths_xy_m),
        "plan_s": plan.plan_s,
    }


def measure(
    world: Tabletop, tasks: Sequence[PlanningTask], pose: Pose, planner: Planner, **execution: Any
) -> list[Outcome]:
    """Return the outcomes of tasks with one planner, in order; execution: options of `attempt`."""
    return [attempt(world, task, pose, planner, **execution) for task in tasks]


def run_config(config: str) -> list[dict[str, Any]]:
    """Return records of a planner's outcomes on its frozen goals, with the goals' numbers."""
    torch.set_num_threads(1)
    about, records = CONFIGS[config], []
    tasks = frozen_tasks(about.world)
    with Tabletop() as world:
        pose = about.pose(world)
        for k in tqdm(about.chosen(tasks), config, unit=" goals", leave=False):
            outcome = attempt(world, tasks[k], pose, about.plan, **about.execution)
            records.append({"task": k} | outcome_record(tasks[k], outcome))
    return records


def job(config: str) -> Job:
    """Return the job that evaluates one planner."""
    about = CONFIGS[config]
    settings, files = [about, tasks_sha256(about.world)], tuple(about.checkpoints.values())
    version, data = VERSIONS.get(about.planner, 1), ()
    if spec := OTHER_TRAININGS.get(about.model):
        settings, data = [*settings, spec.network, spec.training], (spec.data,)
    elif about.model in MADE:
        data = ("push",)
    return Job(run_config, {"config": config}, settings, data, files, version)


def planning_rows(records: Rows, **columns: Any) -> Rows:
    """Return rows of `planning`: per source of goals and mode, for all objects and each category.

    Mean and standard error are over goals, after averaging each goal's distances over trainings;
    median and 95th percentile are over all; low and high are the means of single trainings.
    columns: further columns of the rows, such as `PlannerConfig.columns`.
    """
    rows = []
    table = pd.DataFrame(records)
    table = pd.DataFrame({"task": table.index, "training": 0}).assign(**table)
    for (source, mode), some in table.groupby(["goals", "mode"], sort=False):
        for group, classes in GROUPS.items():
            chosen = some[some.object_class.isin(classes)]
            if chosen.empty:
                continue
            about = {"goals": source, "object_class": group, "mode": mode}
            by_goal = chosen.groupby("task").distance_m.mean()
            row = error_row(by_goal.to_numpy(), **columns, **about)
            row["median_m"], row["p95_m"] = chosen.distance_m.quantile([0.5, 0.95])
            means = chosen.groupby("training").distance_m.mean()
            row |= {"trainings": len(means), "low_m": means.min(), "high_m": means.max()}
            row["predicted_mean_m"] = chosen.predicted_m.mean()
            row["prediction_error_mean_m"] = chosen.prediction_error_m.mean()
            rows.append(row | {"actions_mean": chosen.actions.mean()})
    return rows


def summary_rows(rows: Rows, source: str = "constructed") -> Rows:
    """Return one row per planner and group on one source of goals: statistics of each mode."""
    summary: dict[tuple[str, str], dict[str, Any]] = {}
    for row in rows:
        if row["goals"] == source and row["object_class"] not in STANDING + ROLLABLE:
            names = ("planner", "model", "world", "object_class", "trainings")
            new = {name: row[name] for name in names}
            one = summary.setdefault((row["planner"], row["object_class"]), new)
            for statistic in ("mean", "sem", "median", "low", "high"):
                one[f"{row['mode']}_{statistic}_m"] = row[f"{statistic}_m"]
            one["n"] = f"{one['n']}, {row['n']}" if "n" in one else str(row["n"])
    return list(summary.values())


def decomposition_rows(rows: Rows) -> Rows:
    """Return the parts of the open-loop error on constructed goals, by planner, mode and group.

    search: predicted distance from the goal; model: distance between predicted and actual
    positions; execution: total error with the simulator as the model, which has no σ and thus no
    preference for low-variance plans.
    """
    place = ["world", "mode", "object_class"]
    table = pd.DataFrame(rows).query("goals == 'constructed'")
    oracle = table[table.planner.isin(["oracle", "perturbed_oracle"])].set_index(place).mean_m
    table = table.join(oracle.rename("execution"), on=place)
    open_loop = [name for name, about in CONFIGS.items() if {*about.execution} <= {"by_plan"}]
    table = table[table.object_class.isin(["standing", "rollable"]) & table.planner.isin(open_loop)]
    parts = {"predicted_mean_m": "search", "prediction_error_mean_m": "model"}
    parts |= {"execution": "execution", "mean_m": "total"}
    names = {column: f"{part}_mean_m" for column, part in parts.items()}
    return plain(table[["planner", *place, "n", *parts]].rename(columns=names))


VARIANTS = {
    name: name.removesuffix(change)
    for change in ("_full", "_by_plan", "_corrected", "_recentred", "_yaw", "_recorded")
    for name in CONFIGS
    if name.removesuffix(change) in {*CONFIGS} - {name}
} | {
    "astar_disc": "astar",
    "astar_continuous": "continuous",
    "gradient_300": "gradient_100",
    "gradient_starts_100": "gradient_100",
    "gradient_adam_100": "gradient_100",
    "cem": "continuous",
    "mpc_continuous": "continuous",
    "mpc_cem": "mpc_continuous",
    "continuous_paper": "continuous_film_500",
    "continuous_cnp_500": "continuous_film_500",
    "continuous_film_500": "continuous",
    "continuous_limit_surface": "continuous_film_500",
}
"""Planners with one change, each with the planner without it, for paired comparisons."""


def variant_rows(records: dict[str, Rows]) -> Rows:
    """Return paired differences of final distance for `VARIANTS`: mean [m] and interval.

    They are on constructed goals, of stable objects and of all that both rows have.
    """
    rows: Rows = []
    for name, than in VARIANTS.items():
        if not {name, than} <= set(records):
            continue
        tables = [
            pd.DataFrame(records[key]).query("goals == 'constructed'") for key in (name, than)
        ]
        both = pd.merge(*tables, on=["task", "training", "mode", "object_class"])
        both["by_m"] = both.distance_m_x - both.distance_m_y
        for group in ("standing", "all"):
            some = both[both.object_class.isin(GROUPS[group])]
            rng = np.random.default_rng(0)
            for mode, pairs in some.groupby("mode", sort=False):
                by_goal = pairs.groupby("task").by_m.mean()
                mean, low, high = interval(by_goal, 2000, rng)
                row = {"planner": name, "than": than, "object_class": group, "mode": mode}
                row |= {"n": len(by_goal), "difference_mean_m": mean}
                rows.append(row | {"low_m": low, "high_m": high})
    return rows


def tables(folder: str | Path = FOLDER) -> dict[str, Rows]:
    """Return all tables of the evaluated planners."""
    found = {about["config"]: result for about, result in runner.read("planning", job, folder)}
    records: dict[str, Rows] = {}
    for name in CONFIGS:
        if name in found:
            row, _, seed = name.partition("_seed_")
            training = {"training": int(seed or 0)}
            records.setdefault(row, []).extend(one | training for one in found[name])
    rows = [
        one
        for row, some in records.items()
        for one in planning_rows(some, planner=row, **CONFIGS[row].columns())
    ]
    return {
        "planning": rows,
        "summary": [*reported.PLANNING_ROWS, *summary_rows(rows)],
        "summary_uniform": summary_rows(rows, "uniform"),
        "variants": variant_rows(records),
        "error_decomposition": decomposition_rows(rows),
    }


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Evaluate planners on the frozen goals and make the tables of all evaluated planners."""
    options = runner.parser("planning", main.__doc__).parse_args(argv)
    return runner.make([job(name) for name in CONFIGS], "planning", options, tables)


if __name__ == "__main__":
    sys.exit(main())
