"""Imports point one way, and the promises of the layout hold."""

import ast
from pathlib import Path

import pytest

import affordlib

ROOT = Path(affordlib.__file__).parent
CHECKED = affordlib._CHECKED.split()
MODULES = sorted(p.relative_to(ROOT.parent) for p in ROOT.rglob("*.py"))

FORBIDDEN = {
    "types": {"world", "interactions", "models", "planning", "evaluation", "show"},
    "perception": {"world", "interactions", "models", "planning", "evaluation", "show"},
    "primitives": {"world", "interactions", "models", "planning", "evaluation", "show"},
    "world": {"interactions", "models", "planning", "evaluation", "show"},
    "interactions": {"models", "planning", "evaluation", "show"},
    "models": {"world", "planning", "evaluation", "show"},
    "planning": {"world", "evaluation", "show"},
    "evaluation": {"show"},
}
NO_WORLD = {
    f"interactions/{name}.py"
    for name in ("__init__", "dataset", "sampling", "lever_up", "import_log", "store")
}


def imported(path: Path) -> set[str]:
    """First-level parts of affordlib that a module imports when it runs."""
    tree = ast.parse((ROOT.parent / path).read_text())
    typing_only = {
        id(node)
        for block in ast.walk(tree)
        if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING"
        for node in ast.walk(block)
    }
    names = set()
    for node in ast.walk(tree):
        if id(node) in typing_only:
            continue
        if isinstance(node, ast.ImportFrom) and node.module:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    assert not any(name.startswith("experiments") for name in names)
    return {n.split(".")[1] for n in names if n.startswith("affordlib.")}


@pytest.mark.parametrize("path", MODULES, ids=str)
def test_imports_point_one_way(path):
    part = path.with_suffix("").parts[1] if len(path.parts) > 1 else ""
    assert not imported(path) & FORBIDDEN.get(part, set())
    if path.relative_to("affordlib").as_posix() in NO_WORLD:
        assert "world" not in imported(path)


@pytest.mark.parametrize("path", MODULES, ids=str)
def test_modules_are_short_and_well_named(path):
    text = (ROOT.parent / path).read_text()
    assert text.count("\n") <= 500
    assert path.stem not in {"utils", "helpers", "misc", "common"}
    assert ast.get_docstring(ast.parse(text))


def test_only_the_world_and_its_users_know_pybullet():
    users = [p for p in MODULES if "import pybullet" in (ROOT.parent / p).read_text()]
    assert {p.parts[1] for p in users} == {"world"}


def test_functions_in_functions_are_not_decorated_again_and_again():
    """What beartype checks it decorates where it is defined: a closure, every time."""
    for path in MODULES:
        if path.with_suffix("").as_posix().replace("/", ".").partition(".")[2] not in CHECKED:
            continue
        for outer in ast.walk(ast.parse((ROOT.parent / path).read_text())):
            inner = ast.walk(outer) if isinstance(outer, ast.FunctionDef) else ()
            for each in inner:
                if isinstance(each, ast.FunctionDef) and each is not outer:
                    arguments = [*each.args.args, *each.args.kwonlyargs]
                    assert not each.returns, f"{path}: {each.name}"
                    assert not any(argument.annotation for argument in arguments)
