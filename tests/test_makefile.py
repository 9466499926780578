"""`make setup` with a Python that only pretends to install: when it creates .venv, and when not."""

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
INSTALLED = ["-m pip", "-m pip"]
pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")


@pytest.fixture
def project(tmp_path):
    """A folder with the Makefile: `setup()` runs make; returns status, output and commands."""
    here = tmp_path / "a project"  # with a blank in its name
    here.mkdir()
    shutil.copy(repo_root() / "Makefile", here)
    for name in ("requirements.txt", "constraints.txt", "pyproject.toml"):
        (here / name).touch()

    def setup(version="3.11", python=None, copies=1):
        own = tmp_path / "python"
        own.write_text(PRETENDED.format(python=sys.executable, here=str(here), version=version))
        own.chmod(0o755)
        environment = {name: value for name, value in os.environ.items() if "MAKE" not in name}
        started = [
            subprocess.Popen(
                ["make", "setup", f"PYTHON={python or own}"],
                cwd=here,
                env=environment,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
            )
            for _ in range(copies)
        ]
        said = [process.communicate(timeout=60)[0] for process in started]
        log = here / "log"
        ran = log.read_text().splitlines() if log.exists() else []
        log.unlink(missing_ok=True)
        ran = [line for line in ran if not line.startswith("-c")]
        return any(process.returncode for process in started), "".join(said), ran

    return SimpleNamespace(here=here, setup=setup)


def test_it_installs_once_even_when_two_begin_and_then_has_nothing_to_do(project):
    failed, said, ran = project.setup(copies=2)
    assert (failed, ran) == (False, ["-m venv", *INSTALLED]), said
    failed, said, ran = project.setup()
    assert (failed, ran) == (False, [])
    assert "The environment is ready" in said
    later = (project.here / ".venv" / ".installed").stat().st_mtime + 5
    os.utime(project.here / "requirements.txt", (later, later))
    failed, said, ran = project.setup()
    assert (failed, ran) == (False, INSTALLED), said  # into what is there


def test_an_installation_that_failed_is_made_anew(project):
    (project.here / "no_network").touch()
    failed, said, _ = project.setup()
    assert failed
    assert "no network" in said
    (project.here / "no_network").unlink()
    shutil.rmtree(project.here / ".venv")  # as `venv --clear` does
    assert project.setup()[::2] == (False, ["-m venv", *INSTALLED])


def test_what_a_link_leads_to_is_not_emptied(project):
    other = project.here.parent / "other"
    other.mkdir()
    (other / "kept").touch()
    (project.here / ".venv").symlink_to(other)
    failed, said, ran = project.setup()
    assert (failed, ran) == (True, [])
    assert "'.venv' is a link to" in said
    assert (other / "kept").exists()


@pytest.mark.parametrize(
    ("options", "why"),
    [({"python": "/bin/false"}, "'/bin/false' is no Python"), ({"version": "3.9"}, "Python 3.11")],
)
def test_what_is_no_python_or_another_is_refused(project, options, why):
    failed, said, ran = project.setup(**options)
    assert (failed, ran) == (True, [])
    assert "This workbook needs Python 3.11" in said
    assert why in said
