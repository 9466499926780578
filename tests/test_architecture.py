"""Imports point in one direction, and the layout follows its rules."""

import ast
import graphlib
import importlib
import inspect
import json

import pytest

from tests.size import ROOT, code_lines
from tests.waiting import printed

MODULES = sorted(p.relative_to(ROOT) for p in (ROOT / "affordlib").rglob("*.py"))
EXPERIMENTS = sorted(p.relative_to(ROOT) for p in (ROOT / "experiments").rglob("*.py"))
TREES = {path: ast.parse((ROOT / path).read_text()) for path in [*MODULES, *EXPERIMENTS]}

UP = ("world", "interactions", "models", "planning", "show")
"""The parts in order: each may know those before it, but for `EXCEPT`."""
EXCEPT = {"models": {"world"}, "planning": {"world"}}
BESIDE = "logs"  # a part that knows none of the others, and that none of them knows
USE_WORLD = {"recipes", "collect"}  # the modules of `interactions` that know the world
PAGES = sorted((ROOT / "notebooks").rglob("*.ipynb"))


def name_of(path):
    return ".".join(path.with_suffix("").parts).removesuffix(".__init__")


def imported(path):
    names = set()
    tree = ast.Module([n for n in TREES[path].body if not isinstance(n, ast.If)], [])  # not types
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            each = {f"{node.module}.{alias.name}" for alias in node.names}
            names |= each if each <= set(map(name_of, TREES)) else each | {node.module}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return names


@pytest.mark.parametrize("path", MODULES, ids=str)
def test_a_module_is_short_well_named_and_imports_one_way(path):
    assert (ROOT / path).read_text().count("\n") <= 500
    assert path.stem not in {"utils", "helpers", "misc", "common"}
    names = imported(path)
    assert not any(name.split(".")[0] in ("experiments", "exercises", "tests") for name in names)
    parts = {name.split(".")[1] for name in names if name.startswith("affordlib.")}
    part = path.parts[1].removesuffix(".py")
    below = UP[: UP.index(part) + 1] if part in UP else ()  # what is no folder stands below all
    below = (BESIDE,) if part == BESIDE else below
    allowed = set(below) - EXCEPT.get(part, set())
    if part == "interactions" and path.stem not in USE_WORLD:
        allowed.remove("world")
    assert not parts & {*UP, BESIDE} - allowed


def test_no_module_needs_itself_and_only_the_world_knows_pybullet():
    modules = {name_of(path): path for path in TREES}
    needs = {name: imported(path) & modules.keys() - {name} for name, path in modules.items()}
    assert len(list(graphlib.TopologicalSorter(needs).static_order())) == len(modules)
    assert {p.parts[1] for p in MODULES if "pybullet" in imported(p)} == {"world"}


def test_no_function_has_too_many_parameters():
    for path, tree in TREES.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                a = node.args
                each = {x.arg for x in [*a.posonlyargs, *a.args, *a.kwonlyargs]} - {"self", "cls"}
                assert len(each) <= 7, f"{path}: {node.name}"


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_a_page_imports_from_few_modules(path):
    """At most eight, and public names from the package that exports them."""
    cells = json.loads(path.read_text())["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    names = [n for text in code for n in ast.walk(ast.parse(text)) if isinstance(n, ast.ImportFrom)]
    names = [n for n in names if n.module.startswith("affordlib.")]
    assert len({n.module for n in names}) <= 8
    for node in names:
        package = ".".join(node.module.split(".")[:2])
        there = vars(importlib.import_module(package)).items()
        exported = {name for name, value in there if not inspect.ismodule(value)}
        assert package == node.module or not {alias.name for alias in node.names} & exported


IMPORT = """
import os, sys, threading, time
import numpy as np
began = time.process_time()
import torch
torch_s = time.process_time() - began

def state():
    return (dict(os.environ), os.getcwd(), os.listdir(),
            str(np.random.get_state()), torch.initial_seed(), torch.get_num_threads(),
            torch.get_default_dtype(), torch.is_grad_enabled(), threading.active_count())

before, began = state(), time.process_time()
import affordlib.{part}
took_s = time.process_time() - began
assert state() == before, [pair for pair in zip(state(), before) if pair[0] != pair[1]]
print(torch_s, took_s, "pybullet" in sys.modules)
"""


@pytest.mark.slow
@pytest.mark.parametrize("part", ["show", "planning", BESIDE])
def test_importing_is_quick_and_changes_nothing(part, tmp_path):
    """Importing takes a second on an idle machine; the limit is three times the time of PyTorch."""
    torch_s, took_s, simulator = printed(IMPORT.format(part=part), cwd=tmp_path).split()
    assert simulator == str(part == "show")
    assert float(took_s) < 3 * float(torch_s)


def test_lines_of_code_are_counted_without_words():
    assert code_lines('"""W."""\n\nX = 1\n"""W."""\n# w\ndef f():\n    return """a\n\nb"""\n') == 5
