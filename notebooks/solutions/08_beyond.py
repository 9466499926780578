"""Solutions to the exercises of notebook 08."""

import numpy as np

from affordlib.interactions import open_interactions
from affordlib.models import final_error, load_checkpoint, network_predictions
from exercises import check


def strangeness(image):
    """Cuboids and cylinders look the same after half a turn, a house does not.

    It detects this kind of object only. A general test would measure the distance of the image, or
    of its features, to the nearest one of the training data.
    """
    mask = image[1]
    return np.abs(mask - mask[::-1, ::-1]).mean()


def lower_half_mm():
    """Half of the pushes, chosen by σ alone, have a fraction of the error of all of them."""
    pushes = open_interactions("push_test")
    model, _ = load_checkpoint("film_5000")
    answers = network_predictions(model, pushes, np.arange(pushes.sizes["interaction"]))
    sigma = np.hypot(answers["std"]["x"], answers["std"]["y"])
    return 1000 * float(final_error(answers)[sigma <= np.median(sigma)].mean())


VERDICTS = [check("08.1", strangeness), check("08.2", lower_half_mm())]
print(*VERDICTS, sep="\n")
