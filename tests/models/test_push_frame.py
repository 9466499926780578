"""Rotation of images, harmonics and data sets, and the direction of a push."""

import math

import torch

from affordlib.models.base import inverse, push_direction, rotate_image
from affordlib.models.film import CircularHarmonics
from affordlib.types import Observations


def test_harmonics_turn_as_their_image_does(some):
    harmonics = CircularHarmonics(rings=3, orders=4)
    known = harmonics(some.image)
    angle = math.tau * torch.rand(40, generator=torch.Generator().manual_seed(0))
    for turn, exact in ((torch.full((40,), math.pi / 2), True), (angle, False)):
        towards = torch.stack([turn.cos(), turn.sin()], dim=-1)
        quarter = torch.rot90(some.image, 1, (-2, -1))
        turned = quarter if exact else rotate_image(some.image, towards)
        kept = (1 - turned[:, 0]).sum(dim=(1, 2)) / (1 - some.image[:, 0]).sum(dim=(1, 2))
        assert (kept - 1).abs().max() < 0.01  # of the object's height, also in the corners
        off = harmonics.rotated(known, towards) - harmonics(turned)
        # An interpolated image differs slightly from a rotated one; rotated harmonics are exact.
        assert off.abs().max() < (1e-4 if exact else 0.03 * known.abs().max())
        assert (harmonics(turned) - known).abs().max() > 0.2 * known.abs().max()
    back = harmonics.rotated(harmonics.rotated(known, towards), inverse(towards))
    torch.testing.assert_close(back, known, atol=1e-5, rtol=1e-4)


def test_the_direction_is_that_of_the_push(some):
    channels = some.action_channels, some.effect_channels
    travel = some.action[:, -1, :2] - some.action[:, 0, :2]
    expected = travel / travel.norm(dim=-1, keepdim=True)
    for samples in ((0, -1), (0,), (-1, 0), (10, 20)):
        observed = Observations.of(some, some.action_at(torch.tensor(samples)))
        direction = push_direction(observed, *channels)
        torch.testing.assert_close(direction, expected, atol=1e-4, rtol=0)
    # For the inverse query it is the effect's direction; for a zero effect, the table's x axis.
    end = torch.tensor([[0.03, -0.04, 0.1], [0.0, 0.0, 0.0]])
    observed = Observations.of(some, effect=(torch.ones(2, 1), end[:, None]))
    direction = push_direction(observed, *channels)
    torch.testing.assert_close(direction, torch.tensor([[0.6, -0.8], [1.0, 0.0]]))
