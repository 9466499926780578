"""`make setup` with a Python that only pretends to install, and `make workbook` on tiny books."""

import importlib.metadata
import json
import os
import re
import shutil
import signal
import sys
import tomllib
from types import SimpleNamespace

import nbformat
import psutil
import pytest
from packaging.specifiers import SpecifierSet
from pages import cleaned, parameters_of_pages

from affordlib.results import read_results, repo_root
from tests.waiting import start, wait_until

PRETENDED = """\
#!{python}
import pathlib, sys, time
here = pathlib.Path({here!r})
with open(here / "log", "a") as log:
    log.write(" ".join(sys.argv[1:{words}]) + "\\n")
if sys.argv[1] == "-c":
    print({version!r})
elif sys.argv[1:3] == ["-m", "venv"]:
    python = here / ".venv" / "bin" / "python"
    python.parent.mkdir(parents=True)  # fails where another one is at work
    time.sleep(0.3)
    python.write_text(pathlib.Path(__file__).read_text())
    python.chmod(0o755)
"""
ENVIRONMENT = {name: value for name, value in os.environ.items() if "MAKE" not in name}
ROOT, INSTALLED = repo_root(), ["-m pip", "-m pip"]
book = pytest.fixture(lambda tmp_path: Book(tmp_path))
pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
OPTIONS = "SEED=3", "ARGS=02_second.n=7"
RUN = "reader-seed3"


@pytest.fixture
def project(tmp_path):
    """A folder with the Makefile: `make()` returns whether it failed, its output and commands."""
    here, commands = tmp_path / "a project", tmp_path / "bin"  # with a blank in its name
    here.mkdir()
    commands.mkdir()
    shutil.copy(ROOT / "Makefile", here)
    for name in ("requirements.txt", "constraints.txt", "pyproject.toml"):
        (here / name).touch()

    def make(*options, version="3.11", copies=1, words=3):
        own, log = tmp_path / "python", here / "log"
        log.write_text("")
        text = PRETENDED.format(python=sys.executable, here=str(here), version=version, words=words)
        own.write_text(text)
        for path in (own, *commands.iterdir()):
            path.chmod(0o755)
        environment = ENVIRONMENT | {"PATH": f"{commands}:{os.environ['PATH']}"}
        command = ["make", f"PYTHON={own}", *(options or ["setup"])]
        started = [start(command, cwd=here, env=environment) for _ in range(copies)]
        said = [process.communicate(timeout=60)[0] for process in started]
        ran = [line for line in log.read_text().splitlines() if not line.startswith("-c")]
        return any(process.returncode for process in started), "".join(said), ran

    return SimpleNamespace(here=here, make=make, commands=commands)


def test_it_installs_once_even_when_two_begin_and_then_has_nothing_to_do(project):
    failed, said, ran = project.make(copies=2)
    assert (failed, ran) == (False, ["-m venv", *INSTALLED]), said
    failed, said, ran = project.make()
    assert (failed, ran) == (False, [])
    assert "The environment is ready" in said
    stamp = project.here / ".venv" / ".installed"
    os.utime(stamp, (stamp.stat().st_mtime - 5,) * 2)
    # Files of tomorrow, unpacked in another time zone, are of now: pip runs once.
    for name in ("requirements.txt", "Makefile"):
        os.utime(project.here / name, (stamp.stat().st_mtime + 80_000,) * 2)
    failed, said, ran = project.make()
    assert (failed, ran) == (False, INSTALLED), said  # into what is there
    assert project.make()[::2] == (False, [])
    assert "skew" not in said


def test_what_a_link_leads_to_is_not_emptied(project):
    other = project.here.parent / "other"
    other.mkdir()
    (other / "kept").touch()
    (project.here / ".venv").symlink_to(other)
    failed, said, ran = project.make()
    assert (failed, ran) == (True, [])
    assert "'.venv' is a link to" in said
    assert (other / "kept").exists()


def test_another_python_or_system_is_refused(project):
    for system, version, why in (
        ("Linux x86_64", "3.9", "needs Python 3.11, as PyBullet has no wheel for a"),
        ("Linux aarch64", "3.11", "needs Linux on x86-64: PyBullet has no wheel for Linux aarch64"),
    ):
        (project.commands / "uname").write_text(f"#!/bin/sh\necho {system}\n")
        failed, said, ran = project.make(version=version)
        assert (failed, ran) == (True, [])
        assert why in said
        assert project.make("PYTHON=/bin/false", "setup")[::2] == (True, [])


