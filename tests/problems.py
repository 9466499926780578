"""Planning problems as tests put them."""

from affordlib.planning import EffectMap, PlanningProblem
from affordlib.primitives import Push


def problem_of(model, image, start_xy_m, goal, mode="multi_partial", kind=Push, **more):
    """A problem, from the model and the image that its effects come from."""
    return PlanningProblem(start_xy_m, goal, EffectMap(model, image, kind), mode, **more)
