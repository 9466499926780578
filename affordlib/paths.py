"""Locations of files: a relative path starts at the repository, wherever a program runs."""

import os
from pathlib import Path


def repo_root() -> Path:
    """Return the root folder of the checkout; FileNotFoundError if the package is apart from it."""
    root = Path(__file__).resolve().parents[1]
    if not (root / "pyproject.toml").is_file():
        raise FileNotFoundError(
            f"affordlib is installed in {root}, apart from its notebooks and data; run "
            "`make setup` in the checkout, which installs it in place"
        )
    return root


def from_root(path: str | os.PathLike[str]) -> Path:
    """Return an absolute path; a relative one is resolved against the root of the repository."""
    path = Path(path).expanduser()
    return path if path.is_absolute() else repo_root() / path


def file_at(path: str | os.PathLike[str]) -> Path:
    """Return the absolute path of a file to read, resolved as in `from_root`.

    Raises FileNotFoundError unless it is a regular file: a pipe or a device might never end.
    """
    path = from_root(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}")
    return path


def resolve_out_dir(out_dir: str | os.PathLike[str]) -> Path:
    """Return the folder for results, resolved as in `from_root`; it is created if missing."""
    if not os.fspath(out_dir):
        raise ValueError("out_dir must name a folder, such as 'runs/lab', got ''")
    path = from_root(out_dir)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise NotADirectoryError(
            f"out_dir must be a folder, but {path} is, or lies under, a file; choose another"
        ) from None
    return path