def test_options_are_words_and_zero_means_no(project):
    project.make()
    for text in ('2"; touch here; "', "$$(touch here)", "x; touch here"):
        for options in (("test-fast", f"JOBS={text}"), ("checkpoints", f"ONLY={text}")):
            _, said, ran = project.make(*options)
            assert len(ran) == 1, said
    assert not (project.here / "here").exists()
    shutil.rmtree(project.here / ".venv")
    assert "pusht" not in " ".join(project.make("PUSHT=0", "setup", words=9)[2])
    shutil.rmtree(project.here / ".venv")
    assert "--extra-index-url here" in " ".join(project.make("INDEX=here", "setup", words=9)[2])


def test_all_packages_install_on_the_oldest_python_that_is_promised():
    oldest = "3.11.2"  # of Debian 12, as README says
    assert oldest in (ROOT / "README.md").read_text("utf-8")
    for package in importlib.metadata.distributions():
        wanted = package.metadata.get("Requires-Python") or ""
        assert SpecifierSet(wanted).contains(oldest), f"{package.name} needs Python {wanted}"


def test_uv_reads_the_same_constraints():
    lines = (ROOT / "constraints.txt").read_text("utf-8").splitlines()
    held = [line for line in lines if line and not line.startswith("#")]
    uv = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["uv"]
    assert uv["constraint-dependencies"] == held, "run `make constraints`"


PARAMETERS = "seed: int = 0  # of all\nout_dir: str = 'runs/lab'  # for results\nn: int = 2  # a\n"
# A page of these books writes its results by hand, to spare the import of pandas.
WRITE = """\
import json, os, pathlib, sys
folder = pathlib.Path("..", out_dir)
folder.mkdir(parents=True, exist_ok=True)
with (folder / "log.txt").open("a") as log:
    log.write("{name}\\n")
parameters = dict(n=n, seed=seed, python=sys.executable, cwd=os.getcwd())
parameters["backend"] = os.environ["MPLBACKEND"]
document = dict(notebook="{name}", parameters=parameters, versions={{}}, tables={{}})
(folder / "{name}.json").write_text(json.dumps(document))
print(n / 2)"""


