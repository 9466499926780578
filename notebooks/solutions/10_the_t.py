"""Solutions to the exercises of notebook 10."""

import numpy as np

from exercises import check


def standoff(contact, normal, direction, radius, clear):
    """One radius outside at the contact, then back along the push, by `clear` over the cosine."""
    centre = np.asarray(contact) - radius * np.asarray(normal)
    return centre - clear / np.dot(normal, direction) * np.asarray(direction)


def chosen(off_m, pushes, price, now_m):
    """Each push costs the same share of the present distance."""
    return int(np.argmin(np.asarray(off_m) + price * now_m * np.asarray(pushes)))


VERDICTS = [check("10.1", standoff), check("10.2", chosen)]
print(*VERDICTS, sep="\n")
