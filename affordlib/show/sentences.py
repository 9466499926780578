"""Steps, plans and outcomes as a reader would say them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from affordlib.types import Goal, Outcome, Plan, Step


def step_in_words(step: Step) -> str:
    """Which primitive, and to which share of its phase."""
    return f"{step.primitive.name.replace('_', ' ')} to {100 * step.stop_phase:.0f} %"


def plan_in_words(plan: Plan) -> str:
    """The actions, how near they are expected to lead, and what finding them took."""
    steps = ", then ".join(step_in_words(step) for step in plan.steps) or "stay"
    arrives = "" if plan.reaches_goal else " It does not arrive."
    std_m = plan.steps[-1].std_m if plan.steps else math.nan
    unsure = "" if math.isnan(std_m) else f" (σ of the last step {1000 * std_m:.1f} mm)"
    goal = plan.goal
    posed = goal.turn_rad is not None or goal.height_m is not None
    later = " Turn and lift follow there, in a closed loop." if posed else ""
    return (
        f"Plan: {steps}. Expected to end {1000 * plan.predicted_distance_m:.1f} mm from the goal"
        f"{unsure}.{arrives}{later} Found in {1000 * plan.plan_s:.0f} ms."
    )


def outcome_in_words(outcome: Outcome, goal: Goal, how: str, done: int) -> str:
    """Where the object rests (HTML); how: "Done," or "Stopped after", done: how many actions."""
    within = "within" if outcome.distance_m <= goal.tolerance_m else "outside"
    return (
        f"{how} {done} action{'s' * (done != 1)}: the object rests "
        f"<b>{1000 * outcome.distance_m:.1f} mm</b> from the goal, {within} the tolerance of "
        f"{1000 * goal.tolerance_m:.0f} mm. {outcome.words}".rstrip()
    )
