"""Figures, explorers whose sliders need no kernel, and the planner of the browser (table.js)."""

import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import playwright
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image

from affordlib import show
from affordlib.geometry import rotated, unit_vector
from affordlib.models.base import condition_on_primitives
from affordlib.planning import execute_plan, plan_astar, plan_continuous
from affordlib.planning.effect_map import roll_out
from affordlib.primitives import Push
from affordlib.show.table_data import object_data, obstacle_data, table_data
from affordlib.types import Goal, Obstacle
from affordlib.world import Cuboid
from experiments.try_it import OBJECTS
from tests.planning.point_robot import problem_of
from tests.waiting import printed

ASK = """
import fs from "node:fs";
import { EffectMap, plan, reachability, spare } from "./table.mjs";
const { reach, object, queries } = JSON.parse(fs.readFileSync("queries.json"));
object.map = new EffectMap(object.map);
const reachable = reach && reachability(reach, object.map.primitive);
const answer = ({ action, ...one }) =>
  action ? spare({ object, ...one }, ...action) : plan({ object, reachable, ...one });
console.log(JSON.stringify(queries.map(answer)));
"""
push = pytest.fixture(lambda placed: placed.execute_primitive(Push.towards(0.6)))
slider = pytest.fixture(lambda placed: show.phase_explorer(placed, Push.towards(0.6), 0.8))
explorer = pytest.fixture(lambda trained, push: show.conditioning_explorer(trained, push))


def test_a_footprint_is_drawn_where_the_object_is(world, trained):
    ax = Figure().subplots()
    show.plot_footprint(show.plot_table(ax), Cuboid(0.06, 0.04, 0.05), (0.1, -0.05), np.pi / 2)
    outline = ax.lines[-1].get_xydata()
    np.testing.assert_allclose(np.ptp(outline, axis=0), [4.0, 6.0], atol=1e-9)
    np.testing.assert_allclose(outline[:-1].mean(axis=0), [10.0, -5.0], atol=1e-9)
    world.place(Cuboid(0.06, 0.05, 0.05))
    problem = problem_of(trained, world.depth_image(), (0.0, 0.0), Goal((0.12, 0.0)))
    outcome = execute_plan(world, plan_astar(problem))
    assert "mm from the goal" in show.plot_outcome(ax, outcome, world.obj).get_title(loc="left")
    last = [line.get_xydata()[:-1] for line in ax.lines if len(line.get_xydata()) == 5][-1]
    np.testing.assert_allclose(last.mean(axis=0), 100 * np.array(outcome.end_pose[:2]), atol=1e-9)


def test_the_turn_of_a_goal_is_that_from_where_the_object_was(world):
    world.place(Cuboid(0.06, 0.04, 0.05), yaw_rad=0.6)
    (scene := show.Scene(world)).mark(Goal((0.1, 0.0), turn_rad=0.5), from_rad=0.3)
    assert np.arctan2(*scene._marks[-1].model_matrix[1::-1, 0]) == pytest.approx(0.8)


def test_the_configuration_of_a_reader_changes_no_figure(tmp_path):
    (tmp_path / "matplotlibrc").write_text(
        "text.usetex: True\nfont.family: fantasy\naxes.grid: False\nfigure.figsize: 2, 2\n"
        "axes.facecolor: black\nsavefig.bbox: tight\naxes.prop_cycle: cycler('color', ['red'])\n"
    )
    code = (
        "import matplotlib.pyplot as plt\nfrom affordlib.show import save_figure, plot_table\n"
        "from pathlib import Path\nfigure, ax = plt.subplots()\nplot_table(ax)\n"
        "ax.set_title('50 % of $x_1$')\nax.plot([1, 2])\n"
        "print(save_figure(figure, Path('{}'), 'one'))"
    )
    drawn = []
    for name, own in (("own", {"MATPLOTLIBRC": str(tmp_path)}), ("plain", {})):
        environment = os.environ | {"MPLBACKEND": "agg"} | own
        path = printed(code.format(tmp_path / name), env=environment).strip()
        drawn.append(np.asarray(Image.open(path)))
    np.testing.assert_array_equal(*drawn)


@pytest.fixture
def placed(world):
    world.place(OBJECTS["box"], (0.02, -0.01), 0.4)
    return world


def state_of(explorer, *at):
    return int(np.ravel_multi_index(at, [len(values) for values in explorer.sliders.values()]))


