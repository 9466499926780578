import re
from dataclasses import replace

import nbformat
import numpy as np
import pytest
from pages import PAGES as PATHS

from affordlib.results import repo_root
from exercises import EXERCISES, check
from exercises.checking import WRONG, explanation

ASKED = {name[:2] for name in EXERCISES}


def test_the_chapters_with_checks_have_two_exercises_and_solutions():
    solutions = (repo_root() / "notebooks" / "solutions").glob("*.py")
    assert {path.stem for path in solutions} == {n for n in PATHS if n[:2] in ASKED}
    assert {name[:2] for name in PATHS if name[0].isdigit()} | {"A5"} == ASKED
    assert all(sum(e[:2] == number for e in EXERCISES) >= 2 for number in ASKED)


@pytest.mark.parametrize("name", [n for n in PATHS if n[:2] in ASKED])
def test_the_notebook_asks_each_exercise_and_leaves_it_open(name):
    cells = nbformat.read(PATHS[name], as_version=4).cells
    text = "\n".join(c.source for c in cells)
    numbers = re.findall(r'check\("(\w\d\.\d)"', text)
    assert numbers == [n for n in EXERCISES if n[:2] == name[:2]]
    assert all(f"**{number}**" in text for number in numbers)
    outputs = [o for cell in cells if "check(" in cell.source for o in cell.get("outputs", [])]
    shown = [output["data"]["text/plain"] for output in outputs if "data" in output]
    assert len(shown) == len(numbers)
    assert all("not attempted" in text for text in shown)


@pytest.mark.parametrize("attempt", [None, ..., lambda *_: None, lambda *_: ...])
def test_what_is_not_attempted(attempt):
    verdict = check("01.1", attempt)
    assert (verdict.status, verdict.passed) == ("not attempted", False)
    assert "Write speed_m_s(t)" in str(verdict)


def straight(effects, direction, phase):
    """A chain of pushes whose object does not turn."""
    (ahead, left, _), (c, s) = effects(direction, phase)[0].T, (direction.cos(), direction.sin())
    return float((c * ahead - s * left).sum()), float((s * ahead + c * left).sum())


def idle(look, plan, act):
    return act(replace(plan(look()).steps[0], stop_phase=0.0))


@pytest.mark.slow
def test_a_wrong_answer_fails_and_says_by_how_much():
    for name, attempt, says in (
        ("01.1", lambda t: 0.0, "failed, 125 mm/s, largest error; expected 0 ± 0.1 mm/s"),
        ("01.1", lambda t: 1 / 0, "failed (ZeroDivisionError: division by zero); expected"),
        ("01.2", lambda image: 16**2 * image[1].mean() * 6, "failed, 20.7"),
        ("02.1", 7.5, "failed, 7.5 mm. Hint: Rotate"),
        ("03.2", lambda mean, sigma, rng: mean, "failed (ValueError: the draws spread by 0.00 σ"),
        ("03.2", lambda m, s, rng: rng.normal(m, s)[1:], "failed (ValueError: a trajectory"),
        ("04.1", lambda model, arrays: 0.002, "failed (ValueError: ours rotates with"),
        ("05.1", 0.261, "failed, 0.261 cm"),
        ("06.1", straight, "failed, 16.8"),
        ("06.2", lambda effects, goal: (np.arctan2(goal[1], goal[0]), 1.0), "failed, 39"),
        ("07.1", lambda look, plan, act: [act(step) for step in plan(look()).steps], "failed, 77"),
        ("07.1", lambda look, plan, act: [idle(look, plan, act) for _ in range(99)], "no end a"),
        ("07.2", lambda height, phase, course: 1.0, "failed, 220"),
        ("08.1", lambda image: image[1].mean(), "failed, 31"),
        ("09.1", lambda *_: (np.nan, 0.0, 0.0), "failed, nan mm or mrad"),
        ("A5.1", 0.6, "failed, 0.6 of the full action. Hint: The"),
        ("A5.2", lambda a, b: a.read_bytes() == b.read_bytes(), "failed, 1 pairs"),
    ):
        assert says in str(check(name, attempt)), name


def test_a_wrong_answer_gives_one_hint_then_another_and_an_explanation_but_not_the_answer():
    assert all(explanation(name) for name in EXERCISES)
    assert all(len(exercise.hints) == 2 for exercise in EXERCISES.values())
    WRONG.clear()
    first, second = check("A5.1", 0.61), check("A5.1", 0.62)
    hints = [str(verdict).partition(". Hint: ")[2] for verdict in (first, second)]
    assert hints == EXERCISES["A5.1"].hints
    assert "0.58" not in f"{first} {second} {second._repr_html_()}"
    assert "<details>" in second._repr_html_()
    for no_number in ("0.61", "x", np.nan, [0.61]):
        assert "0.58" not in str(check("A5.1", no_number))
