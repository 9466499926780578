"""The T of the field (Push-T, `gym-pusht`), solved from a log of random pushes.

    python -m experiments.push_t [--only row=gp_200 block=0,1] [--stored]

needs `requirements-pusht.txt`. `--stored` writes what page 10 shows: 200 pushes, one run, its film.
The environment is used as published: targets of its agent, a disc, in [0, 512]², ten a second, 300
of them at most. One pixel counts as one millimetre.

Protocol. 300 initial states: those of `reset(seed)` for 300 seeds from `FIRST_START`, of which none
is solved. They are made in 15 blocks of 20; block b uses the training pushes of draw b mod 5. A
state is solved (a) when the environment says so (coverage above 95 %), (b) when the T is within
10 px and 10° of its goal, and has been at rest there for three steps. What was chosen (price,
rounds, lengths, features of the Gaussian process) was chosen on the seeds from `FIRST_CHOICE`.
"""

import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
from PIL import Image, ImageDraw
from scipy.optimize import least_squares
from scipy.special import expit

from affordlib.geometry import rotated, unit_vector, wrap_angle
from affordlib.logs import Log, LoggedPushes, PushedObject, PushPlanner, fit
from affordlib.logs.cross_validate import forecast_errors
from affordlib.logs.log import _nearest, centred
from affordlib.logs.neural_process import PRETRAINED
from affordlib.logs.planning import primitive_of
from affordlib.results import repo_root, write_atomically
from affordlib.show import GOAL as GOAL_COLOUR
from affordlib.show import NEUTRAL
from affordlib.types import Goal, UnreachableError
from experiments import runner
from experiments.commands import command
from experiments.runner import FOLDER, Job, Rows, frame, read, shares

TABLE, STORED = "push_t", repo_root() / "data" / "push_t"
T_PX = ((-60, 0), (60, 0), (60, 30), (15, 30), (15, 120), (-15, 120), (-15, 30), (-60, 30))
AGENT_PX, GOAL = 15.0, (256.0, 256.0, math.pi / 4)
ROOM_M = ((0.0, 0.0), (0.512, 0.512))
MIDDLE_PX = 140, 372
"""While pushes are collected, the T is put back when its centre leaves this range."""
LENGTHS_M = 0.004, 0.06
MOST_STEPS, LIMITS = 300, (100, 150, 300)
FIRST_START, FIRST_CHOICE, FIRST_DRAW = 100_000, 200_000, 300_000
BLOCKS, OF_BLOCK, DRAWS = 15, 20, 5
PRICE, ROUNDS = 0.3, 2
NEAR_PX, NEAR_RAD, REST_PX = 10.0, math.radians(10), 0.01

log_of_t = partial(Log, "mm", T_PX, tool_radius=AGENT_PX)  # a pixel counts as a millimetre


@lru_cache
def motion() -> tuple[np.ndarray, np.ndarray]:
    """Matrices of the agent's position and velocity after one step: A (2, 2) s + B (2,) target.

    The environment's controller is v ← 0.8 v + (target - x), x ← x + 0.01 v, ten times a step.
    """
    a, b = np.eye(2), np.zeros(2)
    once = np.array([[1 - 0.01, 0.8 * 0.01], [-1.0, 0.8]]), np.array([0.01, 1.0])
    for _ in range(10):
        a, b = once[0] @ a, once[0] @ b + once[1]
    return a, b


