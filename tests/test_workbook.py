"""The batch runner on tiny books: what runs, what is skipped, what is refused, what survives."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from functools import partial

import nbformat
import psutil
import pytest
from filelock import FileLock

from affordlib.results import read_results
from affordlib.workbook import WorkbookError, cleaned, default_parameters, fitting, literal, main

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
    """A small workbook in a temporary folder, and how the tests look at it."""

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
    """A book of two notebooks, run once; on a machine where another kernel has our name."""
    root = tmp_path_factory.mktemp("finished")
    book = Book(root)
    book.add("01_first")
    book.add("02_second")
    kernel = root / "jupyter" / "kernels" / "python3"
    kernel.mkdir(parents=True)
    (kernel / "kernel.json").write_text(
        json.dumps({"argv": ["/bin/false"], "display_name": "wrong", "language": "python"})
    )
    environment = os.environ | {"JUPYTER_PATH": str(root / "jupyter"), "MPLBACKEND": "Agg"}
    command = book.command("--seed", "3", "02_second.n=7")
    done = subprocess.run(command, env=environment, capture_output=True, text=True, cwd=root)
    return book, done


def test_a_run_prints_one_line_a_notebook_and_leaves_copies_and_results(finished):
    book, done = finished
    assert (done.returncode, done.stderr) == (0, "")
    one, two = done.stdout.splitlines()
    assert re.fullmatch(r"\[1/2\] 01_first: \d+\.\d s", one)
    assert re.fullmatch(r"\[2/2\] 02_second: \d+\.\d s", two)
    run = book.runs / RUN
    names = {
        f"{name}.{ending}" for name in ("01_first", "02_second") for ending in ("ipynb", "json")
    }
    assert {path.name for path in run.iterdir()} == {*names, ".lock", "log.txt"}
    copy = nbformat.read(run / "02_second.ipynb", as_version=4)
    assert "3.5\n" in [output.get("text") for output in copy.cells[-1].outputs]  # 7 * 0.5
    assert not os.path.isabs(copy.metadata.papermill.output_path)


def test_parameters_reach_the_notebook_and_the_kernel_is_this_interpreter_in_its_folder(finished):
    book, _ = finished
    first, second = (
        read_results(book.runs / RUN / f"{name}.json")["parameters"]
        for name in ("01_first", "02_second")
    )
    assert (first["n"], first["rate"], first["seed"]) == (2, 0.5, 3)
    assert (second["n"], second["rate"], second["seed"]) == (7, 0.5, 3)
    assert first["python"] == sys.executable
    assert os.path.samefile(first["cwd"], book.root / "notebooks")
    assert first["backend"].endswith("inline")


@pytest.fixture
def changeable(finished, tmp_path):
    """The finished book, put back as it was after the test."""
    book, _ = finished
    shutil.copytree(book.root, tmp_path / "backup")
    yield book
    shutil.rmtree(book.root)
    shutil.copytree(tmp_path / "backup", book.root)


def edit(path):
    path.write_text(path.read_text() + " ")


def copy_of_results(book, name):
    """What is done with the results of a full run that are to be committed."""
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
        (lambda book, run: edit(book.root / "affordlib" / "model.py"), True, True),
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
        ("# divide\nn / 0", "ZeroDivisionError: division by zero"),
        (
            "# divide\nimport ctypes\nctypes.string_at(0)",
            "DeadKernelError: Kernel died",
        ),
    ],
)
def test_a_failing_notebook_stops_the_batch_and_a_rerun_goes_on(book, capsys, code, error):
    book.add("01_first")
    book.add("02_second", "fine = 1", code)
    book.add("03_third")
    assert book.run() == 1
    out, err = capsys.readouterr()
    assert "02_second failed in cell 4, which begins `# divide`" in err
    assert error in err
    assert "runs/reader/02_second.ipynb" in err
    assert out.splitlines()[-1] == "[2/3] 02_second: failed"
    copy = nbformat.read(book.runs / "reader" / "02_second.ipynb", as_version=4)
    assert code in [cell.source for cell in copy.cells]
    assert book.log() == ["01_first"]

    book.add("02_second", "fine = 1")
    assert book.run() == 0
    assert book.log() == ["01_first", "02_second", "03_third"]
    assert "[1/3] 01_first: skipped: complete" in capsys.readouterr().out


@pytest.mark.slow
def test_a_notebook_that_does_not_write_its_numbers_has_failed(book, capsys):
    book.add("01_first")
    assert book.run() == 0
    # The results of the earlier run must not pass for those of this one.
    book.path("01_first").write_text(
        book.path("01_first").read_text().replace("01_first.json", "x")
    )
    book.add("01_first", f"raise_not = {str(book.runs)!r}\nout_dir = raise_not + '/other'")
    assert book.run() == 1
    err = capsys.readouterr().err
    assert "01_first failed" in err
    assert "run the notebook that writes them" in err
    assert book.run("--dry-run") == 0
    assert "01_first: would run" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_a_killed_run_counts_as_nothing_and_is_taken_up_again(book, capsys, how):
    root = book.root
    wait = (
        "import os, pathlib, time\n"
        f"root = pathlib.Path({str(root)!r})\n"
        "(root / 'pid').write_text(str(os.getpid()))\n"
        "while not (root / 'go').exists():\n"
        "    time.sleep(0.05)"
    )
    book.add("01_first")
    book.add("02_second", wait)
    # A job in the background ignores SIGINT, and its children would, too.
    heed = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    process = subprocess.Popen(book.command(), stderr=subprocess.PIPE, text=True, preexec_fn=heed)
    try:
        deadline = time.monotonic() + 60
        while not (root / "pid").exists() or not (root / "pid").read_text():
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.05)
    finally:
        process.send_signal(how)
        _, err = process.communicate(timeout=60)
    if how == signal.SIGKILL:
        assert process.returncode == -how
    else:
        assert process.returncode == 128 + how
        assert err.strip() == (
            "workbook: interrupted; what is finished is kept, the same command goes on"
        )
    kernel = int((root / "pid").read_text())
    deadline = time.monotonic() + 20
    while psutil.pid_exists(kernel):
        assert time.monotonic() < deadline, "the kernel outlived its runner"
        time.sleep(0.05)

    (root / "go").touch()
    assert book.run() == 0
    assert book.log() == ["01_first", "02_second"]
    assert "[1/2] 01_first: skipped: complete" in capsys.readouterr().out


def test_a_file_where_a_folder_is_needed_is_named(book, capsys):
    book.add("01_first")
    book.runs.mkdir()
    (book.runs / "reader").touch()
    assert book.run() == 1
    assert re.search(
        r"out_dir must be a folder, but .*reader is.* a file; choose another",
        capsys.readouterr().err,
    )


def test_a_second_runner_is_refused(book, capsys):
    book.add("01_first")
    book.runs.joinpath("reader").mkdir(parents=True)
    with FileLock(book.runs / "reader" / ".lock"):
        assert book.run() == 1
        assert "another runner is writing" in capsys.readouterr().err
        assert book.run("--out", "other", "--dry-run") == 0
    assert book.log() == []
    assert book.run("--dry-run") == 0


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["02_secnod.n=1"], r"notebook '02_secnod' is unknown; did you mean 02_second"),
        (["02_second.m=1"], r"parameter of 02_second 'm' is unknown; .*\bn\b"),
        (["02_second.rates=1"], r"'rates' is unknown; did you mean rate\?"),
        (["02_second.n=-3"], r"02_second.n must be int from 0, .* got int -3"),
        (["02_second.rate=.nan"], r"02_second.rate must be float, finite, .* got float nan"),
        (["02_second.n=1.5"], r"02_second.n must be int from 0, like its default 2, got float 1.5"),
        (["02_second.n=true"], r"02_second.n must be int .* got bool True"),
        (["02_second.modes=full"], r"02_second.modes must be list"),
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
    ],
)
def test_what_is_unknown_or_does_not_fit_is_refused_before_anything_runs(
    book, capsys, arguments, named
):
    book.add("01_first")
    book.add("02_second")
    assert book.run(*arguments) == 1
    assert re.search(named, capsys.readouterr().err)
    assert not book.runs.exists()


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("02_second: {goals: 3}", r"reader.yaml: parameter of 02_second 'goals' is unknown"),
        ("03_third: {n: 1}", r"reader.yaml: notebook '03_third' is unknown"),
        ("02_second: {n: three}", r"02_second.n must be int .* got str 'three'"),
        ("[1, 2]", r"must map notebooks to their parameters"),
        ("02_second: {n: [}", r"must map notebooks to their parameters"),
    ],
)
def test_a_bad_profile_is_refused_before_anything_runs(book, capsys, text, named):
    book.add("01_first")
    book.add("02_second")
    book.profile("reader", text)
    assert book.run() == 1
    assert re.search(named, capsys.readouterr().err)
    assert not book.runs.exists()


@pytest.mark.slow
def test_in_place_puts_clean_executed_notebooks_back(book, capsys):
    book.add("01_first")
    book.add("02_second")
    before = nbformat.read(book.path("02_second"), as_version=4)
    assert book.run("--in-place") == 0
    after = nbformat.read(book.path("02_second"), as_version=4)
    assert [(c.id, c.source) for c in after.cells] == [(c.id, c.source) for c in before.cells]
    assert [c.metadata for c in after.cells] == [{}, {"tags": ["parameters"]}, {}]
    assert after.cells[-1].outputs == [{"output_type": "stream", "name": "stdout", "text": "1.0\n"}]
    assert [c.execution_count for c in after.cells[1:]] == [1, 2]
    assert after.metadata == {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    text = book.path("02_second").read_text()
    assert book.run("--in-place", "--force") == 0
    assert book.path("02_second").read_text() == text
    capsys.readouterr()
    assert book.run("--in-place", "--dry-run") == 0
    assert capsys.readouterr().out.count("skipped: complete") == 2
    book.path("02_second").write_text(cleaned(before))  # outputs lost by hand
    assert book.run("--in-place", "--dry-run") == 0
    assert "02_second: would run" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("value", "default", "expected"),
    [
        (1, 0.5, 1.0),
        (2, 3, 2),
        ([1], [0.5], [1.0]),
        ([], ["a"], []),
        ("x", None, "x"),
        (1, None, 1),
    ],
)
def test_values_take_the_type_of_their_default(value, default, expected):
    fitted = fitting("p", value, default)
    assert fitted == expected
    assert type(fitted) is type(expected)


@pytest.mark.parametrize(
    ("text", "default", "value"),
    [
        ("3", 1, 3),
        ("1e-3", 0.1, 0.001),
        ("true", False, True),
        ("12", "a", "12"),
        ("astar", "a", "astar"),
        ("[astar, gradient]", [], ["astar", "gradient"]),
        ('["astar"]', [], ["astar"]),
        ("null", None, None),
    ],
)
def test_the_command_line_needs_no_quotes(text, default, value):
    assert literal(text, default) == value


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
