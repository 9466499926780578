"""Circular harmonics of an image, which rotate exactly, and what networks that read them share."""

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
        # On a grid of pixels cosines do not quite sum to zero; an empty table would have angles.
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

    def spectrum(self, image: Float[Tensor, "b 2 n n"]) -> Float[Tensor, "b s"]:
        """Lengths of the pairs of cosine and sine, which no rotation of the image changes."""
        return self(image).reshape(-1, *self.layout).norm(dim=2).flatten(1)

    def rotated(
        self, values: Float[Tensor, "#b f"], rotation: Float[Tensor, "b 2"]
    ) -> Float[Tensor, "b f"]:
        """The harmonics of the images rotated by (cos α, sin α)."""
        cosines, sines = values.reshape(-1, *self.layout).unbind(dim=2)
        step = torch.complex(*rotation.unbind(dim=-1))
        powers = [torch.ones_like(step)]
        for _ in range(self.layout[-1] - 1):
            powers.append(powers[-1] * step)
        rotated = torch.complex(cosines, sines) * torch.stack(powers, dim=-1)[:, None, None]
        return torch.stack([rotated.real, rotated.imag], dim=2).flatten(1)

    def basis(self, values: Float[Tensor, "1 f"]) -> Float[Tensor, "w f"]:
        """Harmonics (2 orders + 2, F) of one image of which any rotation by α is a weighted sum.

        The weights are cos mα of all orders m, then sin mα.
        """
        each = torch.eye(self.layout[-1], device=values.device)[:, None, None, None]
        cosines, sines = values.reshape(self.layout).unbind(dim=1)
        parts = torch.stack([cosines, sines], dim=1), torch.stack([-sines, cosines], dim=1)
        return torch.cat([(part * each).flatten(1) for part in parts])


@checked
@dataclass(frozen=True)
class HarmonicsConfig(NetworkConfig):
    """Sizes: of f(γ_o); rings and orders of the harmonics; waves of the phase, see `waves`."""

    image_features: int = 64
    rings: int = 7
    orders: int = 8
    waves: int = 4


class HarmonicsNetwork(EffectNetwork):
    """A network whose image encoder reads the circular harmonics of the image."""

    def make_layers(self, config: HarmonicsConfig) -> None:
        """The harmonics, and the encoder of the image that reads them."""
        self.harmonics, n = CircularHarmonics(config.rings, config.orders), config.image_features
        self.image_encoder = nn.Sequential(*dense(self.harmonics.n_features, 4 * n, 2 * n, n))
        self.image_encoder.apply(he_initialise)

    def features(self, scaled_image: Float[Tensor, "b 2 48 48"]) -> Float[Tensor, "b f"]:
        """f(γ_o): (B, F) of standardised depth and mask."""
        return self.image_encoder(self.harmonics(scaled_image))

    def unoriented_features(self, image: Float[Tensor, "b 2 48 48"]) -> Float[Tensor, "b f"]:
        """The circular harmonics (B, F) of images."""
        return self.harmonics(self._scaled(image))

    def oriented_features(
        self, unoriented: Float[Tensor, "#b f"], rotation: Float[Tensor, "b 2"]
    ) -> Float[Tensor, "b f"]:
        """f(γ_o) of the rotated images, of the harmonics of the images."""
        return self.image_encoder(self.harmonics.rotated(unoriented, rotation))


def waves(t: Float[Tensor, "b t"], n: int) -> Float[Tensor, "b t w"]:
    """t with n sines and cosines of π k t: (B, T, 2n + 1)."""
    angle = t[..., None] * (math.pi * torch.arange(1, n + 1, device=t.device))
    return torch.cat([t[..., None], angle.sin(), angle.cos()], dim=-1)


def dense(*widths: int) -> list[nn.Module]:
    """Linear layers of the given widths, SiLU between them."""
    layers: list[nn.Module] = []
    for n_in, n_out in pairwise(widths):
        layers += [nn.Linear(n_in, n_out), nn.SiLU()]
    return layers[:-1]
