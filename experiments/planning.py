"""Table 3: plan to goals, execute the plans, and measure the final distance to the goal.

python -m experiments.planning --only config=continuous,astar
"""

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import torch
from tqdm.auto import tqdm

from affordlib.interactions import split_interactions
from affordlib.models import CNPConfig, EffectNetwork
from affordlib.models.checkpoint import load_checkpoint
from affordlib.models.training import train_model
from affordlib.perception import adapt_to_object
from affordlib.planning import EffectMap, Execution, PlanningProblem, Robot, Skills, execute_plan
from affordlib.planning.astar import STOP_PHASES, plan_astar
from affordlib.planning.continuous import plan_continuous
from affordlib.planning.gradient import CIRCLE_M, Reading, decoded, plan_gradient
from affordlib.planning.problem import MODES, PlanMode
from affordlib.primitives import Drag, Move, Push
from affordlib.types import NothingSeenError, Observation, Outcome, Plan, Step, on_table
from affordlib.world import ROLLABLE, STANDING, Tabletop, UnreachableError
from affordlib.world.trajectory import STEP_S
from experiments import reported, runner
from experiments.field_baselines import plan_cem
from experiments.runner import FOLDER, Job, Rows, interval, open_once, plain
from experiments.shipped import CHECKPOINT_SPECS
from experiments.tasks import GOAL_SOURCES, PlanningTask, frozen_tasks, tasks_sha256

ENOUGH_M = 0.0003
"""Distance [m] from the goal below which no corrective action is tried, as none would help."""

GROUPS = {"standing": STANDING, "rollable": ROLLABLE}
FINE_PHASES = tuple(round(0.5 + 0.05 * k, 2) for k in range(1, 11))


def plan_continuous_full(problem: PlanningProblem) -> Plan:
    """Plan with the continuous planner, without partial actions."""
    return plan_continuous(replace(problem, mode=replace(problem.mode, partial=False)))


def plan_gradient_full(problem: PlanningProblem, **arguments: Any) -> Plan:
    """Plan with the paper's planner, without partial actions."""
    return plan_gradient(replace(problem, mode=replace(problem.mode, partial=False)), **arguments)


def plan_astar_recorded(problem: PlanningProblem) -> Plan:
    """A* with shares of the object's way, as in the paper; phases begin with the approach here."""
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


VERSIONS = {plan_astar: 2, plan_astar_fine: 2, "astar": 3, "astar_full": 3}
VERSIONS |= {"continuous": 2, "continuous_full": 2}
"""Versions of planners or configs (default 1); raise one if a change of code changes its rows."""


_PAPER = CHECKPOINT_SPECS["cnp_500"]
_MIXED = replace(_PAPER, data="mixed")
_YAW = replace(_PAPER, network=CNPConfig(effect_channels=("x", "y", "yaw")))
TRAINED = {
    f"{name}_seed_{seed}": replace(spec, training=replace(spec.training, seed=seed))
    for name, spec in (("cnp_500", _PAPER), ("cnp_mixed", _MIXED))
    for seed in (1, 2)
} | {"cnp_mixed": _MIXED, "cnp_yaw": _YAW}
"""Networks that are trained for their rows, as `cnp_500` is: with other seeds; on pushes and drags
together as in the paper; with yaw among the effects."""


@lru_cache
def network(name: str) -> EffectNetwork:
    """Load a checkpoint, or train a network of `TRAINED`, which is kept as .NAME.pt."""
    if name not in TRAINED:
        return load_checkpoint(name)[0]
    spec = TRAINED[name]
    data = open_once(spec.data)
    split, partly = split_interactions(data.sizes["interaction"]), f"{FOLDER}/.{name}.pt"
    return train_model(data, split, spec.training, spec.network, resume_checkpoint=partly)[0]


def decoded_kind(model: EffectNetwork, image: np.ndarray) -> type[Move]:
    """Primitive that a network of both decodes: only a push begins beside the object."""
    angle = torch.arange(36) * (math.pi / 18)
    effects = CIRCLE_M / 3 * torch.stack([angle.cos(), angle.sin()], dim=-1)
    with torch.no_grad():
        *_, action = decoded(EffectMap(model, image), effects, torch.zeros(1))
    return Push if action[:, 0].norm(dim=-1).median() > CIRCLE_M / 2 else Drag