@pytest.mark.slow
def test_what_is_observed_decides_what_is_predicted(explorer, trained, push):
    context = condition_on_primitives(trained, [push.primitive])
    t = torch.linspace(0, 1, 25)[None]
    with torch.no_grad():
        plain = trained.predict(trained.encode(torch.tensor(push.image)[None]), context, t)
    _, line, dots = explorer.panels["effect, x [cm], over phase"]
    alone = line.y[state_of(explorer, 4, 7, 4)]
    np.testing.assert_allclose(alone, 100 * plain.effect_mean[0, :, 0], atol=2e-3)
    np.testing.assert_array_equal(alone, line.y[state_of(explorer, 4, 2, 4)])  # w₁ = 1: no effect
    assert dots.y[state_of(explorer, 4, 7, 4)].max() < line.y.min()  # and no point of it
    assert np.abs(alone - line.y[state_of(explorer, 4, 7, 2)]).max() > 0.01
    late = line.y[state_of(explorer, 0, 10, 0)]
    np.testing.assert_allclose(line.y[state_of(explorer, 3, 10, 0)], late, atol=1e-4)
    assert late[-1] == pytest.approx(100 * push.effect[-1, 0], abs=3)


def test_a_stop_leaves_the_object_where_the_full_push_had_it(slider):
    _, _, rest, full = slider.panels["from above [cm]"]
    assert np.hypot(rest.x - full.x, rest.y - full.y).max() < 0.1
    moved, dots = slider.panels["object has moved [cm], over phase"]
    np.testing.assert_allclose(np.interp(dots.x, moved.x, moved.y), dots.y, atol=0.1)
    assert "has moved 0.0 cm" in slider.words[0]
    assert "At t = 0.80" in slider.words[slider.state]


@pytest.mark.parametrize("name", ["slider", "explorer"])
def test_a_page_gets_the_numbers_the_script_and_a_picture(name, request):
    explorer = request.getfixturevalue(name)
    html = explorer._repr_mimebundle_()["text/html"]
    assert len(html) < 450_000
    assert '<img alt="' in html
    data = json.loads(re.search(r"parentElement, (\{.*)\)</script>", html)[1])
    drawn = [len(panel["lines"]) for panel in data["panels"]]
    assert drawn == [*map(len, explorer.panels.values())]
    assert len(data["words"]) == np.prod([len(one["values"]) for one in data["sliders"]])


def test_values_out_of_range_are_named(trained, push, world):
    with pytest.raises(ValueError, match="effect_t must lie"):
        show.conditioning_explorer(trained, push, 1.2)
    with pytest.raises(ValueError, match="phase must lie"):
        show.phase_explorer(world, Push.towards(0.6), -1)


@pytest.fixture(scope="module")
def ask(tmp_path_factory):
    """Function of an object's data and problems that returns the browser's plans."""
    folder, driver = tmp_path_factory.mktemp("node"), Path(playwright.__file__).parent / "driver"
    node = next((str(path) for path in driver.glob("node*")), shutil.which("node"))
    shutil.copy(Path(show.__file__).with_name("table.js"), folder / "table.mjs")
    (folder / "ask.mjs").write_text(ASK)

    def plans(data, queries, reach=None):
        question = {"object": data, "queries": queries, "reach": reach}
        (folder / "queries.json").write_text(json.dumps(question))
        command = [node, "ask.mjs"]
        done = subprocess.run(command, cwd=folder, capture_output=True, timeout=120, check=False)
        assert not done.returncode, done.stderr.decode()
        return json.loads(done.stdout)

    return plans


@pytest.fixture(scope="module")
def seen(one_world, skills):
    known = {}
    for name, obj in OBJECTS.items():
        one_world.place(obj, (0.0, 0.0), 0.0)
        image = np.array(one_world.depth_image())
        effects = skills.effects(image)
        known[name] = image, effects, object_data(obj, effects)
    return known


def goals(n, seed, far_m=0.24):
    return np.random.default_rng(seed).uniform(-far_m, far_m, (n, 2)).round(4).tolist()


