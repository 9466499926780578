"""The recurrent network of Seker, Tekden and Ugur (2019) for lever-ups (Table 1).

Four 3×3 convolutions (32, 64, 128, 256), each with ReLU and 2×2 max-pooling, precede a dense layer
of 4096 with dropout 0.5. These features are concatenated with each pose of a window of 15 poses; an
LSTM(256) and a dense layer output the next pose at each step. It has 72 million parameters and is
trained with mean squared error, Adam at 5e-4, batches of 32, 100 epochs of one random window per
trajectory, and a learning rate that is multiplied by 0.8 when the validation loss stagnates.

Added here for the same inputs as the other models: phase and commanded action at each step, and
poses scaled to unit RMS. Predictions are fed back as the next inputs (autoregressive rollout).
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from affordlib import checked
from affordlib.interactions.dataset import InteractionTensors
from affordlib.models.base import EffectNetwork, NetworkConfig, with_time
from affordlib.models.checkpoint import load_state, save_state
from affordlib.models.lever_up import N_OBSERVED, from_start_errors_m, window_errors_m
from affordlib.types import LEVER_IMAGE_PIXELS, Observations
from experiments.lstm import Known, on_grid

CONVOLUTION_WIDTHS = (32, 64, 128, 256)
DENSE, HIDDEN = 4096, 256
BATCH, LEARNING_RATE, DECAY, EPOCHS = 32, 5e-4, 0.8, 100
TRAINING = (CONVOLUTION_WIDTHS, DENSE, HIDDEN, BATCH, LEARNING_RATE, DECAY)
SAVE_EVERY = 10
NEGLIGIBLE = 1e-30
"""Adam's averaged gradients below this are set to zero. Those of inactive units are halved every
seven steps until they are subnormal numbers, with which processors are many times slower."""
State = tuple[Tensor, Tensor]


@checked
@dataclass(frozen=True)
class SekerConfig(NetworkConfig):
    """Channels, number of steps of the phase, and patience of the learning rate's schedule."""

    steps: int = 25
    patience: int = 5


class SekerLSTM(EffectNetwork):
    """CNN and LSTM, applied step by step; σ is not predicted and equals the floor."""

    def make_layers(self, config: SekerConfig) -> None:
        """Make the convolutions, the recurrent cell and the output layer for the next pose."""
        n_a, n_e = len(config.action_channels), len(config.effect_channels)
        layers: list[nn.Module] = []
        for n_in, n_out in pairwise((2, *CONVOLUTION_WIDTHS)):
            # Pooling before ReLU gives the same result with a quarter of the operations.
            layers += [nn.Conv2d(n_in, n_out, 3, padding="same"), nn.MaxPool2d(2), nn.ReLU()]
        side = LEVER_IMAGE_PIXELS // 2 ** len(CONVOLUTION_WIDTHS)
        flat = CONVOLUTION_WIDTHS[-1] * side**2
        self.cnn = nn.Sequential(
            *layers, nn.Flatten(), nn.Linear(flat, DENSE), nn.ReLU(), nn.Dropout(0.5)
        ).to(memory_format=torch.channels_last)
        self.lstm = nn.LSTMCell(DENSE + n_e + 2 * n_a + 1, HIDDEN)
        self.next_pose = nn.Linear(HIDDEN, n_e)

    def features(self, scaled_image: Float[Tensor, "b 2 128 128"]) -> Float[Tensor, "b f"]:
        """Return 4096 features of standardised depth and mask."""
        return self.cnn(scaled_image.contiguous(memory_format=torch.channels_last))

    def outputs(
        self, features: Tensor, observations: Observations, t_target: Tensor
    ) -> tuple[Tensor, ...]:
        """Return (μ_a, σ_a, μ_e, σ_e) at steps of the phase, each (B, T, C) and standardised.

        The action is not predicted, and μ_a is zero.
        """
        o = observations
        known = on_grid(o.effect / self.effect_scale, o.effect_t, o.effect_mask, self.config.steps)
        at = (t_target * self.config.steps).round().long() - known.first[:, None]
        path = self.roll(features.expand(len(o.weight), -1), known, o, int(at.max()))
        index = at.clamp_min(0)[..., None].expand(-1, -1, path.shape[-1])
        mu_e = path.gather(1, index)
        mu_a = mu_e.new_zeros(*t_target.shape, len(self.action_channels))
        return mu_a, mu_a + self.sigma_floor, mu_e, torch.full_like(mu_e, float(self.sigma_floor))

    def roll(self, features: Tensor, known: Known, o: Observations, n: int) -> Tensor:
        """Roll out poses (B, n + 1, C) from the first observed step."""
        action = (o.action / self.action_scale).flatten(1)[:, None]
        k = torch.arange(max(n, 1), device=features.device) + known.first[:, None]
        k = k.clamp_max(self.config.steps)
        rows = torch.arange(len(features), device=features.device)[:, None]
        given, seen = known.d[rows, k], known.where[rows, k]
        n_given = int(seen.all(dim=0).cumprod(dim=0).sum())  # in all rows
        gates = self._share_of_image(features)
        out, state = self._steps(gates, given[:, :n_given], k[:, :n_given], action)
        path = [given[:, :1], self.next_pose(out)]
        for j in range(n_given, n):
            pose = torch.where(seen[:, j, None, None], given[:, [j]], path[-1][:, -1:])
            out, state = self._steps(gates, pose, k[:, [j]], action, state)
            path.append(self.next_pose(out))
        return torch.cat(path, dim=1)

    def _share_of_image(self, features: Tensor) -> Tensor:
        """Return the features' contribution to the gates (B, 4H), which is equal at all steps."""
        cell = self.lstm
        return F.linear(features, cell.weight_ih[:, :DENSE], cell.bias_ih + cell.bias_hh)

    def _steps(
        self, gates: Tensor, pose: Tensor, k: Tensor, action: Tensor, state: State | None = None
    ) -> tuple[Tensor, State]:
        """Return the hidden states (B, K, H) after each of K given poses, and the last state."""
        given = torch.cat([pose, action.expand(-1, pose.shape[1], -1)], dim=-1)
        given = with_time(given, k / self.config.steps)
        given = gates[:, None] + F.linear(given, self.lstm.weight_ih[:, DENSE:])
        h, c = state or (gates.new_zeros(len(gates), HIDDEN),) * 2
        hidden = []
        for of_step in given.unbind(dim=1):
            i, f, g, o = torch.addmm(of_step, h, self.lstm.weight_hh.T).chunk(4, dim=1)
            c = f.sigmoid() * c + i.sigmoid() * g.tanh()
            h = o.sigmoid() * c.tanh()
            hidden.append(h)
        return torch.stack(hidden, dim=1), (h, c)

    def next_step_loss(self, arrays: InteractionTensors, start: Tensor, n: int) -> Tensor:
        """Return the mean squared error of the next pose over n steps from `start` (N,)."""
        rows = torch.arange(len(arrays))[:, None]
        k = start[:, None] + torch.arange(n)
        pose = arrays.effect / self.effect_scale
        ends = arrays.action[:, [0, -1]] / self.action_scale
        features = self.encode(arrays.image, check=False)
        gates, action = self._share_of_image(features), ends.flatten(1)[:, None]
        out, _ = self._steps(gates, pose[rows, k], k, action)
        return F.mse_loss(self.next_pose(out), pose[rows, k + 1])


