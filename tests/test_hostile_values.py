"""Whatever a public callable is given: an error that names the argument, or a sane result."""

import dataclasses
import decimal
import fractions
import inspect
import math
import re
import time
from functools import partial
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import affordlib.interactions.collect as collecting
from affordlib import evaluation, interactions, models, planning, show, world
from affordlib.interactions.recipes import Recipe, Variation
from affordlib.models.fit import EFFORT
from affordlib.paths import repo_root
from affordlib.perception import crop_from_depth
from affordlib.primitives import Drag, Grasp, LeverUp, Push, PushAt, Rotate, primitive_named
from affordlib.results import load_plan, read_results, results_table, save_plan, write_results
from affordlib.types import Goal, Outcome, Plan, Step, UnreachableError
from exercises import check

LIMIT_S = 5.0
NUMBERS = (math.nan, math.inf, -math.inf, 10**400, -1, 0, 1, 2.5, 1e300, 1e-300, -0.0, 10**6, True)
WORDS = ("", "0.05", "push", "../../x", "\x00", "ü" * 300, b"0.05", Path("/proc/x"))
HEAPS = (
    [],
    {},
    set(),
    (),
    [[]],
    {"x": 1},
    (0.1,),
    (0.1, "0.2"),
    (math.nan, 0),
    (1e9, 1e9),
    (1, 2, 3),
)
ARRAYS = (
    np.zeros(0),
    np.full((2, 48, 48), np.nan),
    np.zeros((2, 48, 48)),
    np.zeros((48, 48, 2), np.uint8),
    np.full((3, 2), np.inf),
    np.array(["a", "b"]),
    torch.full((2,), math.nan),
    torch.zeros(1, 2, 48, 48),
)
OBJECTS = (
    None,
    object(),
    lambda: None,
    1j,
    decimal.Decimal("0.05"),
    fractions.Fraction(1, 20),
    int,
)
OURS = (Goal((0.1, 0.0)), Push(0.0), world.Cuboid(0.06, 0.05, 0.05), planning.PlanMode(1, True))
HOSTILE = st.one_of(
    st.sampled_from(NUMBERS + WORDS + ARRAYS + OBJECTS + OURS),
    st.sampled_from(HEAPS),
    st.floats(),
    st.integers(),
    st.text(max_size=20),
    st.lists(st.floats(), max_size=4),
)


@pytest.fixture(scope="module")
def shop(one_world, skills, pushes, tmp_path_factory):
    """What valid calls are made of."""
    box = world.Cuboid(0.06, 0.05, 0.05)
    config = models.CNPConfig()
    arrays = interactions.InteractionTensors.from_dataset(pushes, np.arange(12))
    scaler = interactions.Scaler.fit(arrays)
    goal, path = Goal((0.05, 0.02)), np.zeros((3, 2))
    step = Step(Push(0.0), 0.5, (0.02, 0.0), path)
    plan = Plan(goal, (0.0, 0.0), (step,), "by hand", True, 1, 0.0)
    one_world.config = world.WorldConfig()
    one_world.place(box, (0.0, 0.0), 0.3)
    image, folder = one_world.depth_image(), tmp_path_factory.mktemp("hostile")
    film = show.FrameRecorder(1, 16, 16)
    film(one_world)
    return {
        "world": one_world,
        "obj": box,
        "image": image,
        "goal": goal,
        "step": step,
        "plan": plan,
        "model": skills.model(Push),
        "skills": skills,
        "config": config,
        "scaler": scaler,
        "arrays": arrays,
        "network": models.build(config, scaler, models.TrainingDomain.fit(arrays)),
        "outcome": Outcome(plan, 0.01, (0.04, 0.02, 0.0), (path,)),
        "folder": folder,
        "seen": one_world.execute_primitive(Push(0.0)),
        "film": film,
        "pursuit": planning.run_closed_loop(
            one_world, goal, skills, config=planning.ClosedLoopConfig(max_actions=1)
        ),
        "about": models.load_checkpoint("cnp_500")[1],
        "saved": save_plan(folder / "plan.json", plan),
        "data": pushes,
        "split": interactions.Split(*np.split(np.arange(30), (12, 24))),
        "test": interactions.open_interactions("push_test"),
    }