@dataclass(frozen=True)
class PlannerConfig:
    """A planner, its model, and its goals.

    planner: a function of a `PlanningProblem`; arguments: its further arguments; execution: options
    of `attempt`. model: a checkpoint. world, sources, modes: of the frozen goals;
    standing: exclude rollable objects.
    """

    planner: Callable[..., Plan]
    model: str = "film_5000"
    arguments: dict[str, Any] = field(default_factory=dict)
    execution: dict[str, Any] = field(default_factory=dict)
    world: str = "clean"
    sources: tuple[str, ...] = ("constructed",)
    standing: bool = False
    modes: tuple[str, ...] = tuple(MODES)

    @property
    def checkpoints(self) -> dict[str, str]:
        """Checkpoints by primitive: the model's, and one for drags if rollable objects occur."""
        drags = self.model.startswith("film") and self.world not in ("perturbed", "outside")
        return {"push": self.model} | ({"drag": "drag_film_500"} if drags else {})

    @property
    def classes(self) -> tuple[str, ...]:
        """The object categories of its goals."""
        if self.world.endswith("rollable"):
            return ROLLABLE
        drags = "drag" in self.checkpoints or "mixed" in self.model
        drags = drags and self.world == "clean" and not self.standing
        return STANDING + ROLLABLE if drags else STANDING

    def chosen(self, tasks: Sequence[PlanningTask]) -> list[int]:
        """Return the numbers of the tasks that it is evaluated on."""
        fits = [
            (t.goals in self.sources and t.mode in self.modes and t.obj.category in self.classes)
            for t in tasks
        ]
        return np.flatnonzero(fits).tolist()

    def pose(self) -> Callable[..., PlanningProblem]:
        """Return what poses the problem of (image, start_xy_m, goal, mode), as `Skills` does."""
        models = {kind: network(name) for kind, name in self.checkpoints.items()}
        skills, push = Skills(models), models["push"]

        def pose(image, start_xy_m, goal, mode) -> PlanningProblem:
            kind = skills.kind_for(image) if "drag" in models else Push
            if "mixed" in self.model:
                kind = decoded_kind(push, image)
            effects = EffectMap(models.get(kind.name, push), image, kind)
            return PlanningProblem(start_xy_m, goal, effects, mode)

        return pose


ALL = {"sources": GOAL_SOURCES}
CORRECTED, BY_PLAN = {"execution": {"corrections": 2}}, {"execution": {"by_plan": True}}
RECENTRED, DISC = {"modes": ("multi_partial",)}, {"heuristic": "disc"}
PERTURBED = {"model": "film_5000_perturbed", "world": "perturbed"}
ROLLING, OUTSIDE = (PERTURBED | {"world": world} for world in ("perturbed_rollable", "outside"))
RATES = {"gradient": (0.03, 0.1, 0.3, 1.0, 3.0), "adam": (0.0003, 0.001, 0.003, 0.005, 0.02)}
"""Rates of the paper's planner that are tried on the validation goals."""

READINGS = {
    "gradient": Reading(),
    "gradient_starts": Reading(starts=4),
    "gradient_circle": Reading(start="circle", rate=1.0),
    "gradient_point": Reading("gradient", "circle", "point", rate=1.0),
    "gradient_adam": Reading("adam", "circle", "point", rate=0.003),
}
"""Readings of the paper's planner: as printed, the best of four starts, from the circle of 20 cm,
from there until the point is still, the same with Adam."""


def _descent(reading: Reading, model: str = "cnp_500", samples: int = 100, **how: Any) -> Any:
    arguments = {"samples": samples, "reading": reading}
    return PlannerConfig(plan_gradient, model, arguments, **how)


