"""Any input to public callables, any text in a file: an error that names it, or a sane result."""

import dataclasses
import decimal
import fractions
import inspect
import io
import json
import math
import os
import random
import re
import struct
import time
from pathlib import Path
from xml.etree import ElementTree

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from nbconvert.filters.markdown_mistune import markdown2html_mistune

from affordlib import interactions, logs, models, planning, results, show, world
from affordlib.interactions.collect import collect
from affordlib.interactions.recipes import Recipe, Variation
from affordlib.logs.cross_validate import forecast_errors
from affordlib.logs.fit import EFFORT
from affordlib.logs.neural_process import load_neural_process
from affordlib.models.evaluation import network_predictions, refuse_seen
from affordlib.planning.skills import Reachability
from affordlib.primitives import Drag, Grasp, LeverUp, Push, PushAt, Rotate, primitive_named
from affordlib.results import read_results, repo_root, results_table, write_results
from affordlib.show.picker_controls import words_as_html
from affordlib.types import Goal, Obstacle, Outcome, Plan, Step, UnreachableError, check_array
from affordlib.weights import read_weights, resolve_checkpoint, write_weights
from affordlib.world.camera import View
from exercises import check
from experiments import tasks
from experiments.tables import markdown_table
from tests.planning.point_robot import Still

LIMIT_S, N_VALUES = 5.0, 60
NUMBERS = (math.nan, math.inf, -math.inf, 10**400, -1, 0, 1, 2.5, 1e300, 1e-300, -0.0, 10**6, True)
WORDS = ("", "0.05", "push", "../../x", "\x00", "ü" * 300, b"0.05", Path("/proc/x"))
SHIPPED = ("cnp_500", "np_cnp", "reachability", "push_test", "novelty_push", "planning")
SHIPPED += ("README.md",)
HEAPS = ([], {}, set(), (), [[]], [[0.1], [0.1, 0.2]], {"x": 1}, (0.1,), (0.1, "0.2"))
HEAPS += ((math.nan, 0), (1e9, 1e9), (1, 2, 3))
ARRAYS = (np.zeros(0), np.full((2, 48, 48), np.nan), np.zeros((2, 48, 48)))
ARRAYS += (np.zeros((48, 48, 2), np.uint8), np.full((3, 2), np.inf), np.array(["a", "b"]))
ARRAYS += (torch.full((2,), math.nan), torch.zeros(1, 2, 48, 48))
OBJECTS = (None, object(), lambda: None, 1j)
OBJECTS += (decimal.Decimal("0.05"), fractions.Fraction(1, 20), int)
OURS = (Goal((0.1, 0.0)), Push(0.0), world.Cuboid(0.06, 0.05, 0.05), planning.PlanMode(1, True))
FIXED = (*NUMBERS, *WORDS, *SHIPPED, *ARRAYS, *OBJECTS, *OURS, *HEAPS)
MARKUP = "<img src=x onerror=alert(1)>'\"</div><script>[a](javascript:alert(1))![a](//x/y)a|b&lt;"
TEXTS = {"short": f"{MARKUP}$\\frac$\x1b]0;mine\x07\u202egpj.exe\x00\n", "long": "x" * 100_000}


def hostile(rng):
    """Any value: one of those above, or random numbers or words."""
    real = lambda: struct.unpack("d", rng.randbytes(8))[0]  # noqa: E731
    whole = lambda: rng.choice((-1, 1)) * rng.getrandbits(rng.choice((2, 8, 80)))  # noqa: E731
    text = lambda: "".join(chr(rng.randrange(0xD000)) for _ in range(rng.randrange(20)))  # noqa: E731
    reals = lambda: [real() for _ in range(rng.randrange(5))]  # noqa: E731
    return rng.choice((*(lambda: rng.choice(FIXED),) * 5, real, whole, text, reals))()