def call(act, **given):
    """What is called, and the arguments that it is given."""
    return act, given


def given_to(made):
    """The class of a dataclass's instance, and the arguments that give it."""
    return type(made), {f.name: getattr(made, f.name) for f in dataclasses.fields(made)}


def valid_calls(shop):
    """Every public callable: its name, itself, and arguments with which it works."""
    w, goal, model, image = (shop[name] for name in ("world", "goal", "model", "image"))
    at, arrays, network, plan = (0.0, 0.0), shop["arrays"], shop["network"], shop["plan"]
    few = models.TrainingConfig(steps=1, batch_size=2, n_targets=2, device="cpu")
    problem = planning.PlanningProblem(at, goal, planning.EffectMap(model, image), "single_partial")
    build = {"config": shop["config"], "scaler": shop["scaler"]}
    planner = shop["skills"].planner(planning.plan_astar)
    corners = tuple((0.03 * math.cos(a), 0.03 * math.sin(a)) for a in (0.0, 2.0, 4.0))
    ones = torch.ones(4)
    figure, ax = plt.subplots()

    def train_few(config, **given):
        return models.train(config=few if config is None else config, **given)

    def train_split(config, **given):
        return models.train_model(config=few if config is None else config, **given)

    def on_table(act):
        def put_back_and(**given):
            w.place(shop["obj"], at, 0.3, config=world.WorldConfig())
            return act(**given)

        put_back_and.__signature__ = inspect.signature(act)
        return put_back_and

    return {
        "Goal": call(Goal, xy_m=at, tolerance_m=0.02, turn_rad=0.1, height_m=0.1),
        "Step": given_to(shop["step"]),
        "Plan": given_to(plan),
        "Push": call(Push, theta=0.0, length=0.05, radius=0.2),
        "Push.towards": call(Push.towards, direction_rad=0.0),
        "Push.path": call(Push(0.0).path, phase=0.5),
        "PushAt": call(PushAt, contact=(0.0, -0.03), direction=1.5, length=0.01),
        "Drag": call(Drag, theta=0.0, length=0.05, grip_yaw=0.0),
        "Grasp": call(Grasp, grip_yaw=0.0, seen_height=0.05),
        "Rotate": call(Rotate, grip_yaw=0.0),
        "LeverUp": call(LeverUp, theta=0.0, contact_x=0.0, contact_y=0.0, reach=0.1),
        "primitive_named": call(primitive_named, name="push"),
        "Cuboid": call(world.Cuboid, length=0.05, width=0.05, height=0.05),
        "UprightCylinder": call(world.UprightCylinder, diameter=0.05, height=0.05),
        "LyingCylinder": call(world.LyingCylinder, length=0.05, diameter=0.05),
        "Sphere": call(world.Sphere, diameter=0.05),
        "Prism": call(world.Prism, corners=corners, height=0.05),
        "category_named": call(world.category_named, name="cuboid"),
        "WorldConfig": given_to(world.WorldConfig()),
        "Tabletop": call(world.Tabletop, config=world.WorldConfig()),
        "place": call(w.place, obj=shop["obj"], xy_m=at, yaw_rad=0.0, tool="gripper", config=None),
        "execute_primitive": call(
            on_table(w.execute_primitive), primitive=Push(0.0), stop_phase=0.5
        ),
        "execute": call(on_table(w.execute), step=shop["step"]),
        "execute_path": call(
            on_table(w.execute_path),
            path_xy_m=np.array([[-0.1, 0.0], [0.0, 0.0]]),
            primitive=None,
            stop_phase=1.0,
        ),
        "can_reach": call(on_table(w.can_reach), primitive=Push(0.0), stop_phase=1.0, at_xy_m=at),
        "picture": call(w.picture, width=32, height=32),
        "mark": call(on_table(w.mark), xy_m=at, rgb=(0.0, 0.5, 1.0), yaw_rad=0.0, scale=1.0),
        "shove": call(on_table(w.shove), dx_m=0.01, dy_m=0.0, dyaw_rad=0.1),
        "knock": call(on_table(w.knock), dx_m_s=0.1, dy_m_s=0.0, spin_rad_s=0.1),
        "topple": call(on_table(w.topple), direction_rad=0.1),
        "settle": call(on_table(w.settle), seconds=0.1),
        "Scaler": given_to(shop["scaler"]),
        "from_dataset": call(
            interactions.InteractionTensors.from_dataset,
            data=shop["data"],
            interactions=np.arange(4),
            action_channels=("x", "y"),
            effect_channels=("x", "y"),
        ),
        "open_interactions": call(interactions.open_interactions, name_or_path="push_test"),
        "split_interactions": call(
            interactions.split_interactions, n=20, seed=0, fold=0, n_folds=10
        ),
        "Split": given_to(interactions.split_interactions(20)),
        "InteractionTensors": given_to(arrays),
        "Log": call(
            interactions.Log, unit="m", outline=corners, crop_width_m=0.16, angle_unit="rad"
        ),
        "Log.add": call(
            interactions.Log("m", corners).add,
            start=(0.0, 0.0, 0.0),
            tool_t=(0.0, 1.0),
            tool_xy=((-0.1, 0.0), (0.0, 0.0)),
            end=(0.02, 0.0, 0.0),
            poses=None,
            context={"support": "felt"},
            group="all",
        ),
        "fit": call(quick_fit, data=log_of_eight(corners), model="np", seed=0),
        "plan_push_at": call(
            planning.plan_push_at,
            model=Still(),
            log=log_of_eight(corners),
            pose=(0.0, 0.0, 0.0),
            goal=Goal((0.01, 0.0)),
            n_pushes=1,
            seed=0,
        ),
        "cross_validate": call(
            evaluation.cross_validate,
            data=log_of_eight(corners),
            models=(),
            folds=2,
            within="group",
            seed=0,
        ),
        "crop_from_depth": call(
            crop_from_depth,
            depth=np.full((4, 4), 0.9),
            intrinsics=(9.0, 9.0, 2.0, 2.0),
            camera_pose=np.diag([1.0, -1.0, -1.0, 1.0]),
            centre=at,
            width_m=0.16,
            noise_m=0.004,
        ),
        "Recipe": given_to(Recipe()),
        "Variation": given_to(Variation()),
        "collect": call(
            collecting.collect,
            recipe=Recipe(n_interactions=1),
            path=shop["folder"] / "one.zarr.zip",
            progress=False,
            replace=False,
        ),
        "CNPConfig": given_to(models.CNPConfig()),
        "FiLMConfig": given_to(models.FiLMConfig()),
        "build": (models.build, build),
        "AffordanceCNP": (models.AffordanceCNP, build),
        "FiLMNetwork": call(models.FiLMNetwork, scaler=shop["scaler"], config=models.FiLMConfig()),
        "TrainingDomain": given_to(network.domain),
        "TrainingConfig": given_to(few),
        "coverage": call(models.coverage, truth=ones, mean=ones, std=ones, level=0.5),
        "calibration_rows": call(
            lambda model, tensors, phases: models.calibration_rows(model, tensors, phases),
            model=network,
            tensors=arrays,
            phases=(0.8, 1.0),
        ),
        "fit_sigma_scale": call(
            models.fit_sigma_scale, model=network, validation=arrays, phases=(0.8, 1.0)
        ),
        "load_checkpoint": call(models.load_checkpoint, name_or_path="cnp_500"),
        "save_checkpoint": call(
            models.save_checkpoint, model=network, path=shop["folder"] / "net.safetensors", about={}
        ),
        "condition_on_primitives": call(
            models.condition_on_primitives, model=network, actions=[Push(0.0)]
        ),
        "train": call(
            train_few,
            model=network,
            training=arrays,
            validation=arrays,
            config=few,
            resume_checkpoint=None,
        ),
        "train_model": call(
            train_split,
            data=shop["data"],
            split=shop["split"],
            config=few,
            model_config=shop["config"],
            symmetries=(),
        ),
        "train_literal": call(
            partial(models.train_literal, iterations=1),
            model=network,
            training=arrays,
            obs_max=2,
            learning_rate=0.0001,
            seed=0,
        ),
        "PlanMode": call(planning.PlanMode, max_steps=2, partial=True),
        "Disturbance": call(
            planning.Disturbance, kind="knock", action=0, x=0.1, y=0.0, turn=0.0, at_s=1.0
        ),
        "sample_disturbances": call(
            planning.sample_disturbances, seed=0, n=1, n_actions=2, kinds=("knock",)
        ),
        "action_limit": call(planning.action_limit, distance_m=0.1),
        "EffectMap": call(
            planning.EffectMap, model=model, image=image, kind=Push, n_directions=8, n_phases=5
        ),
        "PlanningProblem": given_to(problem),
        "ClosedLoopConfig": given_to(planning.ClosedLoopConfig()),
        "plan_astar": call(
            planning.plan_astar, problem=problem, n_directions=36, stop_phases=(0.5, 1.0)
        ),
        "plan_continuous": call(planning.plan_continuous, problem=problem, seed=0, draft=True),
        "plan_gradient": call(
            planning.plan_gradient, problem=problem, samples=10, starts=1, seed=0
        ),
        "kind_for": call(shop["skills"].kind_for, image=image),
        "Skills": call(planning.Skills, models={"push": model}, reachability=None, threshold=0.2),
        "execute_plan": call(on_table(planning.execute_plan), robot=w, plan=plan, corrections=0),
        "run_closed_loop": call(
            on_table(planning.run_closed_loop),
            robot=w,
            goal=Goal(at, 0.05),
            skills=shop["skills"],
            config=planning.ClosedLoopConfig(max_actions=1, horizon=1),
        ),
        "closed_loop": call(show.closed_loop, skills=shop["skills"], tolerance_m=0.002),
        "plot_depth": call(show.plot_depth, ax=ax, image=image),
        "plot_footprint": call(show.plot_footprint, ax=ax, obj=shop["obj"], xy_m=at, yaw_rad=0.0),
        "plot_plan": call(show.plot_plan, ax=ax, plan=plan, sigma=True, yaw_rad=0.0),
        "plot_outcome": call(show.plot_outcome, ax=ax, outcome=shop["outcome"]),
        "plot_table": call(show.plot_table, ax=ax, around_m=at, half_width_m=0.3),
        "save_figure": call(show.save_figure, figure=figure, folder=shop["folder"], name="x"),
        "GoalPicker": call(
            on_table(show.GoalPicker),
            world=w,
            planners={"A*": planner},
            goal_xy_m=(0.1, 0.0),
            seed=0,
        ),
        "PhaseSlider": call(on_table(show.PhaseSlider), world=w, action=Push(0.0), phase=0.5),
        "ConditioningExplorer": call(show.ConditioningExplorer, model=model, seen=shop["seen"]),
        "FrameRecorder": call(show.FrameRecorder, every=30, width=32, height=32),
        "show_animation": call(
            show.show_animation,
            recorder=shop["film"],
            path=shop["folder"] / "film.gif",
            beside=figure,
        ),
        "plot_levered": call(
            show.plot_levered,
            ax=ax,
            outline_m=np.array(corners),
            height_m=0.05,
            pose=np.zeros(4),
            color="black",
            label="x",
        ),
        "outline_in_lever_frame": call(
            show.outline_in_lever_frame,
            obj=shop["obj"],
            yaw_rad=0.3,
            contact_xy_m=np.array(at),
            theta_rad=0.1,
        ),
        "plot_closed_loop": call(
            show.plot_closed_loop, ax=ax, result=shop["pursuit"], obj=shop["obj"]
        ),
        "refuse_seen": call(
            evaluation.refuse_seen,
            about=shop["about"],
            data=shop["test"],
            interactions=np.arange(2),
        ),
        "error_row": call(evaluation.error_row, errors_m=np.array([0.1, 0.2])),
        "save_plan": call(save_plan, path=shop["folder"] / "p.json", plan=plan),
        "load_plan": call(load_plan, path=shop["saved"]),
        "write_results": call(
            write_results, out_dir=shop["folder"], notebook="x", parameters={}, tables={}
        ),
        "read_results": call(read_results, path="data/results/planning.json"),
        "results_table": call(
            results_table, rows=read_results("data/results/planning.json")["tables"]["summary"][:3]
        ),
        "check": call(check, name="01.1", attempt=None),
    }


