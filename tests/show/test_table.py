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
from affordlib.geometry import rotated
from affordlib.planning import plan_continuous
from affordlib.planning.rollout import roll_out
from affordlib.show.table_data import object_data, table_data
from affordlib.types import Goal
from affordlib.world import Cuboid, LyingCylinder, Prism

OBJECTS = {
    "box": Cuboid(0.07, 0.05, 0.05),
    "roller": LyingCylinder(0.07, 0.05),
    "wedge": Prism(((-0.05, -0.02), (0.05, -0.02), (0.05, 0.0), (-0.05, 0.03)), 0.04),
}
ASK = """
import fs from "node:fs";
import { EffectMap, plan, reachability } from "./table.mjs";
const { reach, object, asked } = JSON.parse(fs.readFileSync("asked.json"));
object.map = new EffectMap(object.map);
const reachable = reach && reachability(reach, object.map.primitive);
console.log(JSON.stringify(asked.map((one) => plan({ object, reachable, ...one }))));
"""


@pytest.fixture(scope="module")
def ask(tmp_path_factory):
    """Function of an object's data and problems that returns the browser's plans."""
    folder, driver = tmp_path_factory.mktemp("node"), Path(playwright.__file__).parent / "driver"
    node = next((str(path) for path in driver.glob("node*")), shutil.which("node"))
    shutil.copy(Path(show.__file__).with_name("table.js"), folder / "table.mjs")
    (folder / "ask.mjs").write_text(ASK)

    def plans(data, asked, reach=None):
        question = {"object": data, "asked": asked, "reach": reach}
        (folder / "asked.json").write_text(json.dumps(question))
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
    asked = [{"pose": [0.01, -0.02, 0.7], "goal": goal} for goal in goals(80, 0)]
    found = ask(data, asked, table_data(skills)["reach"])
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
        found = ask(
            data, [{"pose": [0, 0, 0], "goal": g} for g in wanted], table_data(skills)["reach"]
        )
        for goal, plan in zip(wanted, found, strict=True):
            best = plan_continuous(skills.problem(image, (0.0, 0.0), Goal(tuple(goal))))
            if best.predicted_distance_m < 5e-4:
                assert plan["distance"] < 1e-3, goal


def test_fewer_and_full_pushes_are_fewer_and_full(ask, seen):
    _, _, data = seen["box"]
    for most in (1, 2):
        asked = [{"pose": [0, 0, 0], "goal": g, "most": most} for g in goals(10, 2)]
        assert all(len(plan["steps"]) <= most for plan in ask(data, asked))
    asked = [{"pose": [0, 0, 0], "goal": g, "partial": False} for g in goals(10, 3)]
    assert {step["stop"] for plan in ask(data, asked) for step in plan["steps"]} == {1}


def test_no_plan_meets_an_obstacle(ask, seen):
    """Checked by points around the object's outline, all along its predicted path."""
    _, _, data = seen["box"]
    rng, asked = np.random.default_rng(4), []
    for goal in goals(30, 5, 0.2):
        xy = [at for at in rng.uniform(-0.2, 0.2, (4, 2)).tolist() if np.hypot(*at) > 0.1]
        square = [[u, v] for u, v in ((-0.02, -0.02), (0.02, -0.02), (0.02, 0.02), (-0.02, 0.02))]
        placed = [[(np.add(corner, at)).tolist() for corner in square] for at in xy[2:]]
        obstacles = {"discs": [[*at, 0.02, 0.1] for at in xy[:2]]}
        obstacles["polygons"] = [[corners, 0.1] for corners in placed]
        asked.append({"pose": [0, 0, 0], "goal": goal, "obstacles": obstacles})
    outline = np.array(data["outline"])
    rim = np.linspace(outline, np.roll(outline, -1, axis=0), 12).reshape(-1, 2)
    found, moved = ask(data, asked), 0
    for one, plan in zip(asked, found, strict=True):
        moved += bool(plan["steps"])
        for x, y, yaw in (pose for step in plan["steps"] for pose in step["path"]):
            points = np.array((x, y)) + rotated(rim, yaw)
            for u, v, radius, _ in one["obstacles"]["discs"]:
                assert np.hypot(*(points - (u, v)).T).min() > radius + 0.008
            for corners, _ in one["obstacles"]["polygons"]:
                middle = np.mean(corners, axis=0)
                assert np.abs(points - middle).max(axis=1).min() > 0.02 + 0.005
    assert moved > 15
    assert found != ask(data, [one | {"obstacles": {}} for one in asked])