AT, BOX = (0.0, 0.0), world.Cuboid(0.06, 0.05, 0.05)
CORNERS = tuple((0.03 * math.cos(a), 0.03 * math.sin(a)) for a in (0.0, 2.0, 4.0))
CALLABLES = {
    name: value
    for package in (world, interactions, models, planning, show, logs)
    for name, value in vars(package).items()
    if callable(value) and not name.endswith(("Error", "Warning"))
}
of_modules = (Goal, Step, Plan, Push, PushAt, Drag, Grasp, Rotate, LeverUp, primitive_named)
of_modules += (Recipe, Variation, collect, check, View, read_results, results_table, write_results)
CALLABLES |= {each.__name__: each for each in of_modules}
CALLABLES |= {"Push.towards": Push.towards, "Push.path": Push(0.0).path}
CALLABLES["from_dataset"] = interactions.InteractionTensors.from_dataset
CALLABLES |= {f"Log.{n}": getattr(logs.Log("m", CORNERS), n) for n in ("add", "query")}
CALLABLES["Log.centroid_pose"] = logs.Log("m", CORNERS).centroid_pose
CALLABLES["PushPlanner.plan"] = logs.PushPlanner(Still(), logs.PushedObject(np.array(CORNERS))).plan
OF_THE_WORLD = "place execute_primitive execute execute_path can_reach picture mark shove settle"
MADE_BY_DRIVEN_ONES = """ClosedLoopResult EffectModel Execution Planner Robot EffectNetwork
FittedModel LoggedPushes NetworkConfig Pushes TabletopObject open_loop"""
INSIDE = """
Batch BranchTable CircularHarmonics FreeSpace Reading about_training condition_on_final_effect
condition_on_poses condition_on_recorded_action corners_of dataset_sha256 descend final_error
final_errors_m gaps_m lever_up_tensors make_steps network_predictions placed plot_flow predict_steps
predict_trajectories roll_out sample_mixed search stored_sha256
"""
"""Parts of driven ones, for pages that show what is inside: they may refuse in any words."""
NAMES = sorted({*CALLABLES, *OF_THE_WORLD.split(), "kind_for"} - {*MADE_BY_DRIVEN_ONES.split()})


def log_of_eight(**about):
    log = logs.Log("m", CORNERS)
    for _ in range(8):
        log.add((0, 1), ((-0.1, 0), (0, 0)), ((0, 0, 0), (0.0163, 0, 0)), **about)
    return log.pushes()


def fields_of(*made):
    """Arguments that give instances of dataclasses, by class."""
    return {type(one).__name__: dict(vars(one)) for one in made}


