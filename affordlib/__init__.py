"""Learned affordances and planning with partial actions: the package behind the workbook."""

from collections.abc import Sequence
from numbers import Integral, Real
from typing import Annotated

import numpy as np
from beartype import BeartypeConf, FrozenDict, beartype
from beartype.claw import beartype_packages
from beartype.vale import Is

# Public functions check their arguments' types; a number may be neither a string nor a bool.
_NO_BOOL = Is[lambda value: not isinstance(value, bool)]
_NUMBER = Annotated[Real, _NO_BOOL]
_NO_TEXT = Is[lambda value: not isinstance(value, str)]
_NUMBERS = Annotated[Sequence[_NUMBER], _NO_TEXT] | np.ndarray
_CHECKED = """
types geometry primitives perception results weights workers world.objects world.tabletop
interactions.collect interactions.dataset interactions.recipes interactions.store
models.checkpoint models.domain models.evaluation models.lever_up models.training
planning.astar planning.closed_loop planning.continuous planning.effect_map planning.gradient
planning.grasp_rotate planning.problem planning.skills
logs.cross_validate logs.fit logs.log logs.planning
show.explorers show.goal_picker show.picker_controls show.plots show.scene
"""
_CONF = BeartypeConf(
    violation_type=TypeError,
    claw_is_pep526=False,
    hint_overrides=FrozenDict(
        {
            bool: bool | np.bool_,
            int: Annotated[Integral, _NO_BOOL],
            float: _NUMBER,
            Sequence[float]: _NUMBERS,
            tuple[float, float]: _NUMBERS,
            tuple[float, float, float]: _NUMBERS,
            tuple[str, ...]: tuple[str, ...] | list[str],
            Sequence[str]: Annotated[Sequence[str], _NO_TEXT],
        }
    ),
)
beartype_packages(tuple(f"affordlib.{name}" for name in _CHECKED.split()), conf=_CONF)
checked = beartype(conf=_CONF)
"""Decorator that checks argument types of a class or function in a module not listed above."""
