"""Our networks: image features modulate residual blocks by feature-wise linear modulation (FiLM).

    r      = w₁ mean h_a(a_i) + w₂ mean h_e(e_i)             as in the paper, equations (2) and (3)
    x_0    = W {r, f(γ_o), φ(t_target)}
    x_k+1  = x_k + W₂ ς(γ_k ∘ W₁ n(x_k) + β_k),  (γ_k - 1, β_k) = V_k f(γ_o)
    g(x_K) = (μ_a, σ_a, μ_e, σ_e)

f: a small network on the image's circular harmonics, which rotate exactly into the push frame; ς:
SiLU; n: layer normalisation; φ: t with its first sines and cosines. Source: Perez et al., FiLM:
visual reasoning with a general conditioning layer, AAAI 2018.
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from affordlib import checked
from affordlib.models.base import EffectNetwork, NetworkConfig, dense, he_initialise, network
from affordlib.types import IMAGE_PIXELS, Observations, check_count


class CircularHarmonics(nn.Module):
    """Products of an image with rings around its centre times cos mφ or sin mφ, m = 0 … orders.

    As sums over many pixels, they resolve an outline's size, shape and angle far below a pixel,
    which convolutions do not learn from 400 images. When the image rotates by α, the pair of order
    m rotates by mα: no pixel is interpolated. After Teague, Image analysis via the general theory
    of moments, JOSA 1980, with rings for the radial polynomials, and Freeman and Adelson, The
    design and use of steerable filters, PAMI 1991.
    """

    def __init__(self, rings: int = 7, orders: int = 8, reach: float = 0.8) -> None:
        super().__init__()
        check_count("rings", rings, 1, 100), check_count("orders", orders, 0, 100)
        u = (torch.arange(IMAGE_PIXELS) + 0.5) / (IMAGE_PIXELS / 2) - 1
        x, y = u[None].expand(len(u), -1), -u[:, None].expand(-1, len(u))
        r, phi = torch.hypot(x, y), torch.atan2(y, x)
        centre = torch.linspace(0.1, reach, rings)[:, None, None, None]
        m = torch.arange(orders + 1)[:, None, None]
        ring = torch.exp(-(((r - centre) * rings / reach) ** 2)) * (r < 1)
        cosines, sines = ring * (m * phi).cos(), ring * (m * phi).sin()
        # On a pixel grid cosines do not quite sum to zero; a uniform image would have an angle.
        leak = cosines.sum(dim=(2, 3), keepdim=True) / ring.sum(dim=(2, 3), keepdim=True)
        cosines = cosines - torch.where(m > 0, leak, 0.0) * ring
        # Unit norm (one factor for both of a pair), and a gain that makes the sums about 1.
        gain = 0.3 / cosines.flatten(2).norm(dim=2)[..., None, None]
        templates = torch.stack([gain * cosines, gain * sines]).flatten(0, 2).flatten(1)
        self.register_buffer("templates", templates, persistent=False)
        self.layout = (2, 2, rings, orders + 1)
        self.n_features = math.prod(self.layout)

    def forward(self, image: Float[Tensor, "b 2 n n"]) -> Float[Tensor, "b f"]:
        """Harmonics (B, F), ordered by image channel, cosine or sine, ring and order."""
        return (image.reshape(2 * len(image), -1) @ self.templates.T).reshape(len(image), -1)

    def rotated(
        self, values: Float[Tensor, "#b f"], rotation: Float[Tensor, "b 2"]
    ) -> Float[Tensor, "b f"]:
        """Harmonics of the images rotated by (cos α, sin α), computed from those of the images."""
        cosines, sines = values.reshape(-1, *self.layout).unbind(dim=2)
        step = torch.complex(*rotation.unbind(dim=-1))
        powers = [torch.ones_like(step)]
        for _ in range(self.layout[-1] - 1):
            powers.append(powers[-1] * step)
        rotated = torch.complex(cosines, sines) * torch.stack(powers, dim=-1)[:, None, None]
        return torch.stack([rotated.real, rotated.imag], dim=2).flatten(1)


@checked
@dataclass(frozen=True)
class HarmonicsConfig(NetworkConfig):
    """Sizes of networks that read circular harmonics."""

    image_features: int = 64  # of f(γ_o)
    rings: int = 7
    orders: int = 8  # m = 0 … 8 of the harmonics
    waves: int = 4  # sines and cosines of the phase


class HarmonicsNetwork(EffectNetwork):
    """A network whose image encoder reads the circular harmonics of the image."""

    def make_layers(self, config: HarmonicsConfig) -> None:
        """Create the harmonics, and the image encoder that reads them."""
        self.harmonics, n = CircularHarmonics(config.rings, config.orders), config.image_features
        self.image_encoder = nn.Sequential(*dense(self.harmonics.n_features, 4 * n, 2 * n, n))
        self.image_encoder.apply(he_initialise)

    def basis(self, image: Float[Tensor, "b 2 48 48"]) -> Float[Tensor, "b g"]:
        """Circular harmonics (B, G) of standardised images."""
        return self.harmonics(self._scaled(image))

    def features(
        self, basis: Float[Tensor, "#b g"], rotation: Float[Tensor, "b 2"] | None = None
    ) -> Float[Tensor, "b f"]:
        """Image features f(γ_o) (B, F), of rotated images computed from the harmonics."""
        rotated = basis if rotation is None else self.harmonics.rotated(basis, rotation)
        return self.image_encoder(rotated)


def waves(t: Float[Tensor, "b t"], n: int) -> Float[Tensor, "b t w"]:
    """Append sines and cosines of π k t, k = 1 … n, to t: (B, T, 2n + 1)."""
    angle = t[..., None] * (math.pi * torch.arange(1, n + 1, device=t.device))
    return torch.cat([t[..., None], angle.sin(), angle.cos()], dim=-1)


@checked
@dataclass(frozen=True)
class FiLMConfig(HarmonicsConfig):
    """The default frame is the push frame."""

    frame: str = "push"
    width: int = 128  # of the residual blocks
    blocks: int = 3


class FiLMBlock(nn.Module):
    """Residual block x + W₂ ς(γ ∘ W₁ n(x) + β), with γ and β linear in the condition."""

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


@network("film", FiLMConfig)
class FiLMNetwork(HarmonicsNetwork):
    """FiLM network relating object image, action and effect; satisfies `EffectModel`."""

    def make_layers(self, config: FiLMConfig) -> None:
        """Create the encoders and decoders described above."""
        super().make_layers(config)
        c, w = config, config.width
        n_a, n_e = len(c.action_channels), len(c.effect_channels)
        self.action_encoder = nn.Sequential(*dense(n_a + 1, w, w, w))
        self.effect_encoder = nn.Sequential(*dense(n_e + 1, w, w, w))
        self.merge = nn.Linear(w + c.image_features + 2 * c.waves + 1, w)
        self.blocks = nn.ModuleList(FiLMBlock(w, c.image_features) for _ in range(c.blocks))
        self.head = nn.Sequential(nn.LayerNorm(w), nn.Linear(w, w), nn.SiLU())
        self.last = nn.Linear(w, 2 * (n_a + n_e))

    def outputs(
        self, features: Tensor, observations: Observations, t_target: Tensor
    ) -> tuple[Tensor, ...]:
        """(μ_a, σ_a, μ_e, σ_e), each (B, T, C) and standardised."""
        r = self.represent(observations)
        known = torch.cat([r, features.expand(len(r), -1)], dim=1)
        # Only the phase differs between the targets of a query; the rest is merged once.
        split = known.shape[1]
        base = F.linear(known, self.merge.weight[:, :split], self.merge.bias)
        phase = waves(t_target, self.config.waves)
        x = base[:, None] + F.linear(phase, self.merge.weight[:, split:])
        return self.decode(x, features)

    def decode(self, x: Float[Tensor, "b t w"], features: Tensor) -> tuple[Tensor, ...]:
        """(μ_a, σ_a, μ_e, σ_e) decoded from x_0."""
        for block in self.blocks:
            x = block(x, features)
        widths = [len(channels) for channels in self._channels for _ in range(2)]
        mu_a, raw_a, mu_e, raw_e = self.last(self.head(x)).split(widths, dim=-1)
        sigma_a, sigma_e = (self.sigma_floor + F.softplus(raw) for raw in (raw_a, raw_e))
        return mu_a, sigma_a, mu_e, sigma_e
