"""`make setup`, with a Python that only pretends to install: when it makes .venv, and when not."""

import os
import shutil
import subprocess
import sys
from types import SimpleNamespace

import pytest

from affordlib.paths import repo_root

PRETENDED = """\
#!{python}
import pathlib, sys, time
here = pathlib.Path({here!r})
with open(here / "log", "a") as log:
    log.write(" ".join(sys.argv[1:3]) + "\\n")
if sys.argv[1] == "-c":
    print({version!r})
elif sys.argv[1:3] == ["-m", "venv"]:
    python = here / ".venv" / "bin" / "python"
    python.parent.mkdir(parents=True)  # fails where another one is at work
    time.sleep(0.3)
    python.write_text(pathlib.Path(__file__).read_text())
    python.chmod(0o755)
elif (here / "no_network").exists():
    sys.exit("no network")
"""


@pytest.fixture
def project(tmp_path):
    """A folder with the Makefile, in which `setup(...)` starts make and `log()` tells what ran."""
    here = tmp_path / "a project"  # with a blank in its name
    here.mkdir()
    shutil.copy(repo_root() / "Makefile", here)
    for name in ("requirements.txt", "constraints.txt", "pyproject.toml"):
        (here / name).touch()

    def setup(version="3.11", python=tmp_path / "python"):
        if python == tmp_path / "python":
            code = PRETENDED.format(python=sys.executable, here=str(here), version=version)
            python.write_text(code)
            python.chmod(0o755)
        return subprocess.Popen(
            ["make", "setup", f"PYTHON={python}"],
            cwd=here,
            env={name: value for name, value in os.environ.items() if "MAKE" not in name},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def log():
        ran = (here / "log").read_text().splitlines() if (here / "log").exists() else []
        (here / "log").unlink(missing_ok=True)
        return [line for line in ran if not line.startswith("-c")]

    return SimpleNamespace(here=here, setup=setup, log=log)


def ended(process):
    said, _ = process.communicate(timeout=60)
    return process.returncode, said


INSTALLED = ["-m pip", "-m pip"]
pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")


def test_it_installs_once_and_then_has_nothing_to_do(project):
    code, said = ended(project.setup())
    assert code == 0, said
    assert "Making .venv" in said
    assert project.log() == ["-m venv", *INSTALLED]
    code, said = ended(project.setup())
    assert (code, project.log()) == (0, [])
    assert "The environment is ready" in said


def test_two_at_once_make_it_once(project):
    both = [project.setup(), project.setup()]
    for code, said in map(ended, both):
        assert code == 0, said
    assert project.log() == ["-m venv", *INSTALLED]


def test_an_installation_that_failed_is_made_anew(project):
    (project.here / "no_network").touch()
    code, said = ended(project.setup())
    assert code != 0
    assert "no network" in said
    project.log()
    (project.here / "no_network").unlink()
    shutil.rmtree(project.here / ".venv")  # as `venv --clear` does
    assert ended(project.setup())[0] == 0
    assert project.log() == ["-m venv", *INSTALLED]


def test_new_requirements_are_installed_into_what_is_there(project):
    ended(project.setup())
    project.log()
    later = (project.here / ".venv" / ".installed").stat().st_mtime + 5
    os.utime(project.here / "requirements.txt", (later, later))
    code, said = ended(project.setup())
    assert code == 0, said
    assert "Bringing .venv up to date" in said
    assert project.log() == INSTALLED


def test_what_a_link_leads_to_is_not_emptied(project):
    other = project.here.parent / "other"
    other.mkdir()
    (other / "kept").touch()
    (project.here / ".venv").symlink_to(other)
    code, said = ended(project.setup())
    assert code != 0
    assert "'.venv' is a link to" in said
    assert project.log() == []
    assert (other / "kept").exists()


def test_what_is_no_python_is_refused(project):
    code, said = ended(project.setup(python="/bin/false"))
    assert code != 0
    assert "needs Python 3.11, and '/bin/false' is no Python that runs here" in said


def test_another_python_is_refused_by_name(project):
    code, said = ended(project.setup(version="3.9"))
    assert code != 0
    assert "This workbook needs Python 3.11" in said
    assert project.log() == []
