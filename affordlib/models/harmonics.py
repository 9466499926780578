"""Circular harmonics of an image, which rotate exactly, and the base of networks that use them."""

import math
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

from affordlib import checked
from affordlib.models.base import EffectNetwork, NetworkConfig, he_initialise
from affordlib.types import IMAGE_PIXELS


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

    def spectrum(self, image: Float[Tensor, "b 2 n n"]) -> Float[Tensor, "b s"]:
        """Norms of the pairs of cosine and sine, which are invariant to rotation of the image."""
        return self(image).reshape(-1, *self.layout).norm(dim=2).flatten(1)

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

    def basis(self, values: Float[Tensor, "1 f"]) -> Float[Tensor, "w f"]:
        """Harmonics (2 orders + 2, F) of one image whose weighted sums give every rotation by α.

        The weights are cos mα of all orders m, then sin mα.
        """
        each = torch.eye(self.layout[-1], device=values.device)[:, None, None, None]
        cosines, sines = values.reshape(self.layout).unbind(dim=1)
        parts = torch.stack([cosines, sines], dim=1), torch.stack([-sines, cosines], dim=1)
        return torch.cat([(part * each).flatten(1) for part in parts])


@checked
@dataclass(frozen=True)
class HarmonicsConfig(NetworkConfig):
    """Sizes: features f(γ_o); rings and orders of the harmonics; waves of the phase (`waves`)."""

    image_features: int = 64
    rings: int = 7
    orders: int = 8
    waves: int = 4


class HarmonicsNetwork(EffectNetwork):
    """A network whose image encoder reads the circular harmonics of the image."""

    def make_layers(self, config: HarmonicsConfig) -> None:
        """Create the harmonics, and the image encoder that reads them."""
        self.harmonics, n = CircularHarmonics(config.rings, config.orders), config.image_features
        self.image_encoder = nn.Sequential(*dense(self.harmonics.n_features, 4 * n, 2 * n, n))
        self.image_encoder.apply(he_initialise)

    def features(self, scaled_image: Float[Tensor, "b 2 48 48"]) -> Float[Tensor, "b f"]:
        """Image features f(γ_o) (B, F) of standardised depth and mask."""
        return self.image_encoder(self.harmonics(scaled_image))

    def unoriented_features(self, image: Float[Tensor, "b 2 48 48"]) -> Float[Tensor, "b f"]:
        """Circular harmonics (B, F) of images."""
        return self.harmonics(self._scaled(image))

    def oriented_features(
        self, unoriented: Float[Tensor, "#b f"], rotation: Float[Tensor, "b 2"]
    ) -> Float[Tensor, "b f"]:
        """f(γ_o) of the rotated images, computed from the harmonics of the images."""
        return self.image_encoder(self.harmonics.rotated(unoriented, rotation))


def waves(t: Float[Tensor, "b t"], n: int) -> Float[Tensor, "b t w"]:
    """Append sines and cosines of π k t, k = 1 … n, to t: (B, T, 2n + 1)."""
    angle = t[..., None] * (math.pi * torch.arange(1, n + 1, device=t.device))
    return torch.cat([t[..., None], angle.sin(), angle.cos()], dim=-1)


def dense(*widths: int) -> list[nn.Module]:
    """Linear layers of the given widths, with SiLU between them."""
    layers: list[nn.Module] = []
    for n_in, n_out in pairwise(widths):
        layers += [nn.Linear(n_in, n_out), nn.SiLU()]
    return layers[:-1]
