"""Solutions to the exercises of notebook 00."""

import numpy as np
import torch

from affordlib.planning import Skills
from affordlib.world import Cuboid, Tabletop
from exercises import check

with Tabletop() as world:
    world.place(Cuboid(length=0.07, width=0.05, height=0.05), yaw_rad=0.3)
    EFFECTS = Skills.load().effects(world.depth_image())


def phase_for_5_cm():
    """A stopped push ends where the full push passes: read the phase off the prediction."""
    phase = torch.linspace(0.5, 1, 101)
    predicted, _ = EFFECTS(torch.full((101,), 0.6), phase)
    return float(np.interp(0.05, predicted[:, :2].norm(dim=1), phase))


def reaches(goal_xy_m):
    """A full push moves this box by some 9 cm in any direction: its goals form a ring.

    Partial pushes fill the ring: they also reach every goal that is nearer.
    """
    every = torch.linspace(0, 2 * torch.pi, 181)
    predicted, _ = EFFECTS(every, torch.ones(181))
    full_m = float(predicted[:, :2].norm(dim=1).mean())
    return abs(np.hypot(*goal_xy_m) - full_m) < 0.02


VERDICTS = [check("00.1", phase_for_5_cm()), check("00.2", reaches)]
print(*VERDICTS, sep="\n")
