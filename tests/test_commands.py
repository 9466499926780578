"""Command lines refuse what is no use, and end with one line."""

import importlib
import os
import re
import signal

import pytest

from affordlib.commands import command
from affordlib.paths import repo_root

ALL = {
    path.relative_to(repo_root()).with_suffix("").as_posix().replace("/", ".")
    for folder in ("affordlib", "experiments")
    for path in (repo_root() / folder).rglob("*.py")
    if "parse_args" in path.read_text() and "\nif __name__" in path.read_text()
}


def main_of(name):
    return importlib.import_module(name if name in ALL else f"affordlib.{name}").main


@pytest.mark.parametrize(
    ("name", "arguments", "named"),
    [
        (
            "experiments.effect_prediction",
            ["--models", "film,flim"],
            "--models: 'flim' is unknown; choose",
        ),
        ("experiments.effect_prediction", ["--sets", "nope"], "--sets: 'nope' is unknown"),
        (
            "experiments.effect_prediction",
            ["--folds", "-1"],
            "--folds: must be a whole number from 1 to 10, got",
        ),
        (
            "experiments.effect_prediction",
            ["--folds", "11"],
            "--folds: must be a whole number from 1 to 10, got",
        ),
        (
            "experiments.effect_prediction",
            ["--seeds", "0"],
            "--seeds: must be a whole number from 1",
        ),
        (
            "experiments.effect_prediction",
            ["--workers", "-2"],
            "--workers: must be a whole number from 1",
        ),
        ("experiments.effect_prediction", ["--n", "many"], "--n: must be a whole number from 1"),
        ("experiments.closed_loop", ["--tables", "nope"], "--tables: 'nope' is unknown"),
        ("experiments.closed_loop", ["--seed", "-1"], "--seed: must be a whole number from 0"),
        ("experiments.closed_loop", ["--n", "0"], "--n: must be a whole number from 1"),
        ("experiments.lever_up", ["--models", ""], "--models: '' is unknown"),
        ("experiments.lever_up", ["--protocols", "nope"], "--protocols: 'nope' is unknown"),
        ("experiments.lever_up", ["--no-edges", "2"], "--no-edges: must be .* from 3 to 8"),
        ("experiments.lever_up", ["--epochs", "-5"], "--epochs: must be a whole number from 1"),
        ("experiments.shipped", ["data", "--only"], "--only: expected at least one argument"),
        ("experiments.shipped", ["data", "--only", "nope"], "--only: invalid choice: 'nope'"),
        (
            "experiments.shipped",
            ["data", "--workers", "1" * 5000],
            "--workers: must be .*'1{5,40}$",
        ),
        ("experiments.shipped", ["reachability", "nope"], "unrecognized arguments: nope"),
        ("experiments.seeds", ["-1"], "seeds: must be a whole number from 0"),
        ("experiments.seeds", ["0", "--workers", "0"], "--workers: must be a whole number from 1"),
        ("workbook", ["--seed", "-1"], "--seed: must be a whole number from 0"),
    ],
)
def test_unknown_names_and_impossible_numbers_are_refused(capsys, name, arguments, named):
    with pytest.raises(SystemExit) as ended:
        main_of(name)(arguments)
    assert ended.value.code == 2
    assert re.search(rf"error: (argument )?{named}", capsys.readouterr().err, re.MULTILINE)


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("experiments.effect_prediction", ["--models", "constant", "--raw", "{}"]),
        ("experiments.lever_up", ["--raw", "{}"]),
        ("experiments.studies", ["--only", "latent", "--raw", "{}"]),
        ("experiments.shipped", ["data", "--only", "grasp", "--workers", "1", "--to", "{}"]),
    ],
)
def test_a_file_in_place_of_a_folder_is_named(tmp_path, capsys, name, arguments):
    file = tmp_path / "file"
    file.touch()
    assert main_of(name)([each.format(file) for each in arguments]) == 1
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith(f"{name.rpartition('.')[2]}: ")
    assert str(file) in last
    assert file.read_bytes() == b""


def test_every_command_line_ends_in_this_way():
    for module in ALL:
        main = importlib.import_module(module).main
        assert hasattr(main, "__wrapped__"), f"{module}: its main is no `command`"


@pytest.mark.parametrize(
    ("how", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (None, 1), (0, 7)]
)
def test_a_command_ends_with_a_status_and_one_line(capsys, how, code):
    @command(OSError)
    def main():
        if how is None:
            raise OSError("no room")
        if how:
            os.kill(os.getpid(), how)
        return 7

    before = signal.getsignal(signal.SIGTERM)
    ignored = signal.signal(signal.SIGINT, signal.default_int_handler)  # as in the background
    try:
        assert main() == code
    finally:
        signal.signal(signal.SIGINT, ignored)
    assert signal.getsignal(signal.SIGTERM) is before
    line = "interrupted; what is finished is kept, the same command goes on"
    expected = {1: "test_commands: no room\n", 7: ""}
    assert capsys.readouterr().err == expected.get(code, f"\ntest_commands: {line}\n")


def test_other_errors_of_a_command_keep_their_traceback():
    @command(OSError)
    def main():
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        main()
