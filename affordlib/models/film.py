"""Our improved network: what the image tells modulates residual blocks (FiLM).

    r      = w₁ mean h_a(a_i) + w₂ mean h_e(e_i)             as in the paper, equations (2) and (3)
    x_0    = W {r, f(γ_o), φ(t_target)}
    x_k+1  = x_k + W₂ ς(γ_k ∘ W₁ n(x_k) + β_k),  (γ_k - 1, β_k) = V_k f(γ_o)
    g(x_K) = (μ_a, σ_a, μ_e, σ_e)

f: a small network on the image's circular harmonics, which turn exactly into the frame of the push;
ς: SiLU; n: layer normalisation; φ: t with its first sines and cosines. Source: Perez et al., FiLM:
visual reasoning with a general conditioning layer, AAAI 2018.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from affordlib import checked
from affordlib.interactions.dataset import Scaler
from affordlib.models.network import (
    EffectNetwork,
    NetworkConfig,
    he_initialise,
    mean_code,
    with_time,
)
from affordlib.types import IMAGE_PIXELS, Observations

FEW_HEADINGS = 32
"""From this many turns of one image on, its basis pays."""


@checked
@dataclass(frozen=True)
class FiLMConfig(NetworkConfig):
    """Sizes of the network, by default in the frame of the push.

    width: of the residual blocks; image_features: of f(γ_o); rings, orders: of the harmonics of the
    image; waves: how many sines and cosines of the phase the blocks see.
    """

    frame: str = "push"
    width: int = 128
    blocks: int = 3
    image_features: int = 64
    rings: int = 7
    orders: int = 8
    waves: int = 4


class FiLMBlock(nn.Module):
    """x + W₂ ς(γ ∘ W₁ n(x) + β), γ and β linear in the condition."""

    def __init__(self, width: int, condition: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.first, self.second = nn.Linear(width, width), nn.Linear(width, width)
        self.modulation = nn.Linear(condition, 2 * width)
        nn.init.zeros_(self.second.weight)
        nn.init.zeros_(self.second.bias)

    def forward(
        self, x: Float[Tensor, "b t w"], condition: Float[Tensor, "#b c"]
    ) -> Float[Tensor, "b t w"]:
        gain, shift = self.modulation(condition)[:, None].chunk(2, dim=-1)
        return x + self.second(F.silu((1 + gain) * self.first(self.norm(x)) + shift))


def waves(t: Float[Tensor, "b t"], n: int) -> Float[Tensor, "b t w"]:
    """t with n sines and cosines of π k t: (B, T, 2n + 1)."""
    angle = t[..., None] * (math.pi * torch.arange(1, n + 1, device=t.device))
    return torch.cat([t[..., None], angle.sin(), angle.cos()], dim=-1)


class CircularHarmonics(nn.Module):
    """Products of an image with rings around its centre times cos mφ or sin mφ, m = 0 … orders.

    Sums over many pixels, they tell an outline's size, shape and angle far below a pixel, which
    400 images do not teach convolutions. When the image turns by α, the pair of order m turns by
    mα: no pixel is interpolated. After Teague, Image analysis via the general theory of moments,
    JOSA 1980, with rings for the radial polynomials, and Freeman and Adelson, The design and use of
    steerable filters, PAMI 1991.
    """

    def __init__(self, rings: int = 7, orders: int = 8, reach: float = 0.8) -> None:
        super().__init__()
        u = (torch.arange(IMAGE_PIXELS) + 0.5) / (IMAGE_PIXELS / 2) - 1
        x, y = u[None].expand(len(u), -1), -u[:, None].expand(-1, len(u))
        r, phi = torch.hypot(x, y), torch.atan2(y, x)
        centre = torch.linspace(0.1, reach, rings)[:, None, None, None]
        m = torch.arange(orders + 1)[:, None, None]
        ring = torch.exp(-(((r - centre) * rings / reach) ** 2)) * (r < 1)
        cosines, sines = ring * (m * phi).cos(), ring * (m * phi).sin()
        # On a grid of pixels they do not quite sum to zero; a bare table would seem to have angles.
        leak = cosines.sum(dim=(2, 3), keepdim=True) / ring.sum(dim=(2, 3), keepdim=True)
        cosines = cosines - torch.where(m > 0, leak, 0.0) * ring
        # Unit length (both of a pair by the same), and a gain that brings the sums near unit size.
        gain = 0.3 / cosines.flatten(2).norm(dim=2)[..., None, None]
        templates = torch.stack([gain * cosines, gain * sines]).flatten(0, 2).flatten(1)
        self.register_buffer("templates", templates, persistent=False)
        self.layout = (2, 2, rings, orders + 1)
        self.n_features = math.prod(self.layout)

    def forward(self, image: Float[Tensor, "b 2 n n"]) -> Float[Tensor, "b f"]:
        """(B, F), by image channel, cosine or sine, ring and order."""
        return (image.reshape(2 * len(image), -1) @ self.templates.T).reshape(len(image), -1)

    def turned(
        self, values: Float[Tensor, "#b f"], heading: Float[Tensor, "b 2"]
    ) -> Float[Tensor, "b f"]:
        """The harmonics of the images turned by headings (cos α, sin α)."""
        cosines, sines = values.reshape(-1, *self.layout).unbind(dim=2)
        step = torch.complex(*heading.unbind(dim=-1))
        powers = [torch.ones_like(step)]
        for _ in range(self.layout[-1] - 1):
            powers.append(powers[-1] * step)
        turned = torch.complex(cosines, sines) * torch.stack(powers, dim=-1)[:, None, None]
        return torch.stack([turned.real, turned.imag], dim=2).flatten(1)

    def basis(self, values: Float[Tensor, "1 f"]) -> Float[Tensor, "w f"]:
        """Harmonics (2 orders + 2, F) of one image of which any turn by α is a weighted sum.

        The weights are cos mα of all orders m, then sin mα.
        """
        each = torch.eye(self.layout[-1], device=values.device)[:, None, None, None]
        cosines, sines = values.reshape(self.layout).unbind(dim=1)
        parts = torch.stack([cosines, sines], dim=1), torch.stack([-sines, cosines], dim=1)
        return torch.cat([(part * each).flatten(1) for part in parts])


class FiLMNetwork(EffectNetwork):
    """Relates object image, action and effect; satisfies `EffectModel`."""

    def __init__(self, config: FiLMConfig, scaler: Scaler) -> None:
        super().__init__(config, scaler)
        c, w = config, config.width
        n_a, n_e = len(c.action_channels), len(c.effect_channels)
        self.harmonics = CircularHarmonics(c.rings, c.orders)
        n = c.image_features
        self.image_encoder = nn.Sequential(*dense(self.harmonics.n_features, 4 * n, 2 * n, n))
        self.image_encoder.apply(he_initialise)
        self.action_encoder = nn.Sequential(*dense(n_a + 1, w, w, w))
        self.effect_encoder = nn.Sequential(*dense(n_e + 1, w, w, w))
        self.merge = nn.Linear(w + c.image_features + 2 * c.waves + 1, w)
        self.blocks = nn.ModuleList(FiLMBlock(w, c.image_features) for _ in range(c.blocks))
        self.head = nn.Sequential(nn.LayerNorm(w), nn.Linear(w, w), nn.SiLU())
        self.last = nn.Linear(w, 2 * (n_a + n_e))

    def features(self, scaled_image: Float[Tensor, "b 2 48 48"]) -> Float[Tensor, "b f"]:
        """f(γ_o): (B, F) of standardised depth and mask."""
        return self.image_encoder(self.harmonics(scaled_image))

    def look(self, image: Float[Tensor, "b 2 48 48"]) -> Float[Tensor, "b f"]:
        """The circular harmonics (B, F) of images."""
        return self.harmonics(self._scaled(image))

    def turned_features(
        self, seen: Float[Tensor, "#b f"], heading: Float[Tensor, "b 2"]
    ) -> Float[Tensor, "b f"]:
        """f(γ_o) of turned images, given the harmonics of the images as they lie.

        Of one image turned in many ways the first layer, linear, is computed of its basis alone.
        """
        if len(seen) > 1 or len(heading) < FEW_HEADINGS:
            return self.image_encoder(self.harmonics.turned(seen, heading))
        first, *rest = self.image_encoder
        angle = torch.atan2(heading[:, 1], heading[:, 0])[:, None]
        angle = angle * torch.arange(self.config.orders + 1, device=angle.device)
        weights = torch.cat([angle.cos(), angle.sin()], dim=1)
        x = weights @ F.linear(self.harmonics.basis(seen), first.weight) + first.bias
        for layer in rest:
            x = layer(x)
        return x

    def represent(self, observations: Observations) -> Float[Tensor, "b w"]:
        """r: (B, W), equations (2) and (3), the means taken over what is observed."""
        o = observations
        actions = with_time(o.action / self.action_scale, o.action_t)
        effects = with_time(o.effect / self.effect_scale, o.effect_t)
        r_a = mean_code(self.action_encoder, actions, o.action_mask)
        r_e = mean_code(self.effect_encoder, effects, o.effect_mask)
        w_1 = o.weight[:, None]
        return w_1 * r_a + (1 - w_1) * r_e

    def outputs(
        self, features: Tensor, observations: Observations, t_target: Tensor
    ) -> tuple[Tensor, ...]:
        """(μ_a, σ_a, μ_e, σ_e), each (B, T, C) and standardised."""
        r = self.represent(observations)
        known = torch.cat([r, features.expand(len(r), -1)], dim=1)
        # Only the phase differs between the targets of a query, so the rest is merged once.
        split = known.shape[1]
        base = F.linear(known, self.merge.weight[:, :split], self.merge.bias)
        phase = waves(t_target, self.config.waves)
        x = base[:, None] + F.linear(phase, self.merge.weight[:, split:])
        for block in self.blocks:
            x = block(x, features)
        return split_outputs(self.last(self.head(x)), self.config, self.sigma_floor)


def split_outputs(
    y: Float[Tensor, "b t _"], config: NetworkConfig, sigma_floor: float
) -> tuple[Tensor, ...]:
    """(μ_a, σ_a, μ_e, σ_e) of a last layer's values (B, T, 2 C_a + 2 C_e)."""
    n_a, n_e = len(config.action_channels), len(config.effect_channels)
    mu_a, raw_a, mu_e, raw_e = y.split([n_a, n_a, n_e, n_e], dim=-1)
    return mu_a, sigma_floor + F.softplus(raw_a), mu_e, sigma_floor + F.softplus(raw_e)


def dense(*widths: int) -> list[nn.Module]:
    """Linear layers of the given widths, SiLU between them."""
    layers: list[nn.Module] = []
    for n_in, n_out in pairwise(widths):
        layers += [nn.Linear(n_in, n_out), nn.SiLU()]
    return layers[:-1]