def targets_to(point: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Targets (n, 2) that bring the agent from rest at one point to rest at another, in a line.

    Two suffice, if they lie inside the environment's range. Where up to eight do not, the point is
    the target eight times, and the agent comes to within 2 px of it.
    """
    a, b = motion()
    for n in range(2, 9):
        effects = np.column_stack([np.linalg.matrix_power(a, n - 1 - k) @ b for k in range(n)])
        shares = np.linalg.pinv(effects) @ np.array([1.0, 0.0])  # of the way, by each target
        targets = at + shares[:, None] * (point - at)
        if (targets >= 0).all() and (targets <= 512).all():
            return targets
    return np.tile(np.clip(point, 0, 512), (8, 1))


class Table:
    """The environment, and what a robot sees of it: the state, or only its 96 × 96 picture."""

    def __init__(self, view: str = "state", **of_block: Any) -> None:
        import gym_pusht  # noqa: F401 - registers the environment
        import gymnasium

        self.view = view
        seen = "state" if view == "state" else "pixels"
        self.env = gymnasium.make("gym_pusht/PushT-v0", obs_type=seen, **of_block)

    def reset(self, seed: int) -> None:
        """Begin an episode, and wait until the T rests, should the agent begin inside it."""
        self.seen, info = self.env.reset(seed=seed)
        self.steps, self.rests, self.solved, self.done = 0, 0, dict.fromkeys("ab"), False
        self.truth = info["block_pose"]
        self.history = [(info["pos_agent"].tolist(), self.truth.tolist())]
        self.look()
        while self.steps < MOST_STEPS:
            before = self.truth
            self.act(self.agent)
            if np.abs(self.truth - before).max() < REST_PX:
                break

    def look(self) -> tuple[np.ndarray, tuple[float, float, float]]:
        """Return the agent's position (2,) and the pose of the T, in pixels and radians."""
        if self.view == "state":
            self.agent, pose = self.seen[:2], self.seen[2:].tolist()
        else:
            self.agent, pose = read_picture(self.seen)
        return self.agent, (*pose[:2], wrap_angle(pose[2]))

    def act(self, target: np.ndarray) -> None:
        """Make one step of the environment, and note whether it is solved."""
        self.seen, _, done, cut, info = self.env.step(np.clip(target, 0, 512))
        self.steps += 1
        off = info["block_pose"] - GOAL
        near = math.hypot(*off[:2]) < NEAR_PX and abs(wrap_angle(off[2])) < NEAR_RAD
        moved = np.abs(info["block_pose"] - self.truth).max()
        self.rests = self.rests + 1 if near and moved < REST_PX else 0
        self.truth = info["block_pose"]
        self.history.append((info["pos_agent"].tolist(), self.truth.tolist()))
        for rule, met in (("a", done), ("b", self.rests >= 3)):
            if met and self.solved[rule] is None:
                self.solved[rule] = self.steps
        self.done = cut or self.steps >= MOST_STEPS or None not in self.solved.values()

    def go(self, points_px: np.ndarray) -> np.ndarray:
        """Move the agent along points (n, 2), at rest in each; its path (m, 2) to the last one."""
        for point in points_px:
            path = [self.agent]
            for target in targets_to(point, self.agent):
                if self.done or self.solved["a"]:
                    break
                self.act(target)
                path.append(self.seen[:2] if self.view == "state" else point)
            self.agent = path[-1]
        return np.array(path)


def metres(log: Log, seen: tuple) -> tuple[tuple[float, float], tuple[float, float, float]]:
    """Convert what is seen to the tool's position [m] and the pose of the T's centroid."""
    return tuple((1e-3 * seen[0]).tolist()), log.centroid_pose(seen[1])


def collect(n: int, draw: int, view: str = "state", **of_block: Any) -> list[dict[str, Any]]:
    """Return n random pushes as arguments of `Log.add`; the agent goes around the T in between."""
    log, table, found = log_of_t(), Table(view, **of_block), []
    rng, seed = np.random.default_rng(FIRST_DRAW + draw), FIRST_DRAW + 1000 * draw
    of_t = PushedObject(1e-3 * np.array(T_PX), 1e-3 * AGENT_PX, LENGTHS_M)
    unknown = SimpleNamespace(predict=lambda pushes: np.ones((2, len(pushes), 3)))
    planner = PushPlanner(unknown, of_t, room_m=ROOM_M)  # only looks for ways around the T
    table.reset(seed)
    while len(found) < n:
        tool, pose = metres(log, table.look())
        middle = 1e3 * np.array(pose[:2])
        planner.library = of_t.draw(64, rng)
        can = np.flatnonzero(~planner.shut(pose, tool))
        away = (middle < MIDDLE_PX[0]).any() or (middle > MIDDLE_PX[1]).any()
        if away or not len(can) or table.steps > MOST_STEPS - 40 or table.solved["a"]:
            seed += 1
            table.reset(seed)
            continue
        push = primitive_of(planner.library, can[0], pose[2])
        way = 1e3 * planner.way(pose, tool, push)
        table.go(way[:-1])
        before = table.look()
        path = table.go(way[-1:])
        after = table.look()
        push = {"tool_t": np.arange(len(path)), "tool_xy": path, "poses": (before[1], after[1])}
        found += [] if log.add_all([push]) else [push]
    return found


def logged(pushes: Sequence[dict[str, Any]]) -> LoggedPushes:
    """Read pushes of the T through `Log`."""
    log = log_of_t()
    log.add_all(pushes)
    return log.pushes()


def attempt(table: Table, planner: PushPlanner | None, n_pushes: int, seed: int) -> dict[str, Any]:
    """Solve one initial state: plan, push, observe, plan again; what it took. None: do nothing."""
    log, took_s, pushes = log_of_t(), [], 0
    table.reset(seed)
    goal = log.centroid_pose(GOAL)
    rng = np.random.default_rng(seed)
    while planner and not table.done:
        if table.solved["a"]:
            table.act(table.agent)
            continue
        seen = table.look()
        tool, pose = metres(log, seen)
        wanted = Goal(goal[:2], turn_rad=wrap_angle(goal[2] - pose[2]))
        began = time.process_time()
        try:
            if n_pushes:
                push = planner.plan(pose, wanted, n_pushes, tool).steps[0].primitive
            else:  # at random
                can = np.flatnonzero(~planner.shut(pose, tool))
                push = primitive_of(planner.library, int(rng.choice(can)), pose[2])
        except (UnreachableError, ValueError):  # nowhere to go: step aside
            table.go(np.clip(seen[0] + 20 * unit_vector(rng.uniform(0, 2 * math.pi)), 0, 512)[None])
            continue
        took_s.append(time.process_time() - began)
        table.go(1e3 * planner.way(pose, tool, push))
        pushes += 1
    about = {"seed": seed, "pushes": pushes, "plan_s": float(np.mean(took_s or [0.0]))}
    return about | {f"steps_{rule}": steps for rule, steps in table.solved.items()}


PALETTE = {
    "t": ((119, 136, 153), (143, 163, 184)),
    "agent": ((65, 105, 225), (78, 126, 255)),
    "other": ((255, 255, 255), (211, 211, 211), (144, 238, 144)),
}
"""Colours of the environment's picture; edge and face of T and agent."""
EDGE_PX, SWELL_PX = 2.0, 0.5
"""Width of the soft edge of a fitted shape, and by how much a drawn shape is larger, in pixels."""


def read_picture(picture: np.ndarray) -> tuple[np.ndarray, tuple[float, float, float]]:
    """Estimate the agent's position and the pose of the T from a picture (96, 96, 3).

    Each pixel has the name of the nearest colour of the palette. A shape is fitted to the pixels of
    its name by least squares, with a soft edge; the yaw is first searched in steps of 15°.
    """
    names = [name for name, colours in PALETTE.items() for _ in colours]
    palette = np.array([colour for colours in PALETTE.values() for colour in colours])
    off = np.linalg.norm(picture[:, :, None].astype(float) - palette, axis=-1)
    nearest = np.array(names)[off.argmin(axis=-1)]
    grid = (np.arange(96) + 0.5) * 512 / 96 - 0.5
    points = np.stack(np.meshgrid(grid, grid), axis=-1)
    found = {name: points[nearest == name].mean(axis=0) for name in ("t", "agent")}

    def soft(distance: np.ndarray, name: str, at: np.ndarray) -> np.ndarray:
        return expit((SWELL_PX - distance) / EDGE_PX) - (nearest == name)[at]

    close = np.linalg.norm(points - found["agent"], axis=-1) < 2 * AGENT_PX
    agent = least_squares(
        lambda xy: soft(np.linalg.norm(points[close] - xy, axis=-1) - AGENT_PX, "agent", close),
        found["agent"],
    ).x
    near = (np.linalg.norm(points - found["t"], axis=-1) < 110) & (nearest != "agent")
    centre, outline = centred(np.array(T_PX, dtype=float))

    def misfit(pose: np.ndarray) -> np.ndarray:
        return soft(_nearest(outline, rotated(points[near] - pose[:2], -pose[2]))[0], "t", near)

    first = [np.array([*found["t"], yaw]) for yaw in np.radians(np.arange(0, 360, 15))]
    best = min(first, key=lambda pose: (misfit(pose) ** 2).sum())
    x, y, yaw = least_squares(misfit, best, ftol=1e-4).x
    return agent, (*(np.array([x, y]) - rotated(centre, yaw)).tolist(), wrap_angle(float(yaw)))


@dataclass(frozen=True)
class Row:
    """One row of the table: a model, from how many random pushes, and what it plans with."""

    model: str
    n: int
    chain: int = 3
    view: str = "state"
    block_cog: tuple[float, float] | None = None


ROWS = {
    "nothing": Row("constant", 0, 0),
    "random": Row("constant", 8, 0),
    "gp_200": Row("rate_gp", 200),
    "gp_50": Row("rate_gp", 50),
    "gp_2000": Row("rate_gp", 2000),
    "physics_200": Row("physics", 200),
    "nearest_200": Row("nearest", 200),
    "gp_200_one_push": Row("rate_gp", 200, 1),
    "gp_200_picture": Row("rate_gp", 200, view="picture"),
    "np_200": Row("np", 200),
    "gp_200_other_t": Row("rate_gp", 200, block_cog=(0.0, 80.0)),
    "physics_50": Row("physics", 50),
    "nearest_2000": Row("nearest", 2000),
}


@lru_cache(maxsize=3 * DRAWS)
def pushes_of_draw(n: int, draw: int, view: str, block_cog: tuple | None) -> LoggedPushes:
    """Return the first n random pushes of a draw."""
    return logged(collect(n, draw, view, block_cog=block_cog))


@lru_cache(maxsize=DRAWS)
def planner_of(row: Row, draw: int) -> PushPlanner:
    """Fit a row's model to a draw of pushes, and return its planner."""
    data = pushes_of_draw(row.n, draw, row.view, row.block_cog)
    obj = replace(PushedObject.of(data), lengths_m=LENGTHS_M)
    return PushPlanner(fit(data, row.model), obj, price=PRICE, rounds=ROUNDS, room_m=ROOM_M)


def solve(row: str, block: int) -> dict[str, Any]:
    """Solve the initial states of a block."""
    about, first = ROWS[row], FIRST_START + block * OF_BLOCK
    table = Table(about.view, block_cog=about.block_cog)
    planner = planner_of(about, block % DRAWS) if about.n else None
    runs = [attempt(table, planner, about.chain, first + k) for k in range(OF_BLOCK)]
    return {"runs": runs}


def errors(row: str, draw: int) -> dict[str, Any]:
    """Return the errors of a row's model at 400 new pushes of the next draw, and its time."""
    about = ROWS[row]
    pushes = pushes_of_draw(about.n, draw, about.view, about.block_cog)
    began = time.process_time()
    model = fit(pushes, about.model)
    spent = {"fit_s": time.process_time() - began}
    new = pushes_of_draw(400, DRAWS + draw, about.view, about.block_cog)
    found = forecast_errors(model, new)
    columns = ("position_m", "yaw_rad", "inside_50", "inside_90")
    return {"errors": {name: found[name].tolist() for name in columns}, "spent": spent}


def job(row: str, block: int | None = None, draw: int | None = None) -> Job:
    """Return the job of a block of initial states, or of the errors for a draw of pushes."""
    settings = ROWS[row], PRICE, ROUNDS, LENGTHS_M, FIRST_START, OF_BLOCK
    made = {"checkpoints": (PRETRAINED,), "version": 2} if ROWS[row].model == "np" else {}
    part = {"block": block} if draw is None else {"draw": draw}
    function = solve if draw is None else errors
    return Job(function, {"row": row} | part, settings, **made)


def tables(folder: str = FOLDER) -> dict[str, Rows]:
    """Return the shares of solved states by row, rule and limit, and the models' errors."""
    results = sorted(read(TABLE, job, folder), key=lambda r: list(ROWS).index(r[0]["row"]))
    solved, predicted = [], []
    for row, part in frame(results, "runs").groupby("row", sort=False):
        for rule in "ab":
            steps = part[f"steps_{rule}"].astype(float).fillna(math.inf)
            draws = part["block"].mod(DRAWS).nunique()
            about = {"row": row, "rule": rule, "n": len(part), "draws": draws}
            for limit in LIMITS:
                names = (f"{name}_{limit}_percent" for name in ("share", "low", "high"))
                about |= zip(names, shares(int((steps <= limit).sum()), len(part)), strict=True)
            about["steps_median"] = steps.median() if steps.median() < math.inf else None
            about["pushes_mean"] = part["pushes"].mean()
            solved.append(about | {"plan_mean_s": part["plan_s"].mean()})
    for row, part in frame(results, "errors").groupby("row", sort=False):
        about = {"row": row, "n": len(part), "draws": part["draw"].nunique()}
        for name, at in (("median", 0.5), ("p95", 0.95)):
            about[f"position_{name}_m"] = part["position_m"].quantile(at)
        about["yaw_median_rad"] = part["yaw_rad"].median()
        about |= {f"coverage_{p}": part[f"inside_{p}"].mean() for p in (50, 90)}
        spent = [r["spent"]["fit_s"] for of, r in results if of["row"] == row and "spent" in r]
        predicted.append(about | {"fit_mean_s": np.mean(spent)})
    return {"solved": solved, "errors": predicted}


def film(history: Sequence[Any], path: Path, size: int = 320) -> None:
    """Write a run as an animation, ten frames a second as in the environment."""
    frames, scale = [], 2 * size / 512
    for agent, pose in [*history, *history[-1:] * 8]:
        frame = Image.new("RGB", (2 * size, 2 * size), "white")
        draw = ImageDraw.Draw(frame)
        for at, colour in ((GOAL, GOAL_COLOUR), (pose, NEUTRAL)):
            corners = scale * (rotated(np.array(T_PX, dtype=float), at[2]) + np.array(at[:2]))
            fill = colour if at is pose else None
            draw.polygon([*map(tuple, corners)], fill=fill, outline=colour, width=6)
        (x, y), radius = scale * np.array(agent), scale * AGENT_PX
        draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill="black")
        frames.append(frame.resize((size, size)).quantize(16))
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=100, loop=0)


