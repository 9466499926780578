"""`make setup` with a Python that only pretends to install, and what the pinned packages need."""

import importlib.metadata
import os
import shutil
import sys
import tomllib
from types import SimpleNamespace

import pytest
from packaging.specifiers import SpecifierSet

from affordlib.results import repo_root
from tests.waiting import start

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
elif (here / "no_network").exists():
    print("The conflict is caused by: no network")
    sys.exit("no")
"""
INSTALLED = ["-m pip", "-m pip"]
pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")


@pytest.fixture
def project(tmp_path):
    """A folder with the Makefile: `make()` returns whether it failed, its output and commands."""
    here, commands = tmp_path / "a project", tmp_path / "bin"  # with a blank in its name
    here.mkdir()
    commands.mkdir()
    shutil.copy(repo_root() / "Makefile", here)
    for name in ("requirements.txt", "constraints.txt", "pyproject.toml"):
        (here / name).touch()

    def make(*options, version="3.11", copies=1, words=3):
        own = tmp_path / "python"
        text = PRETENDED.format(python=sys.executable, here=str(here), version=version, words=words)
        own.write_text(text)
        for path in (own, *commands.iterdir()):
            path.chmod(0o755)
        environment = {name: value for name, value in os.environ.items() if "MAKE" not in name}
        environment["PATH"] = f"{commands}:{environment['PATH']}"
        command = ["make", f"PYTHON={own}", *(options or ["setup"])]
        started = [start(command, cwd=here, env=environment) for _ in range(copies)]
        said = [process.communicate(timeout=60)[0] for process in started]
        log = here / "log"
        ran = log.read_text().splitlines() if log.exists() else []
        log.unlink(missing_ok=True)
        ran = [line for line in ran if not line.startswith("-c")]
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


@pytest.mark.parametrize(
    ("system", "options", "why"),
    [
        ("Linux x86_64", {"version": "3.9"}, "needs Python 3.11, as PyBullet has no wheel for a"),
        ("Linux aarch64", {}, "needs Linux on x86-64: PyBullet has no wheel for Linux aarch64"),
    ],
)
def test_another_python_or_system_is_refused(project, system, options, why):
    (project.commands / "uname").write_text(f"#!/bin/sh\necho {system}\n")
    failed, said, ran = project.make(**options)
    assert (failed, ran) == (True, [])
    assert why in said
    failed, said, ran = project.make("PYTHON=/bin/false", "setup")
    assert (failed, ran) == (True, [])


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
    assert oldest in (repo_root() / "README.md").read_text("utf-8")
    for package in importlib.metadata.distributions():
        wanted = package.metadata.get("Requires-Python") or ""
        assert SpecifierSet(wanted).contains(oldest), f"{package.name} needs Python {wanted}"


def test_uv_reads_the_same_constraints():
    lines = (repo_root() / "constraints.txt").read_text("utf-8").splitlines()
    held = [line for line in lines if line and not line.startswith("#")]
    uv = tomllib.loads((repo_root() / "pyproject.toml").read_text("utf-8"))["tool"]["uv"]
    assert uv["constraint-dependencies"] == held, "run `make constraints`"
