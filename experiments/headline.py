"""Make the README's table of main results: `python -m experiments.headline`.

Each number is taken from a larger table in `data/results`, which has its own command.
"""

from __future__ import annotations

from typing import Any

import pandas as pd

from affordlib.results import read_results, write_results

PLANS = {
    "single_full": "plan one full push, execute it",
    "single_partial": "plan one partial push, execute it",
    "multi_partial": "plan up to three partial pushes, execute them",
}


def _table(file: str, name: str) -> pd.DataFrame:
    return pd.DataFrame(read_results(f"data/results/{file}.json")["tables"][name])


def _row(question: str, n: int, factor: float, reported: float | None, paper: float, ours: float):
    errors = {"reported": reported, "paper's network": paper, "our network": ours}
    shown = {name: "–" if e is None else f"{factor * e:.2f}" for name, e in errors.items()}
    return {"mean error in mm": question, "n": int(n)} | shown


def tables() -> dict[str, list[dict[str, Any]]]:
    """Return a row per question: number of trials, the paper's value, both networks' values."""
    effects = _table("effect_prediction", "push_test").query("object_class == 'all'")
    pushes = effects[effects.n_interactions == 500].set_index("model")
    means = pushes.final_error_mean_m
    question = "predict where a push ends"
    found = [_row(question, pushes.n["film"], 1000, None, means["cnp"], means["film"])]
    lever = _table("lever_up", "summary").set_index("model")
    means = lever.step_5_mean_cm[["reported", "cnp", "cnp_last_pose"]]
    found.append(_row("predict a lever-up 0.75 s ahead", lever.n["cnp_last_pose"], 10, *means))
    summary = _table("planning", "summary").query("object_class in ('standing', 'reported')")
    summary = summary.set_index("planner")
    each = _table("planning", "planning").query(
        "planner == 'continuous_film_500' and object_class == 'standing' and goals == 'constructed'"
    )
    for mode, question in PLANS.items():
        planners = ["reported_gradient_300", "continuous_cnp_500", "continuous_film_500"]
        means = summary[f"{mode}_mean_m"][planners]
        found.append(_row(question, each.set_index("mode").n[mode], 1000, *means))
    return {"main": found}


if __name__ == "__main__":
    print(write_results("data/results", "headline", {}, tables()))
