"""A recurrent network: an autoregressive rollout, each prediction the input of the next step.

    x_k = {d_k, d_k - d_{k-1}, t_k, observed?, f(γ_o), h_a}      d = e - m, m the mean trajectory
    (h_k+1, c_k+1) = LSTM(x_k, h_k, c_k)
    d_k+1 = d_k + (d_k - d_{k-1}) + g(h_k+1)                 observed value if any, else predicted

It predicts the change of the increment in standardised units and is trained through its own
rollouts. Source: Seker, Tekden and Ugur, Deep effect trajectory prediction in robot manipulation,
Robotics and Autonomous Systems, 2019, with fewer parameters, which were tuned.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from affordlib import checked
from affordlib.interactions import Batch, InteractionTensors, condition_on_recorded_action
from affordlib.models.base import masked_mean, network, with_time
from affordlib.models.film import HarmonicsConfig, HarmonicsNetwork, dense, waves
from affordlib.types import Observations
from experiments.last_pose import AroundMean, between

_CERTAIN = -6.0  # raw σ of observed values: its softplus is nearly zero


@checked
@dataclass(frozen=True)
class LSTMConfig(HarmonicsConfig):
    """Sizes of the network."""

    steps: int = 25  # into which it divides the phase
    width: int = 192


def sample_forward(
    tensors: InteractionTensors, n_targets: int, obs_max: int, generator: torch.Generator
) -> Batch:
    """Sample targets for a context of only the action at t = 0 and 1; obs_max is not used."""
    last = len(tensors.phase) - 1
    target_at = torch.randint(0, last + 1, (len(tensors), n_targets), generator=generator)
    target_at[:, 0] = last
    return Batch.of(tensors, condition_on_recorded_action(tensors), target_at)


Known = tuple[Tensor, Tensor, Tensor]
"""Observed effects on a grid of steps: d (B, K, C), their mask (B, K), first step (B,)."""


def on_grid(effect: Tensor, t: Tensor, seen: Tensor, steps: int) -> Known:
    """Put observed effects (B, m, C) at t (B, m) on steps + 1 phases; zero at t = 0 if none."""
    b, n, c = len(effect), steps + 1, effect.shape[-1]
    # Unobserved values go to an extra column, which is then removed.
    at = torch.where(seen, (t * steps).round().long(), n)
    d = effect.new_zeros(b, n + 1, c)
    d = d.scatter(1, at[..., None].expand(-1, -1, c), effect)[:, :n]
    where = torch.zeros(b, n + 1, dtype=torch.bool, device=effect.device)
    where = where.scatter(1, at, torch.ones_like(seen))[:, :n]
    where[:, 0] |= ~where.any(dim=1)
    return d, where, where.to(torch.uint8).argmax(dim=1)


@network("lstm", LSTMConfig)
class LSTMNetwork(AroundMean, HarmonicsNetwork):
    """Predicts a trajectory step by step, linear between steps; satisfies `EffectModel`."""

    def make_layers(self, config: LSTMConfig) -> None:
        """Create the encoders and decoders described above."""
        super().make_layers(config)
        c, w = config, config.width
        n_a, n_e = len(c.action_channels), len(c.effect_channels)
        self.action_encoder = nn.Sequential(*dense(n_a + 1, w, w, c.image_features))
        static = 2 * c.image_features
        self.begin = nn.Linear(static, 2 * w)
        self.cell = nn.LSTMCell(2 * n_e + 2 * c.waves + 2 + static, w)
        self.last = nn.Sequential(nn.LayerNorm(w), *dense(w, w, 2 * n_e))
        nn.init.zeros_(self.last[-1].weight)
        nn.init.zeros_(self.last[-1].bias)
        # The commanded action is given at t = 0 and 1; this predicts it at other phases.
        self.action_decoder = nn.Sequential(*dense(static + 2 * c.waves + 1, w, w, 2 * n_a))

    def outputs(
        self, features: Tensor, observations: Observations, t_target: Tensor
    ) -> tuple[Tensor, ...]:
        """(μ_a, σ_a, μ_e, σ_e), each (B, T, C) and standardised."""
        o, b = observations, len(observations.weight)
        actions = with_time(o.action / self.action_scale, o.action_t)
        code = masked_mean(self.action_encoder(actions), o.action_mask)
        static = torch.cat([features.expand(b, -1), code], dim=1)
        d = o.effect / self.effect_scale - self.mean_trajectory(o.effect_t)
        *_, first = known = on_grid(d, o.effect_t, o.effect_mask, self.config.steps)
        at = (t_target * self.config.steps - first[:, None]).clamp_min(0)
        path, raw = self.roll(known, static, max(1, int(at.detach().max().ceil())))
        mu_e = self.mean_trajectory(t_target) + between(path, at)
        sigma_e = self.sigma_floor + F.softplus(between(raw, at))
        times = waves(t_target, self.config.waves)
        given = torch.cat([static[:, None].expand(-1, times.shape[1], -1), times], dim=-1)
        mu_a, raw_a = self.action_decoder(given).chunk(2, dim=-1)
        return mu_a, self.sigma_floor + F.softplus(raw_a), mu_e, sigma_e

    def roll(self, known: Known, static: Tensor, n: int) -> tuple[Tensor, Tensor]:
        """d and raw σ (B, n + 1, C) over n steps from the first observed one on.

        The static inputs' contribution to the gates is computed once. Observed steps are not
        predicted, independent of the other rows of the batch.
        """
        known_d, where, first = known
        rows, last = torch.arange(len(static), device=static.device), self.config.steps
        h, c = self.begin(static).tanh().chunk(2, dim=-1)
        moving = self.cell.input_size - static.shape[1]
        w_in, w_h = self.cell.weight_ih, self.cell.weight_hh
        fixed = F.linear(static, w_in[:, moving:], self.cell.bias_ih + self.cell.bias_hh)
        weight = torch.cat([w_in[:, :moving], w_h], dim=1).T
        phases = torch.linspace(0, 1, last + 1, device=static.device)[None]
        times = waves(phases, self.config.waves)[0]
        predicted = previous = known_d[rows, first]
        certain = torch.full_like(predicted, _CERTAIN)
        path, sigmas = [predicted], [certain]
        for j in range(n):
            k = (first + j).clamp_max(last)
            observed = where[rows, k][:, None]
            d = torch.where(observed, known_d[rows, k], predicted)
            change = d - previous
            x = torch.cat([d, change, times[k], observed.to(d.dtype), h], dim=1)
            i, f, g, o = torch.addmm(fixed, x, weight).chunk(4, dim=1)
            c = f.sigmoid() * c + i.sigmoid() * g.tanh()
            h = o.sigmoid() * c.tanh()
            after = (k + 1).clamp_max(last)
            seen, to_come = where[rows, after][:, None], known_d[rows, after]
            if bool(seen.all()):
                predicted, raw = to_come, certain
            else:
                bend, raw = self.last(h).chunk(2, dim=-1)
                predicted = torch.where(seen, to_come, d + change + bend)
                raw = torch.where(seen, certain, raw)
            previous = d
            path.append(predicted)
            sigmas.append(raw)
        return torch.stack(path, dim=1), torch.stack(sigmas, dim=1)
