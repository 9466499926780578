"""Steps, plans and outcomes as a reader would say them."""

from __future__ import annotations

import math

from affordlib.primitives import wrap_angle
from affordlib.types import Goal, Outcome, Plan, Step


def step_in_words(step: Step) -> str:
    """Which primitive, and to which share of its phase."""
    return f"{step.primitive.name.replace('_', ' ')} to {100 * step.stop_phase:.0f} %"


def plan_in_words(plan: Plan) -> str:
    """The actions, how near they are expected to lead, and what finding them took."""
    steps = ", then ".join(step_in_words(step) for step in plan.steps) or "stay"
    arrives = "" if plan.reaches_goal else " It does not arrive."
    if not plan.reaches_goal and plan.predicted_distance_m <= plan.goal.tolerance_m:
        arrives = " It arrives, but is not foreseen to be turned or lifted there as the goal asks."
    std_m = plan.steps[-1].std_m if plan.steps else math.nan
    unsure = "" if math.isnan(std_m) else f" (σ of the last step {1000 * std_m:.1f} mm)"
    return (
        f"Plan: {steps}. Expected to end {1000 * plan.predicted_distance_m:.1f} mm from the goal"
        f"{unsure}.{arrives} Found in {1000 * plan.plan_s:.0f} ms."
    )


def outcome_in_words(outcome: Outcome, goal: Goal, how: str, done: int) -> str:
    """Where the object rests (HTML); how: "Done," or "Stopped after", done: how many actions."""
    within = "within" if outcome.distance_m <= goal.tolerance_m else "outside"
    posed = ""
    if goal.turn_rad is not None:
        off = math.degrees(abs(wrap_angle(goal.turn_rad - outcome.turned_rad)))
        posed += f" The turn is off by {off:.1f}°."
    if goal.height_m is not None:
        off = 1000 * abs(goal.height_m - outcome.lifted_m)
        posed += f" The height is off by {off:.1f} mm."
    return (
        f"{how} {done} action{'s' * (done != 1)}: the object rests "
        f"<b>{1000 * outcome.distance_m:.1f} mm</b> from the goal, {within} the tolerance of "
        f"{1000 * goal.tolerance_m:.0f} mm.{posed} {outcome.words}".rstrip()
    )