@pytest.mark.parametrize("name", OBJECTS)
def test_the_browser_predicts_what_the_effect_map_predicts(ask, seen, skills, name):
    _, effects, data = seen[name]
    queries = [{"pose": [0.01, -0.02, 0.7], "goal": goal} for goal in goals(40, 0)]
    found = ask(data, queries, table_data(skills)["reach"])
    assert sum(len(plan["steps"]) > 1 for plan in found) > 10
    assert len(json.dumps(data)) < 60_000
    for plan in found:
        chain = torch.tensor(plan["chain"], dtype=torch.float64).reshape(-1, 2)
        direction, phase = chain.T[:, None]
        ends, turns, variances = roll_out(effects, direction - 0.7, phase)
        ends = np.array((0.01, -0.02)) + rotated(ends[0].numpy(), 0.7)
        poses = np.array([step["end"] for step in plan["steps"]]).reshape(-1, 3)
        np.testing.assert_allclose(poses[:, :2], ends, atol=5e-5)
        np.testing.assert_allclose(poses[:, 2] - 0.7, turns[0], atol=1e-3)
        std = [step["std"] for step in plan["steps"]]
        np.testing.assert_allclose(std, variances[0].sqrt(), atol=2e-5)
        for k, step in enumerate(plan["steps"]):
            before = [0.01, -0.02, 0.7] if k == 0 else poses[k - 1]
            assert skills.reachable(effects.kind)(np.array([before[:2]]), step["direction"])[0]


@pytest.mark.slow
def test_the_browser_reaches_what_python_reaches(ask, seen, skills):
    for name in ("box", "roller"):
        image, _, data = seen[name]
        wanted = goals(25, 1)
        queries = [{"pose": [0, 0, 0], "goal": g} for g in wanted]
        found = ask(data, queries, table_data(skills)["reach"])
        for goal, plan in zip(wanted, found, strict=True):
            best = plan_continuous(skills.problem(image, (0.0, 0.0), Goal(tuple(goal))))
            if best.predicted_distance_m < 5e-4:
                assert plan["distance"] < 5e-4, goal


def obstacles_of(rng, n, near=0.07, far=0.2):
    """Discs and boxes around the origin."""
    made = []
    for k in range(n):
        at = tuple((rng.uniform(near, far) * unit_vector(rng.uniform(0, 2 * np.pi))).tolist())
        size = tuple(rng.uniform(0.02, 0.06, 2).tolist())
        made.append(Obstacle.disc(at, 0.02) if k % 2 else Obstacle.box(at, size, rng.uniform(0, 3)))
    return made


@pytest.mark.parametrize("name", ["box", "roller", "wedge"])
def test_the_free_space_check_is_that_of_python(ask, seen, skills, name):
    image, _, data = seen[name]
    rng = np.random.default_rng(7)
    obstacles = obstacles_of(rng, 5)
    problem = skills.problem(image, (0.0, 0.0), Goal((0.03, 0.03)), obstacles=obstacles)
    begins = rng.uniform(-1, 1, (200, 3)) * (0.12, 0.12, 1.5)
    direction, phase = rng.uniform(-3, 3, 200), rng.uniform(0.3, 1, 200)
    expected = problem.spare_m(begins, *map(torch.from_numpy, (direction, phase)))
    common = {"pose": [0, 0, 0], "obstacles": [obstacle_data(one) for one in obstacles]}
    actions = zip(begins.tolist(), direction.tolist(), phase.tolist(), strict=True)
    queries = [common | {"action": action} for action in actions]
    found = np.array(ask(data, queries))
    near = expected < 0.0009  # Python does not distinguish larger gaps
    assert 30 < (expected < 0).sum() < 180
    # Where the hand is not free, Python does not compute the object's gap, which may be less.
    same = np.isclose(found, expected, atol=1e-4)
    assert same[near].mean() > 0.5
    assert (same | ((found < expected) & (expected < 0)))[near].all()
    assert (found[~near] > 0.0008).all()


def test_no_plan_meets_an_obstacle(ask, seen, skills):
    image, _, data = seen["box"]
    rng, queries, problems = np.random.default_rng(4), [], []
    while len(queries) < 30:
        goal, obstacles = tuple(rng.uniform(-0.2, 0.2, 2).tolist()), obstacles_of(rng, 4)
        try:
            problem = skills.problem(image, (0.0, 0.0), Goal(goal), obstacles=obstacles)
        except ValueError:  # an obstacle lies on the goal
            continue
        problems.append(problem)
        near = [obstacle_data(one) for one in obstacles]
        queries.append({"pose": [0, 0, 0], "goal": goal, "obstacles": near})
    found, reached = ask(data, queries), 0
    for problem, plan in zip(problems, found, strict=True):
        steps = plan["steps"]
        reached += bool(steps) and plan["distance"] < 0.01
        begins = np.array([step["from"] for step in steps]).reshape(-1, 3)
        chain = torch.tensor(plan["chain"], dtype=torch.float64).reshape(-1, 2)
        assert (problem.spare_m(begins, *chain.T) > -1e-4).all()
    assert reached > 15, reached
