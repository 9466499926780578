"""Solutions to the exercises of notebook 06."""

import math

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


VERDICTS = [check("06.1", chain_end), check("06.2", choose)]

if __name__ == "__main__":
    print(*VERDICTS, sep="\n")
