"""Make the README's table of main results: `python -m experiments.headline`.

Each number is taken from a larger table in `data/results`, which has its own command.
"""

from typing import Any

import pandas as pd

from affordlib.results import read_results, write_results

PLANS = {
    "single_full": "plan one full push, execute it",
    "single_partial": "plan one partial push, execute it",
    "multi_partial": "plan up to three partial pushes, execute them",
}
PAPERS, OURS = "gradient_100_pushes", "continuous_film_500"
NOISY = "the same for other goals, perturbed world, noisy camera"
PUSH_M = 0.02  # the paper's error of a push: "around 0.02 m" (Section 4.3)


def _table(file: str, name: str) -> pd.DataFrame:
    return pd.DataFrame(read_results(f"data/results/{file}.json")["tables"][name])


def _row(question: str, n: int, *errors_mm: float) -> dict[str, Any]:
    """Return a row; errors_mm: up to two that the paper reports, its network's here, and ours."""
    *reported, method, ours = (f"{error:.2f}" for error in errors_mm)
    row = {"mean error in mm": question, "n": int(n), "reported": " / ".join(reported) or "–"}
    return row | {"paper's method": method, "ours": ours}


def tables() -> dict[str, list[dict[str, Any]]]:
    """Return a row per question; of its plans, the paper reports errors for 100 and 300 phases."""
    effects = _table("effect_prediction", "push_test").query("object_class == 'all'")
    pushes = effects[effects.n_interactions == 500].set_index("model")
    means = 1000 * pushes.final_error_mean_m
    errors = 1000 * PUSH_M, means["cnp"], means["film"]
    found = [_row("predict where a push ends", pushes.n["film"], *errors)]
    lever = _table("lever_up", "summary").set_index("model")
    errors = 10 * lever.step_5_mean_cm[["reported", "cnp_tuned", "cnp_last_pose"]]
    found.append(_row("predict a lever-up 0.75 s ahead", lever.n["cnp_last_pose"], *errors))
    summary = _table("planning", "summary").query("object_class in ('standing', 'reported')")
    summary = summary.set_index("planner")
    planners = ["reported_gradient_100", "reported_gradient_300", PAPERS, OURS]
    for k, (mode, question) in enumerate(PLANS.items()):
        errors = 1000 * summary[f"{mode}_mean_m"][planners]
        found.append(_row(question, summary.n[OURS].split(", ")[k], *errors))
    noisy = summary.loc[["perturbed_gradient_100", "perturbed_film_500"]]
    found.append(_row(NOISY, noisy.n.iloc[0].split(", ")[-1], *1000 * noisy.multi_partial_mean_m))
    return {"main": found}


if __name__ == "__main__":
    print(write_results("data/results", "headline", {}, tables()))
