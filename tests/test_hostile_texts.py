"""Hostile text in any text of any file that can be loaded is refused, or shown as text."""

import io
import json
import re
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.figure import Figure
from nbconvert.filters.markdown_mistune import markdown2html_mistune

from affordlib import interactions, logs, models, planning, results, show
from affordlib.interactions.store import write_interactions
from affordlib.logs.cross_validate import forecast_errors
from affordlib.logs.neural_process import load_neural_process
from affordlib.models.evaluation import network_predictions, refuse_seen
from affordlib.planning.skills import Reachability
from affordlib.show.picker_controls import words_as_html
from affordlib.types import Goal, Outcome, Plan
from affordlib.weights import read_weights, resolve_checkpoint, write_weights
from affordlib.world import Cuboid
from experiments import tasks
from experiments.tables import markdown_table
from tests.test_hostile_values import log_of_eight

MARKUP = "<img src=x onerror=alert(1)>'\"</div><script>[a](javascript:alert(1))![a](//x/y)a|b&lt;"
TEXTS = {"short": f"{MARKUP}$\\frac$\x1b]0;mine\x07\u202egpj.exe\x00\n", "long": "x" * 100_000}


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
    fixture("world").place(Cuboid(0.06, 0.05, 0.05))
    planners, skills = {"A*": planning.plan_astar}, planning.Skills(*skills)
    picker = show.GoalPicker(fixture("world"), skills, planners, view=False)
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
        write_interactions(data, path, 1)
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
