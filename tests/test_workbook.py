"""The batch runner on tiny books: what is executed, skipped or refused, and what is kept."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from functools import partial

import nbformat
import psutil
import pytest
from filelock import FileLock

from affordlib.results import read_results, write_results
from affordlib.workbook import WorkbookError, cleaned, default_parameters, fitting, literal, main
from tests.waiting import wait_until

PARAMETERS = "seed = 0\nout_dir = {lab!r}\nn = 2\nrate = 0.5\nmodes = ['full']"
# A notebook of these books writes its results by hand, to spare the import of pandas.
WRITE = """\
import json, os, pathlib, sys
folder = pathlib.Path(out_dir)
folder.mkdir(parents=True, exist_ok=True)
with (folder / "log.txt").open("a") as log:
    log.write("{name}\\n")
parameters = dict(n=n, rate=rate, seed=seed, python=sys.executable, cwd=os.getcwd())
parameters["backend"] = os.environ["MPLBACKEND"]
document = dict(notebook="{name}", parameters=parameters, versions={{}}, tables={{}})
(folder / "{name}.json").write_text(json.dumps(document))
print(n * rate)"""


class Book:
    """A small workbook in a temporary folder, with the functions to inspect it."""

    def __init__(self, root):
        self.root, self.runs, self.data = root, root / "runs", root / "data"
        for folder in ("notebooks/profiles", "affordlib", "data"):
            (root / folder).mkdir(parents=True)
        (root / "affordlib" / "model.py").write_text("a = 1\n")
        (self.data / "push.bin").write_bytes(b"\1\2")
        self.profile("reader", "{}")

    def profile(self, name, text):
        (self.root / "notebooks" / "profiles" / f"{name}.yaml").write_text(text)

    def add(self, name, *code, text="Some words."):
        new = nbformat.v4
        parameters = new.new_code_cell(PARAMETERS.format(lab=str(self.runs / "lab")))
        parameters.metadata["tags"] = ["parameters"]
        cells = [new.new_markdown_cell(f"# {name}\n\n{text}"), parameters]
        cells += [new.new_code_cell(source) for source in (*code, WRITE.format(name=name))]
        for number, cell in enumerate(cells):
            cell.id = f"cell-{number}"
        self.path(name).write_text(cleaned(new.new_notebook(cells=cells)))

    def path(self, name):
        return self.root / "notebooks" / f"{name}.ipynb"

    def run(self, *arguments):
        return main([*map(str, arguments)], self.root)

    def log(self, run="reader"):
        path = self.runs / run / "log.txt"
        return path.read_text().split() if path.exists() else []

    def command(self, *arguments):
        code = (
            "import sys, pathlib; from affordlib.workbook import main; "
            f"sys.exit(main({[*arguments]!r}, pathlib.Path({str(self.root)!r})))"
        )
        return [sys.executable, "-c", code]


@pytest.fixture
def book(tmp_path):
    return Book(tmp_path)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A book of two notebooks, run once, on a machine where another kernel has our name."""
    root = tmp_path_factory.mktemp("finished")
    book = Book(root)
    book.add("01_first")
    book.add("02_second")
    kernel = root / "jupyter" / "kernels" / "python3"
    kernel.mkdir(parents=True)
    wrong = {"argv": ["/bin/false"], "display_name": "wrong", "language": "python"}
    (kernel / "kernel.json").write_text(json.dumps(wrong))
    environment = os.environ | {"JUPYTER_PATH": str(root / "jupyter"), "MPLBACKEND": "Agg"}
    command = book.command("--seed", "3", "02_second.n=7")
    return book, subprocess.run(
        command, env=environment, capture_output=True, text=True, cwd=root, check=False
    )


