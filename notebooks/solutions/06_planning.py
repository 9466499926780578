"""Solutions to the exercises of notebook 06."""

import math

import numpy as np
import torch

from exercises import check


def chain_end(effects, direction, phase):
    """Every effect is rotated into the direction of its push; every push meets a turned object."""
    x = y = turned = 0.0
    for angle, stop in zip(direction, phase, strict=True):
        ahead, left, turn = effects(angle - turned, stop)[0]
        x = x + ahead * angle.cos() - left * angle.sin()
        y = y + ahead * angle.sin() + left * angle.cos()
        turned = turned + turn
    return float(x), float(y)


def choose(effects, goal_xy_m):
    """Query all directions (by 1°) and phases (by 0.005) and take the nearest end."""
    angle = torch.arange(360, dtype=torch.float64)[:, None] * (math.pi / 180)
    stop = torch.linspace(0.5, 1, 101, dtype=torch.float64)[None, :]
    angle, stop = torch.broadcast_tensors(angle, stop)
    ahead, left, _ = effects(angle, stop)[0].unbind(-1)
    x = ahead * angle.cos() - left * angle.sin()
    y = ahead * angle.sin() + left * angle.cos()
    best = int(torch.hypot(x - goal_xy_m[0], y - goal_xy_m[1]).argmin())
    return float(angle.flatten()[best]), float(stop.flatten()[best])


def gap_m(corners, others):
    """The largest separation along the normals of the edges of either."""
    found = []
    for these, those in ((corners, others), (others, corners)):
        edges = np.roll(these, -1, axis=0) - these
        outward = np.column_stack([edges[:, 1], -edges[:, 0]])
        outward = outward / np.linalg.norm(outward, axis=1, keepdims=True)
        beyond = (those @ outward.T).min(axis=0) - (these * outward).sum(axis=1)
        found.append(beyond.max())
    return max(found)


def last_phase(gap_at, margin_m):
    """What is blocked at one phase is blocked at all later ones."""
    phases = np.linspace(0, 1, 401)
    blocked = np.array([gap_at(phase) < margin_m for phase in phases])
    return float(phases[max(int(blocked.argmax()) - 1, 0)]) if blocked.any() else 1.0


VERDICTS = [
    check("06.1", chain_end),
    check("06.2", choose),
    check("06.3", gap_m),
    check("06.4", last_phase),
]
print(*VERDICTS, sep="\n")
