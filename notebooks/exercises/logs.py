"""Exercises of notebooks 09 and 10: the effect of a push, mirrored pushes, and where to begin."""

from collections.abc import Callable

import numpy as np

from affordlib.geometry import rotated, unit_vector
from exercises.checking import answer_of, exercise


@exercise("09.1", 0.0, 0.1, "mm or mrad, largest error")
def effect_error(effect: Callable) -> float:
    """Write effect(before, after, centroid, heading): ahead, left and turn of a push.

    The corner moves differently from the centroid when the object turns.
    Rotate the given centroid by each pose's yaw and add its position; then subtract.
    """
    rng, off = np.random.default_rng(0), []
    for _ in range(20):
        heading, yaw, turn = rng.uniform(-np.pi, np.pi, 3)
        xy, centroid, moved = rng.normal(scale=0.1, size=(3, 2))
        middle = xy + rotated(centroid, yaw) + rotated(moved, heading)
        end_yaw = (yaw + turn + np.pi) % (2 * np.pi) - np.pi
        end = middle - rotated(centroid, end_yaw)
        got = answer_of(effect, (*xy, yaw), (*end, end_yaw), centroid, heading)
        off.append(got - (*moved, turn))
    return 1000 * np.abs(off).max()


@exercise("09.2", 0.0, 1e-6, "largest error")
def mirror_error(mirrored: Callable) -> float:
    """Write mirrored(contact, direction, displacement, turn): seven numbers, mirrored at x.

    Mirrored at the x axis, x stays.
    All components along y change their signs; think also of the sense of rotation.
    """
    rng, off, flip = np.random.default_rng(0), [], np.array([1, -1])
    for _ in range(20):
        contact, moved, angle, turn = *rng.normal(size=(2, 2)), *rng.normal(size=2)
        truth = *(flip * contact), *(flip * unit_vector(angle)), *(flip * moved), -turn
        off.append(answer_of(mirrored, contact, unit_vector(angle), moved, turn) - truth)
    return np.abs(off).max()


@exercise("10.1", 0.0, 0.001, "mm, largest error")
def standoff_error(standoff: Callable) -> float:
    """Write standoff(contact, normal, direction, radius, clear): the tool's centre, (x, y).

    At the contact the tool's centre is one radius outside, along the normal.
    Going back along the push by a length gains only its share along the normal.
    """
    rng, off = np.random.default_rng(0), []
    for _ in range(20):
        contact, facing, aside = rng.normal(scale=0.1, size=2), *rng.uniform(-1, 1, 2)
        radius, clear = rng.uniform(0.001, 0.02, 2)
        normal, direction = unit_vector(np.pi * facing), unit_vector(np.pi * facing + 0.8 * aside)
        truth = contact - radius * normal - clear / (normal @ direction) * direction
        off.append(answer_of(standoff, contact, normal, direction, radius, clear) - truth)
    return 1000 * np.abs(off).max()


@exercise("10.2", 0.0, 0.1, "% wrong choices")
def wrong_choices(chosen: Callable) -> float:
    """Write chosen(off_m, pushes, price, now_m): the number of the chain, from 0.

    Add the price of its pushes to each chain's distance.
    One push costs the same in every chain: a share of the present distance.
    """
    rng, wrong = np.random.default_rng(0), []
    for _ in range(50):
        off_m, pushes = rng.exponential(0.02, 12), rng.integers(1, 4, 12)
        now_m, price = rng.uniform(0, 0.2), rng.uniform(0, 0.5)
        best = (off_m + price * now_m * pushes).argmin()
        wrong.append(answer_of(chosen, off_m, pushes, price, now_m).item() != best)
    return 100 * np.mean(wrong)