def train_seker(
    model: SekerLSTM,
    training: InteractionTensors,
    validation: InteractionTensors,
    trained_for: str = "window",
    epochs: int = EPOCHS,
    seed: int = 0,
    checkpoint: Path | None = None,
) -> dict[str, float]:
    """Train in place and keep the weights of the best validation error; return epochs and time.

    An epoch is one window of each trajectory ("first_step": the full trajectory). checkpoint: a
    file (1.2 GB), written every ten epochs, from which an interrupted training resumes.
    """
    optimiser = torch.optim.Adam(model.parameters(), LEARNING_RATE, fused=True)
    plateau = torch.optim.lr_scheduler.ReduceLROnPlateau(
        optimiser, factor=DECAY, patience=model.config.patience
    )
    generator = torch.Generator().manual_seed(seed)
    n = N_OBSERVED if trained_for == "window" else len(training.phase) - 1
    score = window_errors_m if trained_for == "window" else from_start_errors_m
    best, best_state, epoch, seconds = math.inf, model.state_dict(), 0, 0.0
    parts = {"model": model, "optimiser": optimiser, "plateau": plateau}
    if checkpoint is not None and checkpoint.exists():
        state = load_state(checkpoint)
        for name, part in parts.items():
            part.load_state_dict(state[name])
        generator.set_state(state["generator"])
        torch.set_rng_state(state["torch"])
        best, best_state, epoch, seconds = state["progress"]
    while epoch < epochs:
        began = time.process_time()
        model.train()
        for rows in torch.randperm(len(training), generator=generator).split(BATCH):
            latest = len(training.phase) - 1 - n
            start = torch.randint(0, latest + 1, (len(rows),), generator=generator)
            loss = model.next_step_loss(training.select(rows), start, n)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        for of in optimiser.state.values():
            of["exp_avg"] = F.hardshrink(of["exp_avg"], NEGLIGIBLE)
        model.eval()
        error = float(score(model, validation).mean())
        plateau.step(error)
        epoch, seconds = epoch + 1, seconds + time.process_time() - began
        if error < best:
            best, best_state = error, {k: v.clone() for k, v in model.state_dict().items()}
        if checkpoint is not None and (epoch == epochs or epoch % SAVE_EVERY == 0):
            state = {name: part.state_dict() for name, part in parts.items()}
            state |= {"generator": generator.get_state(), "torch": torch.get_rng_state()}
            progress = best, best_state, epoch, seconds
            save_state(checkpoint, state | {"progress": progress, "about": trained_for})
    model.load_state_dict(best_state)
    model.eval()
    return {"epochs": epoch, "seconds": seconds, "validation_error": best}
