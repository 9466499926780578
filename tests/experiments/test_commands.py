"""Command lines refuse invalid input; jobs keep results, refuse stale ones, and survive kills."""

import gzip
import importlib
import os
import re
import signal
import subprocess
import sys
from dataclasses import dataclass, replace

import pandas as pd
import pytest
from pandas.testing import assert_frame_equal

from affordlib.results import read_results, repo_root, write_results
from experiments import runner
from experiments.commands import command
from experiments.runner import Job, frame, read, run

TABLE, SHIPPED = "experiments.effect_prediction", "experiments.shipped data"
CALLS, DEADLY = [], set()
ENDS = {signal.SIGINT: 130, signal.SIGTERM: 143, None: 1, 0: 7}
TABLES = ("effect_prediction", "lever_up", "planning", "closed_loop", "real_pushes", "headline")


def test_unknown_names_and_impossible_numbers_are_refused(capsys):
    for line, code, named in (
        (f"{TABLE} --workers -2", 2, "--workers: must be .* from 1 to 256"),
        (f"{SHIPPED} --workers 257", 2, "--workers: must be .* from 1 to 256"),
        (f"{SHIPPED} --only nope", 2, "--only: invalid choice: 'nope'"),
        (f"{SHIPPED} --workers {'1' * 5000}", 2, "--workers: must be .*'1{5,40}$"),
        (f"{TABLE} --only model=film,flim", 1, "no job has model = 'flim', but cnp, .*, nearest$"),
        (f"{TABLE} --only fold=11", 1, "no job has fold = '11', but 0, 1,"),
        (f"{TABLE} --only modle=film", 1, "no job has modle = 'film', but None$"),
    ):
        name, *arguments = line.split()
        try:
            ended = importlib.import_module(name).main(arguments)
        except SystemExit as stopped:
            ended = stopped.code
        assert ended == code, line
        begins = {1: "^effect_prediction: --only: ", 2: "error: (argument )?"}[code]
        assert re.search(begins + named, capsys.readouterr().err, re.MULTILINE)


def test_command_lines_end_in_this_way_and_the_texts_name_commands_and_options_that_exist():
    root, makefile = repo_root(), (repo_root() / "Makefile").read_text()
    modules = {p.stem: p.read_text() for p in root.glob("experiments/**/*.py")} | {"try_it": ""}
    for path in (root / "experiments").rglob("*.py"):
        assert not re.search(r"(?m)^(?!@command\().*\ndef main\(argv", path.read_text()), path
    for path in [*root.glob("*.md"), *root.glob("data/*.md"), *root.glob("notebooks/**/*.ipynb")]:
        text = path.read_text()
        for name in re.findall(r"[A-Z]+(?==)", " ".join(re.findall(r"make [a-z-]+ [^`\n]*", text))):
            assert re.search(rf"^{name} +=", makefile, re.MULTILINE), (path, name)
        for module, rest in re.findall(r"(?:experiments\.|#[-\w]+\) \| `)(\w+)([^`\n]*)", text):
            assert module in modules, (path, module)
            for option in re.findall(r"--\w+", rest):
                assert f'"{option}"' in "".join(modules.values()), (path, option)


@pytest.mark.parametrize(("how", "code"), ENDS.items())
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


def squares(n, resume_checkpoint=None):
    """Rows of squares; killed once between its two halves if `n` is among the deadly."""
    CALLS.append(n)
    if n in DEADLY and not resume_checkpoint.exists():
        resume_checkpoint.write_text("half")
        raise KeyboardInterrupt
    return {"rows": [{"k": k, "square": k * k / 3} for k in range(n)]}


def job(n, **change):
    return Job(squares, {"n": n}, data=("grasp",), checkpoints=("film_500",), **change)


@pytest.fixture(autouse=True)
def clean():
    CALLS.clear()
    DEADLY.clear()