@pytest.fixture(scope="module")
def shop(one_world, skills, pushes, levers, levered, tmp_path_factory):
    """A valid value for each parameter by name, or by callable where that needs another."""
    folder, path, log = tmp_path_factory.mktemp("hostile"), np.zeros((3, 2)), log_of_eight()
    one_world.config = world.WorldConfig()
    one_world.place(BOX, AT, 0.3)
    image, model, goal = one_world.depth_image(), skills.model(Push), Goal((0.05, 0.02))
    seen, executed = one_world.observe(), one_world.execute_primitive(Push(0.0))
    arrays = interactions.InteractionTensors.from_dataset(pushes, np.arange(12))
    scaler, domain = interactions.Scaler.fit(arrays), models.TrainingDomain.fit(arrays)
    config, test = models.CNPConfig(), interactions.open_interactions("push_test")
    still = logs.fit(log, "constant")
    few = models.TrainingConfig(steps=1, batch_size=2, n_targets=2, device="cpu")
    network = models.build(config, scaler, domain)
    step = Step(Push(0.0), 0.5, (0.02, 0.0), path)
    plan = Plan(goal, AT, (step,), "by hand", True, 0.0)
    effects = planning.EffectMap(model, image)
    problem = planning.PlanningProblem(AT, goal, effects, "single_partial")
    batch = interactions.dataset.sample_mixed(arrays, 2, 2, torch.Generator().manual_seed(0))
    wall = Obstacle.disc((0.2, 0.0), 0.03)
    once = planning.ClosedLoopConfig(max_actions=1)
    pursuit = planning.run_closed_loop(one_world, goal, skills, config=once)
    figure, (_, ax) = plt.figure(), plt.subplots()
    rows = read_results("data/results/planning.json")["tables"]["summary"][:3]
    numbers = {"theta contact_x contact_y dy_m": 0.0, "dx_m reach direction_rad direction": 0.1}
    numbers |= {"length width height diameter height_m": 0.05, "stop_phase phase level": 0.5}
    numbers |= {"n_directions n_targets obs_max n_poses": 4, "yaw_rad": 0.3, "n": 20}
    numbers |= {"max_steps": 2, "partial": True}
    places = {"xy_m at_xy_m start_xy_m": AT, "contact": (0.0, -0.03), "corners outline": CORNERS}
    places |= {"outline_m": np.array(CORNERS), "path_xy_m": np.array([[-0.1, 0.0], [0.0, 0.0]])}
    planned = {"action primitive": Push(0.0), "actions": [Push(0.0)], "step": step, "plan": plan}
    planned |= {"problem": problem, "planners": {"A*": planning.plan_astar}, "effects": effects}
    planned |= {"result": pursuit, "outcome": Outcome(plan, 0.01, (0.04, 0.02, 0.0), (path,))}
    real = {"obj": BOX, "robot world": one_world, "image": image, "seen": seen, "attempt": None}
    real |= {"obstacles": (wall,), "obstacle": wall}
    learned = {"data": pushes, "interactions": np.arange(2), "training validation tensors": arrays}
    learned |= {"split": interactions.Split(*np.split(np.arange(30), (12, 24))), "scaler": scaler}
    learned |= {"action_channels effect_channels": ("x", "y"), "truth mean std": torch.ones(4)}
    learned |= {"skills": skills, "model": model, "about": models.load_checkpoint("cnp_500")[1]}
    learned |= {"config": config, "generator": torch.Generator().manual_seed(0)}
    shown = {"ax": ax, "figure": figure, "rgb": (0.0, 0.5, 1.0), "unit": "m", "notebook": "x"}
    shown |= {"folder out_dir": folder, "parameters tables": {}, "rows": rows}
    by_name = numbers | places | planned | real | learned | shown
    by_callable = fields_of(step, plan, problem, scaler, domain, arrays, Recipe(), Variation(), few)
    by_callable |= fields_of(models.FiLMConfig(), interactions.split_interactions(20), batch)
    names = {"primitive_named": "push", "category_named": "cuboid", "save_figure": "x"}
    names |= {"check": "01.1"}
    by_callable |= {each: {"name": name} for each, name in names.items()}
    by_callable |= {"open_interactions stored_sha256": {"name_or_path": "push_test"}}
    by_callable |= {"condition_on_primitives fit_sigma_scale final_errors_m": {"model": network}}
    by_callable |= {"load_checkpoint": {"name_or_path": "cnp_500"}}
    by_callable |= {"plan_gradient": {"samples": 10}, "plan_astar": {"stop_phases": (0.5, 1.0)}}
    by_callable |= {"Grasp": {"seen_height": 0.05}, "PushAt": {"length": 0.01}}
    by_callable |= {"settle": {"seconds": 0.1}}
    by_callable |= {"place": {"config": None}, "Tabletop": {"config": world.WorldConfig()}}
    by_callable |= {"picture": {"width": 32, "height": 32}, "Skills": {"models": {"push": model}}}
    by_callable |= {"FiLMNetwork": {"config": models.FiLMConfig()}, "refuse_seen": {"data": test}}
    by_callable |= {"search": {"table": planning.BranchTable(effects, 4)}}
    by_callable |= {"train": {"model": network, "config": few}, "fit": {"data": log, "model": "np"}}
    by_callable |= {
        "planar": {"values": ((0.0,) * 6 + (1.0,),)},
        "Log.centroid_pose": {"pose": (0.0,) * 3},
        "make_steps": {"chain": torch.tensor([[0.3, 0.8]])},
        "conditioning_explorer": {"seen": executed},
        "read_results": {"path": "data/results/planning.json"},
        "collect": {"recipe": Recipe(n_interactions=1), "path": folder / "one.zarr.zip"}
        | {"progress": False},
        "Log.add": {"poses": ((0.0,) * 3, (0.02, 0.0, 0.0)), "poses_t": (0.0, 1.0)}
        | {"tool_t": (0.0, 1.0), "tool_xy": ((-0.1, 0.0), AT), "context": {"support": "felt"}},
        "Log.query": {"tool_xy": ((-0.1, 0.0), AT), "context": {}},
        "cross_validate": {"data": log, "models": (), "folds": 2},
        "PushPlanner.plan": {"pose": (0.0,) * 3, "goal": Goal((0.01, 0.0)), "n_pushes": 1},
        "PushPlanner": {"model": Still(), "obj": logs.PushedObject(np.array(CORNERS))},
        "PushedObject": {"lengths_m": (0.01, 0.02), "context": {}},
        "save_model": {"model": still, "path": folder / "still.safetensors"},
        "load_model": {"path": logs.save_model(still, folder / "constant.safetensors")},
        "summary": {"errors": logs.cross_validate(log, (), 2), "by": ("model",)},
        "train_model": {"config": few, "model_config": config},
        "save_checkpoint": {"model": network, "path": folder / "net.safetensors", "about": {}},
        "run_closed_loop": {"config": once, "goal": Goal(AT, 0.05)},
        "about_training": {"seen": np.arange(2), "config": few},
        "condition_on_final_effect": {"model": network, "effect": arrays.effect[:, -1]},
        "condition_on_poses": {"start": torch.zeros(12, dtype=torch.int64)},
        "descend": {"target_xy_m": np.array([0.05, 0.02]), "generator": np.random.default_rng(0)},
        "final_error": {"record": models.network_predictions(model, pushes, np.arange(2))},
        "gaps_m": {
            "obstacles": [planning.corners_of(wall)],
            "shapes": np.array([[CORNERS, CORNERS]]),
        },
        "placed": {"corners": np.array(CORNERS), "poses": np.zeros((2, 3))},
        "plot_flow": {"boxes": {"a": (0, 0, "k"), "b": (1, 1, "k")}, "arrows": [("a", "b")]},
        "roll_out": {"direction_rad": torch.zeros(3, 1), "phase": torch.ones(3, 1)},
        "lever_up_tensors": {"data": levers},
        "predict_steps": {"tensors": levered, "protocol": "image_only"}
        | {"model": models.load_checkpoint("lever_up_last_pose_1800")[0]},
        "predict_trajectories": {"model": skills.model(Grasp), "channel": "z"}
        | {"primitive": Grasp()},
    }
    both = by_name, by_callable
    return [{k: v for names, v in given.items() for k in names.split()} for given in both]


