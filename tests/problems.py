"""Planning problems as tests put them."""

import numpy as np

from affordlib.planning import EffectMap, PlanningProblem
from affordlib.primitives import Push


def problem_of(model, image, start_xy_m, goal, mode="multi_partial", kind=Push, **more):
    """A problem, from the model and the image that its effects come from."""
    return PlanningProblem(start_xy_m, goal, EffectMap(model, image, kind), mode, **more)


class Still:
    """A model of pushes that move nothing."""

    def predict(self, pushes):
        return np.zeros((len(pushes), 3)), np.ones((len(pushes), 3))