def test_a_killed_run_goes_on_where_it_was(tmp_path):
    DEADLY.add(3)
    jobs = [job(n) for n in (1, 2, 3, 4)]
    with pytest.raises(KeyboardInterrupt):
        run(jobs, "table", folder=tmp_path)
    assert [arguments["n"] for arguments, _ in read("table", job, tmp_path)] == [1, 2]
    assert len(list(tmp_path.glob("*.pt"))) == 1 == len(list(tmp_path.glob(".*.pt")))
    results = run(jobs, "table", folder=tmp_path)
    assert CALLS == [1, 2, 3, 3, 4]
    assert not list(tmp_path.glob(".*.pt"))
    assert run(jobs[::-1], "table", folder=tmp_path) == results[::-1]
    assert len(CALLS) == 5
    assert results[1] == {"rows": [{"k": 0, "square": 0.0}, {"k": 1, "square": 0.333333}]}
    table = frame(read("table", job, tmp_path), "rows")
    assert table.groupby("n")["square"].max().to_dict() == {1: 0, 2: 0.333333, 3: 1.33333, 4: 3}


@dataclass(frozen=True)
class Settings:
    rate: float = 0.1
    device: str = "cpu"


CHANGES = [("version", 2), ("settings", Settings(rate=0.2)), ("settings", (Settings(), "more"))]
CHANGES += [("data", ("drag",)), ("checkpoints", ("cnp_500",))]


@pytest.mark.parametrize(("named", "value"), CHANGES)
def test_what_was_made_of_something_else_is_refused_and_made_again(tmp_path, named, value):
    def before(n):
        return job(n, settings=Settings())

    def now(n):
        return replace(before(n), **{named: value})

    first = run([before(2)], "table", folder=tmp_path)
    with pytest.raises(ValueError, match=f"table: the result of {{'n': 2}} .* another {named}"):
        read("table", now, tmp_path)
    assert read("table", before, tmp_path)[0][1] == first[0]
    assert CALLS == [2]
    run([now(2)], "table", folder=tmp_path)
    run([before(2)], "table", folder=tmp_path)
    assert CALLS == [2, 2, 2]
    assert read("table", lambda n: job(n, settings=Settings(device="cuda")), tmp_path)


def test_damaged_results_are_named_and_none_are_no_results(tmp_path):
    run([job(2)], "table", tmp_path)
    path = tmp_path / "table.jsonl.gz"
    whole = path.read_bytes()
    flipped = bytes([*whole[:-9], whole[-9] ^ 1, *whole[-8:]])
    for content in (b"", whole[:-4], flipped, b"x" + whole[1:], gzip.compress(b"[1]")):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"table\.jsonl\.gz is damaged"):
            run([job(2)], "table", tmp_path)
        assert path.read_bytes() == content


@pytest.mark.slow
def test_workers_run_the_jobs_of_a_command(tmp_path):
    """The robot of the closed loop is kept from job to job, in a function of the command."""
    which = ["table=height", "world=perturbed", "index=0,1"]
    where = ["--raw", str(tmp_path), "--out", str(tmp_path), "--workers", "2"]
    command = [sys.executable, "-m", "experiments.closed_loop", "--only", *which, *where]
    subprocess.run(command, cwd=repo_root(), check=True, timeout=300)
    rows = read_results(tmp_path / "closed_loop.json")["tables"]["height"]
    assert rows[0]["n"] == 2


@pytest.mark.parametrize("name", TABLES)
def test_the_committed_tables_are_drawn_from_the_committed_results(tmp_path, name):
    module = importlib.import_module(f"experiments.{name}")
    made = read_results(write_results(tmp_path, name, {}, module.tables()))["tables"]
    committed = read_results(f"data/results/{name}.json")["tables"]
    if hasattr(module, "JOBS"):  # and these are the jobs of the command
        results = {runner._key(about) for about, _ in read(name, module.job)}
        assert {runner._key(one.arguments) for one in module.JOBS} <= results
    assert made.keys() == committed.keys()
    for table, rows in made.items():
        # The order of summation depends on the processor, so last digits differ from the table's.
        both = pd.DataFrame(rows), pd.DataFrame(committed[table])
        assert_frame_equal(*both, rtol=1e-9, atol=1e-15)