NAMES = re.findall(r'^        "(\S+)": ', inspect.getsource(valid_calls), re.MULTILINE)


def log_of_eight(corners):
    """The same push eight times."""
    log = interactions.Log("m", corners)
    for _ in range(8):
        log.add((0, 0, 0), (0, 1), ((-0.1, 0), (0, 0)), end=(0.01, 0, 0))
    return log.tensors()


class Still:
    """A model of pushes that move nothing."""

    def predict(self, pushes):
        return np.zeros((len(pushes), 3)), np.ones((len(pushes), 3))


def quick_fit(data, model, seed):
    """`models.fit` with a single step of training."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(EFFORT, "few", (1, 1e-4, 1))
        return models.fit(data, model, seed)


def silent_nans(result):
    """Fields of a result that are not numbers, though they should be."""
    if dataclasses.is_dataclass(result) and not isinstance(result, type):
        fields = {f.name: getattr(result, f.name) for f in dataclasses.fields(result)}
        return [n for n, v in fields.items() if n != "std_m" and silent_nans(v)]
    if isinstance(result, np.ndarray) and result.dtype.kind == "f":
        return ["array"] if np.isnan(result).any() else []
    if isinstance(result, tuple | list):
        return [str(k) for k, value in enumerate(result) if silent_nans(value)]
    return ["number"] if isinstance(result, float) and math.isnan(result) else []


@pytest.mark.parametrize("name", NAMES)
def test_a_hostile_value_is_refused_by_name_or_does_no_harm(shop, name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    call, valid = valid_calls(shop)[name]
    call(**valid)
    if name == "write_results":  # a folder that is named relatively lies in the checkout
        monkeypatch.setattr("affordlib.paths.repo_root", lambda: tmp_path)
    found = []

    @settings(
        max_examples=200,
        derandomize=True,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(st.sampled_from(sorted(valid)), HOSTILE)
    def try_one(argument, value):
        began, wrong = time.process_time(), ""
        try:
            nans = silent_nans(call(**valid | {argument: value}))
            wrong = nans and f"gives NaN in {nans}"
        except UnreachableError:
            pass
        except (TypeError, ValueError) as error:
            named = "null byte" in str(error)  # of a path, as the system says it
            named = named or re.search(rf"\b{argument}\b", str(error)) or repr(value) in str(error)
            wrong = not named and f"is not named by {error!r}"
        except OSError as error:
            wrong = not isinstance(value, str | bytes | Path) and f"is no path, but {error!r}"
        except Exception as error:
            wrong = f"raises {error!r}"
        took_s = time.process_time() - began  # whatever else the machine does
        if took_s > LIMIT_S:
            wrong = f"takes {took_s:.0f} s"
        if wrong:
            found.append(f"{argument}={value!r:.60} {wrong:.200}")

    try_one()
    plt.close("all")
    assert not found, "\n".join(found)
    assert not list(repo_root().glob("*/x.json"))


MADE_BY_DRIVEN_ONES = """
ClosedLoopResult DisturbanceSchedule EffectModel Execution Robot
EffectNetwork NetworkConfig PushLog TabletopObject open_loop
"""


def test_every_public_callable_is_driven():
    for package in (world, interactions, models, planning, show, evaluation):
        public = {name for name, value in vars(package).items() if callable(value)}
        public -= {name for name in public if name.endswith(("Error", "Warning"))}
        assert public <= {*NAMES, *MADE_BY_DRIVEN_ONES.split()}
