"""The planner of the browser: table.js, run by the Node.js that comes with Playwright."""

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import playwright
import pytest
import torch

from affordlib import show
from affordlib.geometry import rotated, unit_vector
from affordlib.planning import plan_continuous
from affordlib.planning.effect_map import roll_out
from affordlib.show.table_data import object_data, obstacle_data, table_data
from affordlib.types import Goal, Obstacle
from affordlib.world import Cuboid, LyingCylinder, Prism

OBJECTS = {
    "box": Cuboid(0.07, 0.05, 0.05),
    "roller": LyingCylinder(0.07, 0.05),
    "wedge": Prism(((-0.05, -0.02), (0.05, -0.02), (0.05, 0.0), (-0.05, 0.03)), 0.04),
}
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
    """Image, effect map and data of each object."""
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
    queries = [{"pose": [0.01, -0.02, 0.7], "goal": goal} for goal in goals(80, 0)]
    found = ask(data, queries, table_data(skills)["reach"])
    assert sum(len(plan["steps"]) > 1 for plan in found) > 20
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
                assert plan["distance"] < 1e-3, goal


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
    near = expected < 0.005  # Python does not distinguish larger gaps
    assert 30 < (expected < 0).sum() < 180
    np.testing.assert_allclose(found[near], expected[near], atol=1e-4)
    assert (found[~near] > 0.004).all()


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