PAPERS, SAMPLES = ("gradient_100", "gradient_300", "astar_paper"), (100, 300)
RETRAINED = {
    f"{name}_{samples}{placed}": _descent(READINGS[name], samples=samples, **how)
    for name in ("gradient", "gradient_starts", "gradient_adam")
    for placed, how in (("", BY_PLAN), ("_recentred", RECENTRED))
    for samples in SAMPLES
}
"""Planners that are tried with three trainings of the paper's network."""
CONFIGS: dict[str, PlannerConfig] = {
    # The paper's planners on its own network. Each action is placed by the plan, as in the paper;
    # `_recentred`, at the object as it is then observed, which differs for several actions only.
    **{
        f"{name}_{samples}_pushes": _descent(how, samples=samples, **BY_PLAN)
        for (name, how), samples in product(READINGS.items(), SAMPLES)
    },
    "gradient_100_uniform_pushes": _descent(Reading(), **BY_PLAN, sources=("uniform",)),
    **{f"{name}_pushes": config for name, config in RETRAINED.items() if "recentred" in name},
    "astar_paper_pushes": PlannerConfig(plan_astar, "cnp_500", **ALL),
    "astar_paper_recorded_pushes": PlannerConfig(plan_astar_recorded, "cnp_500", **ALL),
    # Our planner and A* on our best model.
    "continuous": PlannerConfig(plan_continuous, **ALL),
    "continuous_corrected": PlannerConfig(plan_continuous, **CORRECTED, **ALL),
    "continuous_by_plan": PlannerConfig(plan_continuous, **BY_PLAN, standing=True),
    "continuous_full": PlannerConfig(plan_continuous_full, **ALL),
    "astar": PlannerConfig(plan_astar, standing=True),
    "astar_corrected": PlannerConfig(plan_astar, **CORRECTED, standing=True),
    "astar_by_plan": PlannerConfig(plan_astar, **BY_PLAN, standing=True),
    "astar_full": PlannerConfig(plan_astar, arguments={"stop_phases": (1.0,)}, standing=True),
    "astar_disc": PlannerConfig(plan_astar, arguments=DISC, **ALL),
    "astar_disc_corrected": PlannerConfig(plan_astar, arguments=DISC, **CORRECTED, **ALL),
    "astar_disc_fine": PlannerConfig(plan_astar_fine, arguments=DISC, **ALL),
    "cem": PlannerConfig(plan_cem, standing=True),  # a standard planner
    # Other networks, one of them recurrent.
    "continuous_cnp_500": PlannerConfig(plan_continuous, "cnp_500", **ALL),
    "continuous_film_500": PlannerConfig(plan_continuous, "film_500", **ALL),
    "continuous_lstm_500": PlannerConfig(plan_continuous, "lstm_500"),
    # The perturbed world with a noisy camera.
    "perturbed": PlannerConfig(plan_continuous, **PERTURBED),
    "perturbed_corrected": PlannerConfig(plan_continuous, **PERTURBED, **CORRECTED),
    "perturbed_averaged": PlannerConfig(
        plan_continuous, **PERTURBED, execution={"corrections": 2, "n_averaged_images": 8}
    ),
    "perturbed_film_5000": PlannerConfig(plan_continuous, world="perturbed"),
    "perturbed_film_500": PlannerConfig(plan_continuous, "film_500", world="perturbed"),
    "perturbed_gradient_100": _descent(Reading(), world="perturbed", **BY_PLAN),
    "perturbed_rollable": PlannerConfig(plan_continuous, **ROLLING),
    "perturbed_rollable_corrected": PlannerConfig(plan_continuous, **ROLLING, **CORRECTED),
    "outside": PlannerConfig(plan_continuous, **OUTSIDE),
    "outside_corrected": PlannerConfig(plan_continuous, **OUTSIDE, **CORRECTED),
    # Constants of the planners, on the validation goals.
    **{
        f"RISK_WEIGHT={weight:g}": PlannerConfig(
            plan_continuous, arguments={"risk_weight": weight}, world="validation"
        )
        for weight in (0.0, 1.0, 10.0, 30.0)
    },
    **{
        f"{name}_rate={rate:g}": _descent(
            replace(how, rate=rate), model, world="validation", **BY_PLAN
        )
        for name, model, how in (
            *((key.removeprefix("gradient_"), "cnp_500", how) for key, how in READINGS.items()),
            ("gradient_published", "cnp_published", Reading()),
        )
        for rate in RATES[how.descent]
        if how.starts == 1
    },
}
CONFIGS |= {
    "gradient_100_pushes_full": replace(CONFIGS["gradient_100_pushes"], planner=plan_gradient_full),
    # Other trainings of the paper's network; goals drawn when all planners were finished.
    **{
        f"{name}_{model}": replace(CONFIGS[f"{name}_pushes"], model=model, sources=("constructed",))
        for model in (*TRAINED, "cnp_published")
        for name in (*PAPERS, *(RETRAINED if model.startswith(("cnp_500", "cnp_mixed")) else ()))
    },
    **{
        f"fresh_{name}": replace(CONFIGS[name], world="fresh", sources=("constructed",))
        for name in (
            *("gradient_100_pushes", "gradient_300_pushes", "astar_paper_pushes", "astar"),
            *("continuous", "continuous_film_500", "continuous_cnp_500", "astar_disc"),
        )
    },
}
CONFIGS |= {
    f"fresh_rollable_{name.removeprefix('fresh_')}": replace(CONFIGS[name], world="fresh_rollable")
    for name in (*(f"{name}_cnp_mixed" for name in PAPERS), "fresh_continuous", "fresh_astar_disc")
}


