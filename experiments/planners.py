"""Planners that stand beside those of `affordlib.planning` in Table 3."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any
from unittest import mock

from affordlib.planning import PlanningProblem, continuous, plan_astar, plan_continuous
from affordlib.types import Plan

FINE_PHASES = tuple(round(0.5 + 0.05 * k, 2) for k in range(1, 11))


def _whole(planner: Callable[..., Plan]) -> Callable[..., Plan]:
    """A planner without partial actions."""

    def plan(problem: PlanningProblem, **arguments: Any) -> Plan:
        return planner(replace(problem, mode=replace(problem.mode, partial=False)), **arguments)

    plan.__name__ = f"{planner.__name__}_full"
    return plan


plan_astar_full = _whole(plan_astar)
plan_continuous_full = _whole(plan_continuous)


def plan_astar_fine(problem: PlanningProblem, heuristic: str = "goal") -> Plan:
    """A* with twice as many directions and stop phases, content within 5 mm instead of 20."""
    problem = replace(problem, goal=replace(problem.goal, tolerance_m=0.005))
    return plan_astar(problem, 72, FINE_PHASES, heuristic)


def plan_continuous_with(problem: PlanningProblem, **constants: Any) -> Plan:
    """The continuous planner with other values of its module's constants."""
    with mock.patch.multiple(continuous, **constants):
        return plan_continuous(problem)