def store(n: int = 200) -> None:
    """Write the pushes and the run of page 10, and the run's film."""
    pushes, rows = collect(n, 0), []
    for number, push in enumerate(pushes):
        poses = np.full((len(push["tool_t"]), 3), np.nan)
        poses[[0, -1]] = push["poses"]
        each = np.column_stack([push["tool_t"] / 10, push["tool_xy"], poses])
        table = pd.DataFrame(each, columns=["t", "tool_x", "tool_y", "x", "y", "yaw"])
        rows.append(table.assign(push=number))
    STORED.mkdir(exist_ok=True)
    pd.concat(rows).round(4).to_csv(STORED / "pushes.csv.xz", index=False)
    table = Table()
    attempt(table, planner_of(ROWS["gp_200"], 0), 3, FIRST_CHOICE + 7)
    history = [[[round(v, 2) for v in a], [round(v, 4) for v in p]] for a, p in table.history]
    write_atomically(STORED / "run.json", json.dumps({"steps": history, "solved": table.solved}))
    film(history, repo_root() / "figures" / "push_t.gif")


@command(OSError, ValueError, ModuleNotFoundError)
def main(argv: Sequence[str] | None = None) -> int:
    """Run missing jobs and make the tables."""
    parser = runner.parser(TABLE, __doc__.splitlines()[0])
    parser.add_argument("--stored", action="store_true", help="write what page 10 shows")
    options = parser.parse_args(argv)
    if options.stored:
        store()
        return 0
    jobs = [job(row, block=block) for row in ROWS for block in range(BLOCKS)]
    jobs += [job(row, draw=draw) for row in ROWS if ROWS[row].chain == 3 for draw in range(DRAWS)]
    return runner.make(jobs, TABLE, options, tables)


if __name__ == "__main__":
    raise SystemExit(main())