def corrected(robot: Robot, done: Outcome, replan: Callable[..., Plan], most: int) -> Outcome:
    """Return the outcome of an executed plan after at most so many single actions.

    Each of them is the first action of a plan that `replan` makes from a new image, and is executed
    only if it is predicted to bring the object nearer to the goal.
    """
    goal = done.plan.goal
    # With the goal's own tolerance, a planner would find nothing to correct.
    exactly = replace(goal, tolerance_m=min(goal.tolerance_m, ENOUGH_M))
    with suppress(NothingSeenError, UnreachableError):
        for _ in range(most):
            seen = robot.observe()
            distance_m = goal.distance_m(seen.xy_m)
            if distance_m <= ENOUGH_M or not on_table(np.array(seen.xy_m)):
                break
            plan = replan(seen.image, seen.xy_m, exactly)
            first = replace(plan, goal=goal, steps=plan.steps[:1])
            if not plan.steps or goal.distance_m(first.predicted_end_xy_m) >= distance_m:
                break
            again, step = robot.observe(), first.steps[0]
            action = adapt_to_object(step.primitive, again.image)
            if not robot.can_reach(action, step.stop_phase, again.xy_m):
                break
            more = execute_plan(robot, first)
            paths = done.object_paths_xy_m + more.object_paths_xy_m
            done = replace(more, plan=done.plan, object_paths_xy_m=paths)
    return done


def attempt(
    world: Tabletop,
    task: PlanningTask,
    plan_for: Callable[..., Plan],
    corrections: int = 0,
    n_averaged_images: int = 1,
    by_plan: bool = False,
    ticks: list[Tabletop] | None = None,
) -> Outcome:
    """Plan and execute one task; plan_for: makes the plan of (image, start_xy_m, goal, mode).

    corrections: see `corrected`; n_averaged_images: of which a position is the mean; by_plan: place
    each action at the predicted position instead of the observed one; ticks: gets an element for
    each step of the simulation. The distance is the ground truth, after the last executed action.
    """
    world.place(task.obj, (0.0, 0.0), task.yaw_rad, config=task.config)
    world.on_step = ticks.append if ticks is not None else None
    once, at_xy_m = PlanMode(1, partial=True), None

    def observe() -> Observation:
        views = [world.observe() for _ in range(n_averaged_images)]
        return replace(views[0], xy_m=tuple(np.mean([v.xy_m for v in views], axis=0).tolist()))

    def execute(step: Step) -> Execution:
        nonlocal at_xy_m
        seen = replace(observe(), xy_m=at_xy_m) if by_plan else observe()
        at_xy_m = step.predicted_end_xy_m
        return world.execute(step, seen)

    known = {name: getattr(world, name) for name in ("can_reach", "park", "settle")}
    robot = SimpleNamespace(observe=observe, execute=execute, **known)
    seen = robot.observe()
    plan = plan_for(seen.image, seen.xy_m, task.goal, task.mode)
    at_xy_m = seen.xy_m
    try:
        outcome = execute_plan(robot, plan)
        outcome = corrected(robot, outcome, lambda *q: plan_for(*q, once), corrections)
    except UnreachableError as refused:
        outcome = refused.outcome
    end = world.object_pose()
    return replace(outcome, distance_m=task.goal.distance_m(end[:2]), end_pose=end)


def outcome_record(task: PlanningTask, outcome: Outcome) -> dict[str, Any]:
    """Return the columns of the tables for one outcome."""
    plan = outcome.plan
    error = np.hypot(*np.subtract(plan.predicted_end_xy_m, outcome.end_pose[:2]))
    return {
        "goals": task.goals,
        "mode": task.mode,
        "object_class": task.obj.category,
        "distance_m": outcome.distance_m,
        "predicted_m": plan.predicted_distance_m,
        "prediction_error_m": float(error),
        "std_m": plan.steps[-1].std_m if plan.steps else None,
        "steps": len(plan.steps),
        "actions": len(outcome.object_paths_xy_m),
        "dragged": any(isinstance(step.primitive, Drag) for step in plan.steps),
        "plan_s": plan.plan_s,
    }


