"""Check that refactoring changes no data, predictions or plans.

Write a file at one commit and compare it with another, on the same machine (results are not
bit-identical across processors):

    python -m tests.guard write guard.json
    python -m tests.guard compare guard.json
"""

import argparse
import hashlib
import json
import sys
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import torch

from affordlib import planning
from affordlib.interactions import InteractionTensors, open_interactions
from affordlib.interactions.recipes import RECIPES, interact
from affordlib.models import load_checkpoint
from affordlib.models.lever_up import lever_up_tensors
from affordlib.planning.skills import Reachability
from affordlib.results import repo_root
from affordlib.types import Observations
from affordlib.world import Tabletop
from experiments.tasks import frozen_tasks

N_INTERACTIONS, N_GOALS = 3, 20


def collected() -> dict[str, list[float]]:
    """Effects of a few interactions of every shipped recipe."""
    found = {}
    with Tabletop() as world:
        for name in ("push", "drag", "grasp", "rotate", "lever_up", "push_varied", "partial"):
            for seed in (RECIPES[name].seed, 99):
                recipe = replace(RECIPES[name], seed=seed)
                for index in range(N_INTERACTIONS):
                    done = interact(recipe, index, world)[1]
                    values = [done.action[::30], done.effect[::30], done.rest_effect, done.tool]
                    digest = hashlib.sha256(np.ascontiguousarray(done.image).tobytes()).digest()[:6]
                    flat = [*map(np.ravel, values), [int.from_bytes(digest, "big")]]
                    found[f"collected {name} {seed} {index}"] = np.concatenate(flat).tolist()
    return found


def predicted() -> dict[str, list[float]]:
    """Outputs of every shipped checkpoint, given recorded actions and effects at two times."""
    found, rows = {}, np.arange(4)
    levers = lever_up_tensors(open_interactions("lever_up").isel(interaction=slice(0, 48)))
    for path in sorted((repo_root() / "data" / "checkpoints").glob("*.safetensors")):
        if path.stem in ("reachability", "np_simulated_pushes"):
            continue
        model, data, kind = load_checkpoint(path)[0], levers, path.stem.split("_")[0]
        if kind != "lever":
            kind = kind if kind in ("drag", "grasp", "rotate") else "push"
            channels = model.action_channels, model.effect_channels
            data = InteractionTensors.from_dataset(open_interactions(kind), rows, *channels)
        at = torch.tensor([0, data.phase.shape[-1] - 1])
        t = data.phase[..., at].float().expand(4, 2)
        known = torch.ones(4, 2, dtype=torch.bool)
        action, effect = data.action[:4, at].float(), data.effect[:4, at].float()
        seen = Observations(action, t, known, effect, t, known, torch.full((4,), 0.5))
        with torch.no_grad():
            features = model.encode(data.image[:4].float())
            answer = model.predict(features, seen, torch.linspace(0.5, 1, 5).expand(4, 5))
        values = [getattr(answer, field.name).ravel() for field in fields(answer)]
        found[f"predicted {path.stem}"] = torch.cat(values).tolist()
    xy = np.stack(np.meshgrid(np.linspace(-0.5, 0.7, 5), np.linspace(-0.7, 0.7, 5)), -1)
    for name in ("push", "drag", "grasp", "rotate"):
        turn = 0.3 if name in ("push", "drag") else None
        chance = Reachability.load().probability(name, xy.reshape(-1, 2), turn)
        found[f"predicted reachability {name}"] = chance.tolist()
    return found


def planned() -> dict[str, list[float]]:
    """Plans of all planners for the first frozen goals of each mode."""
    skills, found = planning.Skills.load(), {}
    tasks = [t for t in frozen_tasks() if t.goals == "constructed"]
    some = [[t for t in tasks if t.mode == mode][: N_GOALS // 2] for mode in planning.MODES]
    with Tabletop() as world:
        for k, task in enumerate((some[1] + some[2])[:N_GOALS]):
            world.place(task.obj, (0.0, 0.0), task.yaw_rad, config=task.config)
            seen = world.observe()
            kind = skills.kind_for(seen.image)
            effects = planning.EffectMap(skills.model(kind), seen.image, kind)
            problem = planning.PlanningProblem(seen.xy_m, task.goal, effects, task.mode)
            plans = [planning.plan_astar(problem), planning.plan_continuous(problem)]
            if kind.name == "push":
                plans.append(planning.plan_gradient(problem, 100))
            for plan in plans:
                steps = [(*s.predicted_end_xy_m, s.stop_phase, s.std_m) for s in plan.steps]
                found[f"planned {k} {plan.planner}"] = np.ravel(steps).tolist()
    return found


def compare(before: dict[str, list[float]], now: dict[str, list[float]]) -> list[str]:
    """One sentence for each entry that is missing, new, or not bit-identical."""
    moved = [f"{name}: gone" for name in before if name not in now]
    moved += [f"{name}: new" for name in now if name not in before]
    for name in before.keys() & now.keys():
        old, new = np.array(before[name]), np.array(now[name])
        if old.shape != new.shape:
            moved.append(f"{name}: {old.size} numbers became {new.size}")
        elif not np.array_equal(old, new, equal_nan=True):
            moved.append(f"{name}: moved by up to {np.nanmax(np.abs(old - new)):.2g}")
    return sorted(moved)


def main() -> int:
    """Write the current state, or compare it with a file."""
    parser = argparse.ArgumentParser(prog="python -m tests.guard", description=main.__doc__)
    parser.add_argument("action", choices=("write", "compare"))
    parser.add_argument("file", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    now = collected() | predicted() | planned()
    if options.action == "write":
        options.file.write_text(json.dumps(now))
        return 0
    moved = compare(json.loads(options.file.read_text()), now)
    print("\n".join(moved) or f"all {len(now)} entries are the same to the last bit")
    return bool(moved)


if __name__ == "__main__":
    sys.exit(main())