def test_a_run_leaves_copies_and_results_with_their_parameters(finished):
    book, done = finished
    assert (done.returncode, done.stderr) == (0, "")
    said = re.sub(r"\d+\.\d s", "1.0 s", done.stdout).splitlines()
    places = "[1/2] 01_first", "[2/2] 02_second"
    assert said == [f"{place}{end}" for place in places for end in (" …", ": 1.0 s")]
    run = book.runs / RUN
    files = {f"{name}.{end}" for name in ("01_first", "02_second") for end in ("ipynb", "json")}
    assert {path.name for path in run.iterdir()} == {*files, ".lock", "log.txt"}
    copy = nbformat.read(run / "02_second.ipynb", as_version=4)
    assert "3.5\n" in [output.get("text") for output in copy.cells[-1].outputs]  # 7 * 0.5
    assert not os.path.isabs(copy.metadata.papermill.output_path)
    told = [read_results(run / f"{n}.json")["parameters"] for n in ("01_first", "02_second")]
    assert [(t["n"], t["rate"], t["seed"]) for t in told] == [(2, 0.5, 3), (7, 0.5, 3)]
    # The kernel is this interpreter, in the notebooks' folder, whatever is registered.
    assert told[0]["python"] == sys.executable
    assert os.path.samefile(told[0]["cwd"], book.root / "notebooks")
    assert told[0]["backend"].endswith("inline")


@pytest.fixture
def changeable(finished, tmp_path):
    """The finished book, restored after the test."""
    book, _ = finished
    shutil.copytree(book.root, tmp_path / "backup")
    yield book
    shutil.rmtree(book.root)
    shutil.copytree(tmp_path / "backup", book.root)


def copy_of_results(book, name):
    """Copy the results of a full run, as for a commit."""
    (book.data / "results").mkdir()
    shutil.copy(book.runs / RUN / "01_first.json", book.data / "results" / name)


RUN = "reader-seed3"
DEEP = "[" * 100_000


@pytest.mark.parametrize(
    ("change", "first", "second"),
    [
        (lambda book, run: None, False, False),
        (lambda book, run: book.add("02_second", text="Other words."), False, True),
        (lambda book, run: book.add("01_first", "extra = 1"), True, True),
        (lambda book, run: (book.root / "affordlib" / "model.py").write_text("a = 2"), True, True),
        (lambda book, run: (book.data / "push.bin").write_bytes(b"\1\3"), True, True),
        (lambda book, run: copy_of_results(book, "01_first.json"), False, False),
        (lambda book, run: copy_of_results(book, "planning.json"), True, True),
        (lambda book, run: (run / "01_first.json").unlink(), True, False),
        (lambda book, run: (run / "02_second.json").write_text('{"note'), False, True),
        (lambda book, run: (run / "02_second.ipynb").unlink(), False, True),
        (lambda book, run: (run / "01_first.ipynb").write_text(DEEP), True, False),
        (lambda book, run: book.profile("reader", "02_second: {rate: 1}"), False, True),
        (lambda book, run: book.profile("reader", "01_first: {n: 3}"), True, True),
        (lambda book, run: book.profile("reader", "01_first: {n: 2, rate: 0.5}"), False, False),
    ],
)
def test_a_rerun_does_what_a_change_makes_necessary(changeable, capsys, change, first, second):
    change(changeable, changeable.runs / RUN)
    assert changeable.run("--seed", 3, "02_second.n=7", "--dry-run") == 0
    lines = capsys.readouterr().out.splitlines()
    assert ["would run" in line for line in lines] == [first, second]
    assert ["skipped: complete" in line for line in lines] == [not first, not second]
    assert changeable.log(RUN) == ["01_first", "02_second"]


def test_only_runs_what_is_asked_and_force_runs_it_again(changeable, capsys):
    assert changeable.run("--seed", 3, "02_second.n=7", "--only", "02", "--force") == 0
    assert changeable.log(RUN) == ["01_first", "02_second", "02_second"]
    assert changeable.run("--seed", 3, "02_second.n=7", "--dry-run") == 0
    assert capsys.readouterr().out.count("skipped: complete") == 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("code", "error"),
    [
        ("# divide\nn / 0", "in cell 4, which begins `# divide`.*ZeroDivisionError: division by"),
        ("import ctypes\nctypes.string_at(0)", "in cell 4.*DeadKernelError: Kernel died"),
        ("out_dir += '/other'", "run the notebook that writes them"),
    ],
)
def test_a_failing_notebook_stops_the_batch_and_a_rerun_goes_on(book, capsys, code, error):
    book.add("01_first")
    book.add("02_second", "fine = 1", code)
    book.add("03_third")
    write_results(book.runs / "reader", "02_second", {}, {})  # an earlier run's must not count
    assert book.run() == 1
    out, err = capsys.readouterr()
    assert re.search(rf"(?s)02_second failed.*{error}", err)
    assert out.splitlines()[-1] == "[2/3] 02_second: failed"
    copy = nbformat.read(book.runs / "reader" / "02_second.ipynb", as_version=4)
    assert code in [cell.source for cell in copy.cells]
    before = book.log()
    assert before[0] == "01_first"
    book.add("02_second", "fine = 1")
    assert book.run() == 0
    assert book.log() == [*before, "02_second", "03_third"]
    assert "[1/3] 01_first: skipped: complete" in capsys.readouterr().out


