"""Reachability: where the arm can act, learned from its attempts (Section 3.4 of the paper)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Self

import numpy as np
import torch
from torch import nn

from affordlib.primitives import primitive_named
from affordlib.results import repo_root
from affordlib.types import check_array
from affordlib.weights import restored, write_weights

REACHABILITY = "data/checkpoints/reachability.safetensors"


class Reachability(nn.Module):
    """Predicts the probability that the arm can execute one of some primitives at a position.

    The small network is trained on recorded interactions alone, without the arm's kinematics.
    """

    def __init__(self, primitives: Sequence[str]) -> None:
        super().__init__()
        self.primitives = tuple(primitive_named(name).name for name in primitives)
        first, second = nn.Linear(4 + len(self.primitives), 64), nn.Linear(64, 64)
        self.layers = nn.Sequential(first, nn.Tanh(), second, nn.Tanh(), nn.Linear(64, 1))

    @classmethod
    def load(cls, path: str | Path | None = None) -> Self:
        """Load a network, trained on the set `reach`; ValueError where the file is damaged."""
        path = Path(path or repo_root() / REACHABILITY)
        remedy = "learn it again with python -m experiments.shipped reachability"
        return restored(path, remedy, lambda described: cls(described["primitives"]))[0]

    def save(self, path: str | Path) -> Path:
        """Write the weights to a file, which `load` reads, atomically; returns its path."""
        about = {"format": "affordlib reachability 1", "primitives": [*self.primitives]}
        return write_weights(path, self.state_dict(), about)

    @torch.no_grad()
    def probability(
        self, primitive: str, xy_m: np.ndarray, direction_rad: np.ndarray | float | None = None
    ) -> np.ndarray:
        """Probability (n,) that `primitive` can be executed on objects at xy_m: (n, 2).

        It is 1 for a primitive that was not learned, where only the kinematics decides.
        direction_rad: (n,) or one number, the direction of a push or drag; None for the others.
        """
        primitive_named(primitive)
        if np.size(xy_m) == 0:
            return np.ones(0)
        xy_m = np.atleast_2d(check_array("xy_m", xy_m, 2))
        if primitive not in self.primitives:
            return np.ones(len(xy_m))
        turn = np.full(len(xy_m), np.nan)
        if direction_rad is not None:
            shape = (len(xy_m),) if np.ndim(direction_rad) else ()
            turn[:] = check_array("direction_rad", direction_rad, *shape)
        number = np.full(len(xy_m), self.primitives.index(primitive))
        features = reach_features(np.eye(len(self.primitives))[number], xy_m, turn)
        return torch.sigmoid(self.layers(features)).squeeze(-1).numpy()


def reach_features(kind: np.ndarray, xy_m: np.ndarray, direction_rad: np.ndarray) -> torch.Tensor:
    """Network inputs (n, 4 + primitives): position, direction (zero if none), one-hot primitive."""
    ahead = np.column_stack([np.cos(direction_rad), np.sin(direction_rad)])
    ahead[np.isnan(direction_rad)] = 0.0
    return torch.from_numpy(np.hstack([2 * xy_m, ahead, kind])).float()
