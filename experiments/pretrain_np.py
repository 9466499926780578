"""Pretrain the neural process on simulated pushes of random objects.

    python -m experiments.pretrain_np    (half an hour on one core)

Objects are convex outlines with three or four corners and random feet and frictions; a push is
`quasi_static_push` with measurement noise on the poses before and after.
"""

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from affordlib.geometry import cross, quarter_turn
from affordlib.logs.log import FEET
from affordlib.logs.neural_process import (
    PRETRAINED,
    NeuralProcess,
    rotation,
    train_neural_process,
    transformed,
)
from affordlib.logs.physics import quasi_static_push
from affordlib.results import repo_root
from affordlib.weights import write_weights
from experiments.commands import command

PUSHES, CHUNK = 48, 64
OBJECTS, STEPS = 12_288, 7000
CHECKPOINT = repo_root() / "data" / "checkpoints" / f"{PRETRAINED}.safetensors"


def between(low: float, high: float, shape: tuple[int, ...], g: torch.Generator) -> Tensor:
    """Sample numbers uniformly from [low, high)."""
    return low + (high - low) * torch.rand(shape, generator=g)


def log_between(low: float, high: float, shape: tuple[int, ...], g: torch.Generator) -> Tensor:
    """Sample numbers from [low, high) with uniform logarithm."""
    return between(math.log(low), math.log(high), shape, g).exp()


def outlines(n: int, g: torch.Generator) -> tuple[Tensor, Tensor]:
    """Sample outlines of centroid 0 and radius of gyration 1: corners (n, 4, 2), counter-clockwise
    (triangles repeat one), and shares (n, 4) of the area at each edge.
    """
    angle = (between(0.15, 0.85, (n, 4), g) + torch.arange(4)) * (math.pi / 2)
    of_three = (between(0.2, 0.8, (n, 3), g) + torch.arange(3)) * (2 * math.pi / 3)
    radius = between(0.6, 1.4, (n, 4), g)
    triangle = (torch.rand(n, generator=g) < 0.6)[:, None]
    angle = torch.where(triangle, of_three[:, [0, 1, 2, 2]], angle)
    radius = torch.where(triangle, radius[:, [0, 1, 2, 2]], radius)
    stretch = torch.stack([torch.ones(n), between(0.5, 1, (n,), g)], -1)
    corners = torch.stack([radius * angle.cos(), radius * angle.sin()], -1) * stretch[:, None]
    isosceles = torch.tensor([[-1.0, -1.0], [2.0, -1.0], [-1.0, 2.0], [-1.0, 2.0]])
    corners = torch.where((torch.rand(n, generator=g) < 0.15)[:, None, None], isosceles, corners)
    following = corners.roll(-1, 1)
    part = cross(corners, following)[..., None]
    corners = corners - ((corners + following) * part).sum(1, True) / (3 * part.sum(1, True))
    following = corners.roll(-1, 1)
    part = cross(corners, following)
    squares = (corners**2 + corners * following + following**2).sum(-1)
    gyration = ((part * squares).sum(1) / (6 * part.sum(1))).sqrt()
    return corners / gyration[:, None, None], part / part.sum(1, keepdim=True)


def points_inside(corners: Tensor, area: Tensor, k: int, g: torch.Generator) -> Tensor:
    """Sample k uniform points (n, k, 2) inside each outline."""
    edge = torch.multinomial(area.clamp_min(1e-9), k, replacement=True, generator=g)[..., None]
    a, b = (c.gather(1, edge.expand(-1, -1, 2)) for c in (corners, corners.roll(-1, 1)))
    out = torch.rand(len(corners), k, 1, generator=g).sqrt()
    along = torch.rand(len(corners), k, 1, generator=g)
    return out * ((1 - along) * a + along * b)


def weights_of_three(feet: Tensor) -> Tensor:
    """Return the shares (n, 3) of a weight at the origin that three feet (n, 3, 2) carry."""
    rows = torch.cat([feet.transpose(1, 2), torch.ones(len(feet), 1, 3)], 1)
    flat = torch.linalg.det(rows).abs() < 1e-2
    rows = torch.where(flat[:, None, None], torch.eye(3), rows)
    shares = torch.linalg.solve(rows, torch.tensor([0.0, 0.0, 1.0]).expand(len(feet), 3))
    return torch.where(flat[:, None], -1.0, shares)


def supports(corners: Tensor, area: Tensor, g: torch.Generator) -> Tensor:
    """Sample feet (n, 12, 3): three that carry the object, twelve of random weight, or a face."""
    n, kind = len(corners), torch.rand(len(corners), generator=g)
    three = points_inside(corners, area, 3, g)
    for _ in range(60):
        bad = weights_of_three(three).min(1).values < 0.08
        three = torch.where(bad[:, None, None], points_inside(corners, area, 3, g), three)
    shares = weights_of_three(three)
    unfit = (shares.min(1).values < 0.08)[:, None]
    three = torch.where(unfit[..., None], corners[:, :3], three)
    shares = torch.where(unfit, 1 / 3, shares)
    weights = torch.where((kind < 0.8)[:, None], torch.rand(n, FEET, generator=g) ** 2, 1.0)
    weights = (weights / weights.sum(1, keepdim=True))[..., None]
    many = points_inside(corners, area, FEET, g)
    many = many - 0.8 * (weights * many).sum(1, True)
    few = torch.zeros(n, FEET, 3)
    few[:, :3] = torch.cat([three, shares[..., None]], -1)
    return torch.where((kind < 0.65)[:, None, None], few, torch.cat([many, weights], -1))