def driven(name, shop):
    """A callable, with a valid value for each of its parameters."""
    by_name, by_callable = shop
    w, fixed = by_name["world"], {"workers": 1} if name == "collect" else {}
    act = by_name["skills"].kind_for if name == "kind_for" else CALLABLES.get(name)
    act = act or getattr(w, name, None) or getattr(w.placed, name)
    given = by_name | by_callable.get(name, {})
    parameters = inspect.signature(act).parameters.values()
    valid = {
        p.name: given[p.name] if p.default is p.empty or p.name in given else p.default
        for p in parameters
        if p.kind is not p.VAR_KEYWORD and p.name not in fixed
    }

    def called(**arguments):
        if name in OF_THE_WORLD.split() or {"world", "robot"} & valid.keys():
            w.place(BOX, AT, 0.3, config=world.WorldConfig())
        if name.startswith("train") and arguments.get("config", valid) is None:
            arguments["config"] = valid["config"]
        unnamed = [arguments.pop(p.name) for p in parameters if p.kind is p.POSITIONAL_ONLY]
        with pytest.MonkeyPatch.context() as patch:
            patch.setitem(EFFORT, "few", (1, 1e-4, 1))  # a single step of training
            return act(*unnamed, **arguments, **fixed)

    return called, valid


def silent_nans(result):
    """Fields of a result that are NaN but should be numbers."""
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
    call, valid = driven(name, shop)
    call(**valid)
    writers = ("write_results", "collect", "save_checkpoint", "save_model")
    if name in writers or name.startswith("train"):  # a relative path starts in the checkout
        monkeypatch.setattr("affordlib.results.repo_root", lambda: tmp_path)
    found, rng = [], random.Random(os.environ.get("HOSTILE_SEED", "0") + name)
    for _ in range(N_VALUES):
        argument, value = rng.choice(sorted(valid)), hostile(rng)
        began, wrong = time.process_time(), ""
        try:
            nans = silent_nans(call(**valid | {argument: value}))
            wrong = nans and f"gives NaN in {nans}"
        except UnreachableError:
            pass
        except (TypeError, ValueError) as error:
            named = name in INSIDE.split() or "null byte" in str(error)  # as the system says it
            plain = re.sub("_(m|rad)$", "", argument)
            named = named or re.search(rf"\b{plain}(_m|_rad)?\b", str(error))
            named = named or (repr(value).strip("'")[:20] or "''") in str(error)
            named = named or (callable(value) and "InteractionTensors" in str(error))  # its own
            wrong = not named and f"is not named by {error!r}"
        except OSError as error:
            wrong = not isinstance(value, str | bytes | Path) and f"is no path, but {error!r}"
        except Exception as error:
            wrong = name not in INSIDE.split() and f"raises {error!r}"
        took_s = time.process_time() - began  # whatever else the machine does
        if took_s > LIMIT_S:
            wrong = f"takes {took_s:.0f} s"
        if wrong:
            found.append(f"{argument}={value!r:.60} {wrong:.200}")
    plt.close("all")
    assert not found, "\n".join(found)
    assert not list(repo_root().glob("*/x.json"))


