"""Planning problems for tests."""

import numpy as np

from affordlib.planning import EffectMap, PlanningProblem
from affordlib.primitives import Push


def problem_of(model, image, start_xy_m, goal, mode="multi_partial", kind=Push, **more):
    """A problem, given the model and the image of its effects."""
    return PlanningProblem(start_xy_m, goal, EffectMap(model, image, kind), mode, **more)


class Still:
    """A model of pushes that do not move the object."""

    def predict(self, pushes):
        return np.zeros((len(pushes), 3)), np.ones((len(pushes), 3))
