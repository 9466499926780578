"""Command lines refuse invalid input, and end with a one-line message."""

import importlib
import os
import re
import signal

import pytest

from affordlib.results import repo_root
from experiments.commands import command

TABLE, SHIPPED = "experiments.effect_prediction", "experiments.shipped data"


@pytest.mark.parametrize(
    ("line", "code", "named"),
    [
        (f"{TABLE} --workers -2", 2, "--workers: must be .* from 1 to 256"),
        (f"{SHIPPED} --workers 257", 2, "--workers: must be .* from 1 to 256"),
        (f"{SHIPPED} --only nope", 2, "--only: invalid choice: 'nope'"),
        (f"{SHIPPED} --workers {'1' * 5000}", 2, "--workers: must be .*'1{5,40}$"),
        (f"{TABLE} --only model=film,flim", 1, "no job has model = 'flim', but cnp, .*, nearest$"),
        (f"{TABLE} --only fold=11", 1, "no job has fold = '11', but 0, 1,"),
        (f"{TABLE} --only modle=film", 1, "no job has modle = 'film', but None$"),
    ],
)
def test_unknown_names_and_impossible_numbers_are_refused(capsys, line, code, named):
    name, *arguments = line.split()
    try:
        ended = importlib.import_module(name).main(arguments)
    except SystemExit as stopped:
        ended = stopped.code
    assert ended == code
    begins = {1: "^effect_prediction: --only: ", 2: "error: (argument )?"}[code]
    assert re.search(begins + named, capsys.readouterr().err, re.MULTILINE)


def test_every_command_line_ends_in_this_way():
    for path in (repo_root() / "experiments").glob("*.py"):
        assert not re.search(r"(?m)^(?!@command\().*\ndef main\(argv", path.read_text()), path


def test_the_texts_name_commands_and_options_that_exist():
    root, makefile = repo_root(), (repo_root() / "Makefile").read_text()
    modules = {p.stem: p.read_text() for p in root.glob("experiments/**/*.py")} | {"try_it": ""}
    for path in [*root.glob("*.md"), *root.glob("data/*.md"), *root.glob("notebooks/**/*.ipynb")]:
        text = path.read_text()
        for name in re.findall(r"[A-Z]+(?==)", " ".join(re.findall(r"make [a-z-]+ [^`\n]*", text))):
            assert re.search(rf"^{name} +=", makefile, re.MULTILINE), (path, name)
        for module, rest in re.findall(r"(?:experiments\.|#[-\w]+\) \| `)(\w+)([^`\n]*)", text):
            assert module in modules, (path, module)
            for option in re.findall(r"--\w+", rest):
                assert f'"{option}"' in "".join(modules.values()), (path, option)


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
    line = "interrupted; finished work is kept; run it again to continue"
    expected = {1: "test_commands: no room\n", 7: ""}
    assert capsys.readouterr().err == expected.get(code, f"\ntest_commands: {line}\n")