def test_what_holds_no_numbers_is_named():
    learned = torch.ones(1, 2, requires_grad=True)
    for wrong in ([[1.0], [1.0, 2.0]], [1j, 2.0], ["a", "b"], [None, 1.0], learned):
        with pytest.raises(ValueError, match="outline must be finite numbers of shape"):
            check_array("outline", wrong, 2)


def planted(value, text):
    """Copies of JSON values, in each of which another text, or name, is replaced by `text`."""
    if isinstance(value, str):
        yield text
    elif isinstance(value, dict):
        for name in value:
            yield {text if n == name else n: v for n, v in value.items()}
            yield from (value | {name: new} for new in planted(value[name], text))
    elif isinstance(value, list | tuple):
        for k, old in enumerate(value[:2]):
            yield from ([*value[:k], new, *value[k + 1 :]] for new in planted(old, text))


def of_results(path, _):
    def shown(new):
        path.write_text(json.dumps(new))
        for rows in results.read_results(path)["tables"].values():
            table, page = results.results_table(rows), markdown2html_mistune(markdown_table(rows))
            assert "".join([*table.columns, *table.to_numpy().flat]).isprintable()
            assert {*re.findall(r"<(\w+)", page)} == {"table", "thead", "tbody", "tr", "th", "td"}
            yield table.to_html()
            results.results_table(rows, ["speed"])

    tables = {"t": [{"planner": "a", "mean_m": 0.1}]}
    return {"notebook": "a", "parameters": {"x": "y"}, "versions": {}, "tables": tables}, shown


def of_weights(path, source, shown):
    tensors, about = read_weights(source, "")
    return about, lambda new: shown(write_weights(path, tensors, new))


def picked(fixture, *skills):
    """What the goal picker says and sends to the page."""
    fixture("world").place(BOX)
    planners, skills = {"A*": planning.plan_astar}, planning.Skills(*skills)
    picker = show.GoalPicker(fixture("world"), skills, planners)
    yield picker.controls.words.value
    yield str([getattr(picker._view, name) for name in ("object", "scene", "table")])


