"""Does it roll? Read from the depth image alone, learned from what the robot has recorded.

A small network on the image's circular harmonics. They turn exactly, so each training image serves
in any number of directions without being interpolated.
"""

from __future__ import annotations

import math

import numpy as np
import torch
import xarray as xr
from jaxtyping import Float
from torch import Tensor, nn

from affordlib.models.film import CircularHarmonics, dense


class Rollability(nn.Module):
    """P(rolls) of the object in an image (B, 2, 48, 48); see `learn_rollability`."""

    def __init__(self, image_mean: Tensor, image_std: Tensor, width: int = 32) -> None:
        super().__init__()
        self.harmonics = CircularHarmonics(orders=4)
        self.register_buffer("image_mean", image_mean)
        self.register_buffer("image_std", image_std)
        self.head = nn.Sequential(*dense(self.harmonics.n_features, width, width, 1))

    def look(self, image: Float[Tensor, "b 2 48 48"]) -> Float[Tensor, "b f"]:
        """The circular harmonics (B, F) of standardised depth and mask."""
        mean, std = (v[:, None, None] for v in (self.image_mean, self.image_std))
        return self.harmonics((image - mean) / std)

    def forward(self, image: Float[Tensor, "b 2 48 48"]) -> Float[Tensor, " b"]:
        """P(rolls) (B,)."""
        return torch.sigmoid(self.head(self.look(image)).squeeze(1))


def learn_rollability(
    data: xr.Dataset, interactions: np.ndarray, steps: int = 400, seed: int = 0
) -> Rollability:
    """Learn from the images of interactions and whether their objects rolled, in a few seconds."""
    images = torch.from_numpy(data["image"].values[interactions])
    rolls = torch.from_numpy(data["rollable"].values[interactions].astype(np.float32))
    if not 0 < rolls.mean() < 1:
        raise ValueError("interactions must be of objects that roll and of such that do not")
    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    std = images.std(dim=(0, 2, 3)).clamp_min(1e-6)
    model = Rollability(images.mean(dim=(0, 2, 3)), std)
    seen = model.look(images)
    optimiser = torch.optim.AdamW(model.parameters(), 3e-3, weight_decay=0.1)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(steps):
        rows = torch.randint(len(seen), (128,), generator=generator)
        angle = math.tau * torch.rand(len(rows), generator=generator)
        turned = model.harmonics.turned(seen[rows], torch.stack([angle.cos(), angle.sin()], dim=1))
        logit = model.head(turned).squeeze(1)
        loss = nn.functional.binary_cross_entropy_with_logits(logit, rolls[rows])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return model.eval()
