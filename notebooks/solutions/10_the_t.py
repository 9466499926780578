"""Solution to the exercise of notebook 10."""

import numpy as np

from exercises import check


def standoff(contact, normal, direction, radius, clear):
    """One radius outside at the contact, then back along the push, by `clear` over the cosine."""
    centre = np.asarray(contact) - radius * np.asarray(normal)
    return centre - clear / np.dot(normal, direction) * np.asarray(direction)


VERDICTS = [check("10.1", standoff)]

if __name__ == "__main__":
    print(*VERDICTS, sep="\n")