@pytest.mark.slow
def test_two_notebooks_run_side_by_side(book):
    names = "01_first", "02_second"
    for mine, other in (names, names[::-1]):  # each waits for the other to begin
        touch = f"import pathlib, time\npathlib.Path({str(book.root)!r}, {mine!r}).touch()"
        wait = f"while not pathlib.Path({str(book.root)!r}, {other!r}).exists(): time.sleep(0.05)"
        book.add(mine, touch, wait)
    book.add("03_third", "1 / 0")
    done = subprocess.run(book.command("--workers", "2"), capture_output=True, text=True)
    assert done.returncode == 1
    assert "[3/3] 03_third: failed" in done.stdout
    assert done.stderr.startswith("workbook: 03_third failed in cell 3")
    assert sorted(book.log()) == [*names]


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_a_killed_run_counts_as_nothing_and_is_taken_up_again(book, capsys, how, workers):
    pid, go = book.root / "pid", book.root / "go"
    wait = (
        "import os, pathlib, time\n"
        f"pathlib.Path({str(pid)!r}).write_text(str(os.getpid()))\n"
        f"while not pathlib.Path({str(go)!r}).exists():\n"
        "    time.sleep(0.05)"
    )
    book.add("01_first")
    book.add("02_second", wait)
    # A job in the background ignores SIGINT, and its children would, too.
    heed = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    command, first = book.command("--workers", str(workers)), book.runs / "reader/01_first.ipynb"
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, preexec_fn=heed)
    try:
        wait_until(lambda: pid.exists() and pid.read_text() and process.poll() is None)
        wait_until(lambda: first.exists() and '"complete"' in first.read_text())
    finally:
        process.send_signal(how)
        _, err = process.communicate(timeout=60)
    if how == signal.SIGKILL:
        assert process.returncode == -how
    else:
        assert process.returncode == 128 + how
        assert re.fullmatch("workbook: interrupted; .*run it again to continue", err.strip())
    wait_until(lambda: not psutil.pid_exists(int(pid.read_text())))  # no kernel outlives its runner
    go.touch()
    assert book.run() == 0
    assert book.log() == ["01_first", "02_second"]
    assert "[1/2] 01_first: skipped: complete" in capsys.readouterr().out