def of_a_network(path, fixture):
    about, known = models.load_checkpoint("cnp_500")[1], fixture("pushes")

    def shown(file):
        model, read = models.load_checkpoint(file)
        yield from picked(fixture, {"push": model}) if read == about else ()
        refuse_seen(read, known, np.arange(5))

    return of_weights(path, models.save_checkpoint(fixture("untrained"), path, about), shown)


def of_reachability(path, fixture):
    known, source = {"push": fixture("trained")}, Reachability(("push", "drag")).save(path)
    return of_weights(path, source, lambda file: picked(fixture, known, Reachability.load(file)))


def of_a_neural_process(path, _):
    source = resolve_checkpoint("np_simulated_pushes")
    return of_weights(path, source, lambda file: [str(load_neural_process(file))])


def of_a_model_of_pushes(path, _):
    def shown(file):
        model = logs.load_model(file)
        yield forecast_errors(model, model.data).to_html()
        logs.PushedObject.of(model.data)

    source = logs.save_model(logs.fit(log_of_eight(), "constant"), path)
    return of_weights(path, source, shown)


def of_a_log(*_):
    about = {"group": "a", "context": {"support": "felt"}, "name": "1"}
    return about, lambda new: [str(log_of_eight(**{k: v for k, v in new.items() if k in about}))]


def of_a_data_set(path, fixture):
    path, known = path.with_suffix(".zarr.zip"), fixture("pushes").isel(interaction=slice(6)).load()
    (model, about), category = models.load_checkpoint("cnp_500"), known["category"].attrs

    def shown(new):
        data = known.copy(deep=True)
        data["category"].attrs = {k: new[k] for k in category if k in new}
        text = {k: json.dumps(v) for k, v in new.items() if (k, type(v)) == ("recipe", dict)}
        data.attrs = new | text  # a file holds a recipe as text
        interactions.store.write_interactions(data, path, 1)
        read = interactions.open_interactions(path)
        yield read._repr_html_()
        yield words_as_html(str(network_predictions(model, read, np.arange(4))["category"]))
        refuse_seen(about, read, np.arange(2))

    return known.attrs | category | {"recipe": json.loads(known.attrs["recipe"])}, shown


def of_goals(path, fixture):
    def shown(new):
        path.write_text(tasks.sealed(path.stem, json.dumps(new)))
        fixture("monkeypatch").setitem(tasks.FROZEN, "clean", path)
        yield str(tasks.frozen_tasks())

    return {"tasks": [tasks.frozen_tasks("perturbed")[0].to_json()]}, shown


KINDS = (of_results, of_a_network, of_reachability, of_a_neural_process, of_a_model_of_pushes)


@pytest.mark.parametrize("text", TEXTS)
@pytest.mark.parametrize("kind", [*KINDS, of_a_log, of_a_data_set, of_goals])
def test_a_hostile_text_in_a_file_is_refused_or_shown_as_text(kind, text, tmp_path, request):
    content, shown = kind(tmp_path / "file.safetensors", request.getfixturevalue)
    for new in planted(content, TEXTS[text]):
        said = ""
        try:
            for words in shown(new):
                assert "<img src" not in words
        except ValueError as error:
            said = str(error)
        assert said.isprintable()
        assert len(said) < 1500
        words = words_as_html(f"**{said or TEXTS[text][:999]}**")
        assert set(re.findall(r"<\w+", words)) == {"<div", "<b"}
        ElementTree.fromstring(words)  # one element, well formed


@pytest.mark.parametrize("text", TEXTS.values())
def test_a_picture_takes_any_name(text):
    plan, ax = Plan(Goal((0.1, 0)), (0, 0), (), text[:999], True, 0.0), Figure().subplots()
    show.plot_outcome(ax, Outcome(plan, 0.0, (0.1, 0.0, 0.0)))
    ax.figure.savefig(io.BytesIO())
    assert ax.get_title(loc="left").startswith(text[:999])