class Book:
    """A small workbook with an environment that is this one, in a folder with a blank."""

    def __init__(self, root):
        self.root = root / "a bücher"
        for folder in ("notebooks/profiles", "notebooks/exercises", "affordlib", "data/results"):
            (self.root / folder).mkdir(parents=True)
        for name in ("Makefile", "notebooks/run.py", "notebooks/pages.py"):
            shutil.copy(ROOT / name, self.root / name)
        for name in ("requirements.txt", "constraints.txt", "pyproject.toml"):
            (self.root / name).touch()
        (self.root / "notebooks/profiles/reader.yaml").write_text("{}")
        python = self.root / ".venv" / "bin" / "python"
        python.parent.mkdir(parents=True)
        python.write_text(f'#!/bin/sh\nPYTHONPATH="{ROOT}" exec "{sys.executable}" "$@"\n')
        python.chmod(0o755)
        (self.root / ".venv" / ".installed").write_text(str(self.root))
        self.runs = self.root / "runs"

    def add(self, name, *code):
        new = nbformat.v4
        parameters = new.new_code_cell(PARAMETERS, metadata={"tags": ["parameters"]})
        cells = [new.new_markdown_cell(f"# {name}"), parameters]
        cells += [new.new_code_cell(source) for source in (*code, WRITE.format(name=name))]
        for number, cell in enumerate(cells):
            cell.id = f"cell-{number}"
        self.path(name).write_text(cleaned(new.new_notebook(cells=cells)))

    def path(self, name):
        return self.root / "notebooks" / f"{name}.ipynb"

    def start(self, *options, target="workbook", **environment):
        return start(["make", target, *options], cwd=self.root, env=ENVIRONMENT | environment)

    def make(self, *options, **more):
        process = self.start(*options, **more)
        said = process.communicate(timeout=300)[0]
        return process.returncode, said

    def log(self, run="reader"):
        path = self.runs / run / "log.txt"
        return path.read_text().split() if path.exists() else []

    def processes(self):
        """Processes that work here: make, scripts and kernels."""
        here = str(self.root)
        return [p for p in psutil.process_iter(["cwd"]) if (p.info["cwd"] or "").startswith(here)]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A book of two pages, run once, on a machine where another kernel has our name."""
    book = Book(tmp_path_factory.mktemp("finished"))
    book.add("01_first")
    book.add("02_second")
    kernel = book.root / "jupyter" / "kernels" / "python3"
    kernel.mkdir(parents=True)
    wrong = {"argv": ["/bin/false"], "display_name": "wrong", "language": "python"}
    (kernel / "kernel.json").write_text(json.dumps(wrong))
    more = {"JUPYTER_PATH": str(book.root / "jupyter"), "PYTHONIOENCODING": "ascii", "LC_ALL": "C"}
    return book, book.make(*OPTIONS, HOME="/nowhere", **more)


def test_a_run_leaves_copies_and_results_with_their_parameters(finished):
    book, (code, said) = finished
    assert code == 0, said
    assert re.search(r"01_first …(?s:.*)01_first: \d+\.\d s", said)
    run = book.runs / RUN
    files = {f"{name}.{end}" for name in ("01_first", "02_second") for end in ("ipynb", "json")}
    assert {path.name for path in run.iterdir()} == {*files, ".lock", "log.txt"}
    copy = nbformat.read(run / "02_second.ipynb", as_version=4)
    assert "3.5\n" in [output.get("text") for output in copy.cells[-1].outputs]  # 7 / 2
    assert copy.metadata.papermill.output_path == f"runs/{RUN}/02_second.ipynb"
    found = [read_results(run / f"{n}.json")["parameters"] for n in ("01_first", "02_second")]
    assert [(t["n"], t["seed"]) for t in found] == [(2, 3), (7, 3)]
    # The kernel is this interpreter, in the notebooks' folder, whatever is registered.
    assert found[0]["python"] == sys.executable
    assert os.path.samefile(found[0]["cwd"], book.root / "notebooks")
    assert found[0]["backend"].endswith("inline")


def test_a_rerun_does_what_a_change_makes_necessary(finished, tmp_path):
    book, _ = finished
    shutil.copytree(book.root, tmp_path / "backup")
    for change, first, second in (
        (lambda book, run: None, False, False),
        (lambda book, run: book.path("02_second").touch(), False, True),
        (lambda book, run: (book.root / "affordlib" / "model.py").touch(), True, True),
        (lambda book, run: (book.root / "data/results/01_first.json").touch(), False, False),
        (lambda book, run: (book.root / "data/results/planning.json").touch(), True, True),
        (lambda book, run: (run / "01_first.json").unlink(), True, False),
        (lambda book, run: (run / "01_first.ipynb").write_text("["), True, False),
        (("SEED=3", "OUT=" + RUN), False, True),
        ((*OPTIONS, "FORCE=1", "ONLY=02"), False, True),
        ((*OPTIONS, "FORCE=0"), False, False),
    ):
        options = change if isinstance(change, tuple) else OPTIONS
        if callable(change):
            change(book, book.runs / RUN)
        said = book.make(*options, "DRY_RUN=1")[1]
        shutil.rmtree(book.root)
        shutil.copytree(tmp_path / "backup", book.root)
        found = [f"run.py notebooks/{name}.ipynb" in said for name in ("01_first", "02_second")]
        assert found == [first, second], said


@pytest.mark.slow
@pytest.mark.parametrize(
    ("code", "error"),
    [
        ("# divide\nn / 0", "in cell 4, which begins `# divide`.*ZeroDivisionError: division by"),
        ("import ctypes\nctypes.string_at(0)", "in cell 4.*DeadKernelError: Kernel died"),
    ],
)
def test_a_failing_page_stops_the_batch_and_a_rerun_goes_on(book, code, error):
    book.add("01_first")
    book.add("02_second", "fine = 1", code)
    book.add("03_third")
    status, said = book.make("WORKERS=1")
    assert status == 2
    assert re.search(rf"(?s)02_second failed.*{error}", said), said
    copy = nbformat.read(book.runs / "reader" / "02_second.failed.ipynb", as_version=4)
    assert code in [cell.source for cell in copy.cells]
    before = book.log()
    assert before[0] == "01_first"
    book.add("02_second", "fine = 1")
    status, said = book.make()
    assert status == 0, said
    assert sorted(book.log()) == [*before, "02_second", "03_third"]
    assert not list(book.runs.rglob("*failed*"))


@pytest.mark.slow
def test_two_pages_run_side_by_side_and_another_make_waits_outside(book):
    names = "01_first", "02_second"
    for mine, other in (names, names[::-1]):  # each waits for the other to begin
        touch = f"import pathlib, time\npathlib.Path({mine!r}).touch()"
        wait = f"while not (pathlib.Path({other!r}).exists() and pathlib.Path('go').exists()):\n"
        book.add(mine, touch, wait + "    time.sleep(0.05)")
    process = book.start()
    begun = [book.root / "notebooks" / name for name in names]
    wait_until(lambda: all(path.exists() for path in begun), process=process)
    status, said = book.make()
    assert (status, "Another run is writing to runs/reader" in said) == (2, True), said
    assert book.make("OUT=other", "DRY_RUN=1")[0] == 0
    (book.root / "notebooks" / "go").touch()
    said = process.communicate(timeout=100)[0]
    assert process.returncode == 0, said
    assert sorted(book.log()) == [*names]


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT, signal.SIGTERM])
def test_whatever_stops_make_leaves_no_process_and_is_taken_up_again(book, how):
    child = "import subprocess, time\nsubprocess.Popen(['sleep', '600'])\ntime.sleep(1)"
    book.add("01_first")
    book.add("02_second", child)
    for started in (book.processes, lambda: [*book.runs.rglob("*failed*")]):
        process = book.start()
        wait_until(started)
        if how == signal.SIGINT:  # Ctrl-C reaches all that the terminal has started
            os.killpg(process.pid, how)
        else:
            process.send_signal(how)
        wait_until(lambda: not book.processes(), seconds=5, otherwise="a process is left")
        process.communicate(timeout=10)
    assert not list(book.runs.rglob("*failed*"))
    status, said = book.make()
    assert status == 0, said
    for name in ("01_first", "02_second"):
        assert read_results(book.runs / "reader" / f"{name}.json")["parameters"]["n"] == 2


@pytest.mark.slow
def test_a_signal_while_a_kernel_starts_leaves_no_process(book):
    book.add("01_first")
    run = book.root / "notebooks" / "run.py"
    begin = "await super().start_kernel(stdout=printed, stderr=printed, **options)"
    run.write_text(run.read_text().replace(begin, f"{begin}; os.kill(os.getpid(), 2)"))
    assert "01_first: interrupted" in book.make()[1]
    wait_until(lambda: not book.processes(), seconds=0.5, otherwise="the kernel is left")


@pytest.mark.slow
def test_in_place_puts_clean_executed_pages_back(book):
    book.add("01_first")
    before = nbformat.read(book.path("01_first"), as_version=4)
    status, said = book.make(target="notebooks")
    assert status == 0, said
    text = book.path("01_first").read_text()
    after = nbformat.reads(text, as_version=4)
    assert [(c.id, c.source) for c in after.cells] == [(c.id, c.source) for c in before.cells]
    assert [c.metadata for c in after.cells] == [{}, {"tags": ["parameters"]}, {}]
    assert after.cells[-1].outputs == [{"output_type": "stream", "name": "stdout", "text": "1.0\n"}]
    assert [c.execution_count for c in after.cells[1:]] == [1, 2]
    assert after.metadata.keys() == {"kernelspec", "language_info"}
    assert "run.py" not in book.make("-n", target="notebooks")[1]
    book.path("01_first").write_text(cleaned(before))  # outputs lost by hand
    assert "run.py" in book.make("-n", target="notebooks")[1]


def test_an_html_book_that_cannot_be_written_leaves_the_old_one(book):
    old = book.runs / "html" / "index.html"
    old.parent.mkdir(parents=True)
    old.touch()
    assert book.make("PY=false", target="html")[0]
    assert old.exists()


def test_what_does_not_fit_is_refused():
    reader = {"PROFILE": "reader", "SEED": "0", "OUT": "", "ONLY": "", "ARGS": ""}
    for wrong, named in (
        ({"ARGS": "06_plannin.n_goals=1"}, "'06_plannin' .* did you mean 06_planning"),
        ({"ARGS": "06.n_gaols=1"}, "'n_gaols' .* mean n_goals"),
        ({"ARGS": "06.n_goals=1.5"}, "06_planning.n_goals must be int, got 1.5"),
        ({"ARGS": f"06.n_goals={'1' * 5000}"}, r"06_planning.n_goals must be int, got '1{50,60}$"),
        ({"ARGS": f"06.modes={'[' * 100_000}"}, r"06_planning.modes must be list\[str\], got '\["),
        ({"ARGS": "00.goal_x_m=near"}, "00_start_here.goal_x_m must be float, got 'near'"),
        ({"ARGS": "06.out_dir=x"}, "'out_dir' is unknown"),
        ({"PROFILE": "raeder"}, "'raeder' is unknown; did you mean reader"),
        ({"SEED": "-1"}, "SEED .* '-1'"),
        ({"OUT": "lab"}, "neither lab nor html"),
    ):
        with pytest.raises(ValueError, match=named):
            parameters_of_pages(reader | wrong)


def test_hostile_words_on_the_command_line_are_only_words(book):
    book.add("01_first")
    for option in ("ONLY", "PROFILE", "SEED", "OUT", "ARGS", "WORKERS"):
        for text in ("x; touch here", "$$(touch here)", '"; touch here; "'):
            status, said = book.make(f"{option}={text}", "DRY_RUN=1")
            assert status == 2, said
    assert not (book.root / "here").exists()
    assert not book.runs.exists()