def run_config(config: str) -> list[dict[str, Any]]:
    """Return records of a planner's outcomes on its frozen goals, with the goals' numbers."""
    torch.set_num_threads(1)
    about, records = CONFIGS[config], []
    planner, tasks = partial(about.planner, **about.arguments), frozen_tasks(about.world)
    with Tabletop() as world:
        pose = about.pose()
        for k in tqdm(about.chosen(tasks), config, unit=" goals", leave=False):
            how = about.execution | {"ticks": (ticks := [])}
            outcome = attempt(world, tasks[k], lambda *q: planner(pose(*q)), **how)
            record = outcome_record(tasks[k], outcome) | {"motion_s": STEP_S * len(ticks)}
            records.append({"task": k} | record)
    return records


def job(config: str) -> Job:
    """Return the job that evaluates one planner."""
    about = CONFIGS[config]
    settings, names = [about, tasks_sha256(about.world)], [*about.checkpoints.values()]
    specs = [TRAINED[name] for name in names if name in TRAINED]
    settings += [(spec.network, spec.training) for spec in specs]
    files = tuple(name for name in names if name not in TRAINED)
    data = tuple(spec.data for spec in specs)
    version = VERSIONS.get(config, VERSIONS.get(about.planner, 1))
    return Job(run_config, {"config": config}, settings, data, files, version)


def distances(records: dict[str, Rows]) -> pd.DataFrame:
    """Return statistics of the final distance and its parts by planner, objects, goals and mode.

    search: predicted distance from the goal; model: between predicted and actual positions.
    """
    table = pd.concat([pd.DataFrame(rows).assign(planner=name) for name, rows in records.items()])
    group = {category: name for name, classes in GROUPS.items() for category in classes}
    table["object_class"] = table["object_class"].map(group)
    table["dragged"] = table.get("dragged", pd.Series(np.nan, table.index)).astype(float)
    keys = ["planner", "object_class", "goals", "mode"]
    return table.groupby(keys, sort=False).agg(
        n=("distance_m", "size"),
        mean_m=("distance_m", "mean"),
        sem_m=("distance_m", "sem"),
        median_m=("distance_m", "median"),
        search_mean_m=("predicted_m", "mean"),
        model_mean_m=("prediction_error_m", "mean"),
        dragged=("dragged", "mean"),
    )


def summary_rows(table: pd.DataFrame, source: str = "constructed") -> Rows:
    """Return one row per planner and group on one source of goals: statistics of each mode."""
    rows = []
    of_source = table.xs(source, level="goals")
    for (planner, group), some in of_source.groupby(level=["planner", "object_class"], sort=False):
        about = CONFIGS[planner]
        row = {"planner": planner, "model": about.model, "world": about.world}
        row |= {"object_class": group, "n": ", ".join(map(str, some["n"]))}
        row["dragged_percent"] = 100 * some["dragged"].mean()
        for (*_, mode), values in some.iterrows():
            row |= {f"{mode}_{name}": values[name] for name in ("mean_m", "sem_m", "median_m")}
        rows.append(row)
    return plain(rows)


def decomposition_rows(table: pd.DataFrame) -> Rows:
    """Return the parts of the open-loop error on constructed goals, by planner, mode and group."""
    table = table.xs("constructed", level="goals").rename(columns={"mean_m": "total_mean_m"})
    rows = table.drop(columns=["sem_m", "median_m", "dragged"]).reset_index()
    rows["world"] = [CONFIGS[planner].world for planner in rows["planner"]]
    open_loop = [name for name, about in CONFIGS.items() if {*about.execution} <= {"by_plan"}]
    return plain(rows[rows["planner"].isin(open_loop)])


VARIANTS = {
    name: name.removesuffix(change)
    for change in ("_full", "_by_plan", "_corrected")
    for name in CONFIGS
    if name.removesuffix(change) in {*CONFIGS} - {name}
} | {"cem": "continuous"}
"""Planners with one change, each with the planner without it, for paired comparisons."""