def simulate(n: int, g: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Simulate measured pushes (n, 48, 10), feet (n, 12, 3) and ground truth (n, 48, 3)."""
    shape = (n, PUSHES)
    corners, area = outlines(n, g)
    feet = supports(corners, area, g)
    matrix = rotation(between(0, 2 * math.pi, (n,), g), torch.zeros(n) > 0)
    corners, feet = corners @ matrix, transformed(feet, matrix)
    edges = corners.roll(-1, 1) - corners
    edge = torch.multinomial(edges.norm(dim=-1).clamp_min(1e-6), PUSHES, True, generator=g)
    start, along = (v.gather(1, edge[..., None].expand(-1, -1, 2)) for v in (corners, edges))
    contact = start + between(0.02, 0.98, (*shape, 1), g) * along
    tangent = -along / along.norm(dim=-1, keepdim=True)
    normal = -quarter_turn(tangent)
    incidence = between(-62, 62, (*shape, 1), g).deg2rad()
    direction = incidence.cos() * normal + incidence.sin() * tangent
    travel = log_between(0.12, 0.9, (n, 1), g) * between(0.9, 1.1, shape, g)
    same = torch.rand(n, 1, generator=g) < 0.5
    travel = torch.where(same, 0.276 * between(0.97, 1.03, shape, g), travel)[..., None]
    friction = 1 + 0.08 * torch.randn(shape, generator=g)
    friction = between(0.12, 0.97, (n, 1), g) * friction.clamp(0.7, 1.3)
    smoothing = float(log_between(0.02, 0.16, (1,), g))
    unsteady = torch.randn(*shape, FEET, generator=g) * torch.rand(n, 1, 1, generator=g)
    each = feet[:, None].expand(-1, PUSHES, -1, -1).clone()
    each[..., 2] = each[..., 2] * (0.15 * unsteady).exp()
    each[..., 2] = each[..., 2] / each[..., 2].sum(-1, keepdim=True)
    push = torch.cat([contact, normal, direction, travel], -1)
    inputs = push.flatten(0, 1), each.flatten(0, 1), friction.flatten()
    truth = quasi_static_push(*inputs, smoothing).unflatten(0, shape)
    # Poses before and after have measurement noise; the computed contact stays on the edge.
    scatter = log_between(0.002, 0.012, (n, 1, 1), g)
    before, after = (scatter * torch.randn(*shape, 3, generator=g) for _ in range(2))
    turn = rotation(-before[..., 2].flatten(), torch.zeros(n * PUSHES) > 0).unflatten(0, shape)

    def seen(vectors: Tensor) -> Tensor:
        return (vectors[..., None, :] @ turn)[..., 0, :]

    shift = seen(contact - before[..., :2]) - contact
    contact = contact + (shift * tangent).sum(-1, keepdim=True) * tangent
    inward = (direction * normal).sum(-1, keepdim=True).clamp_min(0.3)
    travel = (travel + (shift * normal).sum(-1, keepdim=True) / inward).clamp_min(0.02)
    moved = seen(truth[..., :2]) + after[..., :2] - before[..., :2]
    turned = truth[..., 2:] + after[..., 2:] - before[..., 2:]
    rows = torch.cat([contact, normal, seen(direction), travel, moved, turned], -1)
    return rows, feet, truth


def save_neural_process(model: NeuralProcess, path: str | Path, about: dict[str, Any]) -> Path:
    """Write a model to a safetensors file; about: plain JSON values on how it was made."""
    description = {"model": "np", "config": {}, "scaler": {}, "domain": {}, "about": about}
    return write_weights(path, model.state_dict(), description)


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Simulate, train, and write the checkpoint."""
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args(argv)
    g = torch.Generator().manual_seed(0)
    chunks = [simulate(CHUNK, g) for _ in range(OBJECTS // CHUNK)]  # each has its own smoothing
    rows, feet, _ = (torch.cat(part) for part in zip(*chunks, strict=True))
    torch.manual_seed(0)
    model = NeuralProcess()

    def report(step: int, loss: float) -> None:
        if step % 500 == 0:
            print(f"{step} {loss:.3f}", flush=True)
            save_neural_process(model, CHECKPOINT, {"objects": OBJECTS, "steps": step})

    g = torch.Generator().manual_seed(0)
    train_neural_process(model, rows, feet, (STEPS, 1.2e-3, 48), g, report)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