def test_a_second_runner_or_a_file_in_place_of_the_folder_is_refused(book, capsys):
    book.add("01_first")
    book.runs.joinpath("reader").mkdir(parents=True)
    with FileLock(book.runs / "reader" / ".lock"):
        assert book.run() == 1
        assert "another run is writing" in capsys.readouterr().err
        assert book.run("--out", "other", "--dry-run") == 0
    (book.runs / "mine").touch()
    assert book.run("--out", "mine") == 1
    assert "out_dir must be a folder" in capsys.readouterr().err
    assert book.log() == []


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["02_secnod.n=1"], r"notebook '02_secnod' is unknown; did you mean 02_second"),
        (["02_second.m=1"], r"parameter of 02_second 'm' is unknown; .*\bn\b"),
        (["02_second.n=0"], r"02_second.n must be int from 1, .* got int 0"),
        (["02_second.rate=.nan"], r"02_second.rate must be float, finite, .* got float nan"),
        (["02_second.n=1.5"], r"02_second.n must be int .* got float 1.5"),
        (["02_second.n=true"], r"02_second.n must be int .* got bool True"),
        ([f"02_second.n={'1' * 5000}"], r"02_second.n must be int .* got str '1{50,60}\n"),
        ([f"02_second.modes={DEEP}"], r"02_second.modes must be list, .* got str '\[{50,60}\n"),
        (["02_second.modes=[1]"], r"02_second.modes\[0\] must be str"),
        (["02_second.out_dir=x"], r"use --seed and --out"),
        (["n=1"], r"write it like 06_planning.n_goals=20"),
        (["--profile", "raeder"], r"profile 'raeder' is unknown; did you mean reader"),
        (["--only", "07"], r"notebook '07' is unknown"),
        (["--out", "../x"], r"must be a plain folder name"),
        (["--out", "lab"], r"neither lab nor html"),
        (["--in-place", "02_second.n=1"], r"takes the notebooks' own defaults"),
        ("02_second: {goals: 3}", r"reader.yaml: parameter of 02_second 'goals' is unknown"),
        ("03_third: {n: 1}", r"reader.yaml: notebook '03_third' is unknown"),
        ("02_second: {n: three}", r"02_second.n must be int .* got str 'three'"),
        ("[1, 2]", r"must map notebooks to their parameters"),
        ("02_second: {n: [}", r"must map notebooks to their parameters"),
    ],
)
def test_what_does_not_fit_is_refused_before_anything_runs(book, capsys, arguments, named):
    """Invalid values on the command line or in the profile."""
    book.add("01_first")
    book.add("02_second")
    if isinstance(arguments, str):
        book.profile("reader", arguments)
        arguments = ()
    assert book.run(*arguments) == 1
    assert re.search(named, capsys.readouterr().err)
    assert not book.runs.exists()


@pytest.mark.slow
def test_in_place_puts_clean_executed_notebooks_back(book, capsys):
    book.add("01_first")
    book.add("02_second")
    before = nbformat.read(book.path("02_second"), as_version=4)
    assert book.run("--in-place") == 0
    text = book.path("02_second").read_text()
    after = nbformat.reads(text, as_version=4)
    assert [(c.id, c.source) for c in after.cells] == [(c.id, c.source) for c in before.cells]
    assert [c.metadata for c in after.cells] == [{}, {"tags": ["parameters"]}, {}]
    assert after.cells[-1].outputs == [{"output_type": "stream", "name": "stdout", "text": "1.0\n"}]
    assert [c.execution_count for c in after.cells[1:]] == [1, 2]
    assert after.metadata.keys() == {"kernelspec", "language_info"}
    assert book.run("--in-place", "--force") == 0
    assert book.path("02_second").read_text() == text
    capsys.readouterr()
    assert book.run("--in-place", "--dry-run") == 0
    assert capsys.readouterr().out.count("skipped: complete") == 2
    book.path("02_second").write_text(cleaned(before))  # outputs lost by hand
    assert book.run("--in-place", "--dry-run") == 0
    assert "02_second: would run" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "default", "value"),
    [
        ("3", 1, 3),
        ("1", 0.5, 1.0),
        ("1e-3", 0.1, 0.001),
        ("true", False, True),
        ("12", "a", "12"),
        ("[1]", [0.5], [1.0]),
        ("[]", ["a"], []),
        ("[astar, gradient]", [], ["astar", "gradient"]),
        ("null", None, None),
        ("x", None, "x"),
    ],
)
def test_the_command_line_needs_no_quotes_and_values_take_their_defaults_type(text, default, value):
    fitted = fitting("p", literal(text, default), default)
    assert repr(fitted) == repr(value)


@pytest.mark.parametrize(
    ("source", "named"),
    [
        ("seed = 0\nout_dir = 'x'\nn = 2 * seed", "plain literals"),
        ("seed = 0\nimport os\nout_dir = 'x'", "plain literals"),
        ("seed = 0", "has no parameter 'out_dir'"),
    ],
)
def test_parameters_are_plain_literals(source, named):
    cell = nbformat.v4.new_code_cell(source, metadata={"tags": ["parameters"]})
    with pytest.raises(WorkbookError, match=named):
        default_parameters(nbformat.v4.new_notebook(cells=[cell]), "01_first")