def variant_rows(records: dict[str, Rows]) -> Rows:
    """Return paired differences for `VARIANTS` on stable objects, with 95 % intervals."""
    rows: Rows = []
    for name, than in VARIANTS.items():
        if not {name, than} <= set(records):
            continue
        both = pd.merge(*(pd.DataFrame(records[key]) for key in (name, than)), on="task")
        both, rngs = both[both.object_class_x.isin(STANDING)], {}
        for (goals, mode), pairs in both.groupby(["goals_x", "mode_x"], sort=False):
            rng = rngs.setdefault(goals, np.random.default_rng(0))
            by_m = pairs.distance_m_x - pairs.distance_m_y
            about = {"planner": name, "than": than, "object_class": "standing", "goals": goals}
            about |= {"mode": mode, "n": len(by_m)}
            names = ("difference_mean_m", "low_m", "high_m")
            about |= zip(names, interval(by_m, 2000, rng), strict=True)
            for what in ("actions", "motion_s"):
                if not pairs.get(f"{what}_y", pd.Series([np.nan])).isna().any():
                    more = interval(pairs[f"{what}_x"] - pairs[f"{what}_y"], 2000)
                    names = (f"difference_{end}{what}" for end in ("", "low_", "high_"))
                    about |= zip(names, more, strict=True)
            rows.append(about)
    return rows


def sigma_rows(records: dict[str, Rows]) -> Rows:
    """Return root mean squares [m] of error and σ of plans of stable objects, by number of actions.

    beyond_2_sigma_percent: 2 for a calibrated, round Gaussian.
    """
    rows: Rows = []
    ours = "continuous", "continuous_film_500"
    for name in [n for n in records if n in ours or n.startswith("RISK_WEIGHT")]:
        plans = pd.DataFrame(records[name]).query("object_class in @STANDING")
        plans = plans[(plans.steps == plans.actions) & (plans.steps > 0)]
        for steps, some in plans.groupby("steps"):
            error, sigma = some.prediction_error_m, some.std_m
            row = {"planner": name, "model": CONFIGS[name].model, "actions": steps, "n": len(some)}
            row["error_m"], row["sigma_m"] = (math.sqrt((v**2).mean()) for v in (error, sigma))
            rows.append(row | {"beyond_2_sigma_percent": 100 * (error > 2 * sigma).mean()})
    return plain(rows)


def training_rows(records: dict[str, Rows]) -> Rows:
    """Return statistics over three trainings of the mean distances, and the mean of the medians."""
    rows: Rows = []
    for model, planner in product(("cnp_500", "cnp_mixed"), (*RETRAINED, "astar_paper")):
        first = f"{planner}_{model}".replace("_cnp_500", "_pushes")
        names = [first, *(f"{planner}_{model}_seed_{k}" for k in (1, 2))]
        if not set(names) <= set(records):
            continue
        some = pd.concat([pd.DataFrame(records[n]).assign(by=n) for n in names])
        some = some[some["goals"] == "constructed"].groupby(["mode", "by"])["distance_m"]
        n = some.size().unstack().min(axis=1).reindex(MODES).dropna().astype(int)
        row = {"planner": planner, "network": model, "n": ", ".join(map(str, n))}
        for mode, each in some.mean().unstack().iterrows():
            ends = zip(("mean", "low", "high"), each.agg(["mean", "min", "max"]), strict=True)
            row |= {f"{mode}_{name}_m": value for name, value in ends}
            row[f"{mode}_median_m"] = some.median().unstack().loc[mode].mean()
        rows.append(row)
    return plain(rows)


def tables(folder: str = FOLDER) -> dict[str, Rows]:
    """Return all tables of the evaluated planners."""
    found = {about["config"]: result for about, result in runner.read("planning", job, folder)}
    records = {name: found[name] for name in CONFIGS if name in found}
    table = distances(records)
    return {
        "summary": [*reported.PLANNING_ROWS, *summary_rows(table)],
        "summary_uniform": summary_rows(table, "uniform"),
        "trainings": training_rows(records),
        "variants": variant_rows(records),
        "sigma": sigma_rows(records),
        "error_decomposition": decomposition_rows(table),
    }


main = runner.command_of("planning", __doc__, lambda: [job(name) for name in CONFIGS], tables)

if __name__ == "__main__":
    raise SystemExit(main())
