"""Locations of files: the repository, its shipped data, and the folders that runs write to."""

import os
from pathlib import Path


def repo_root() -> Path:
    """Return the root folder of the checkout that contains the package.

    Raises FileNotFoundError if the package was installed apart from its checkout.
    """
    root = Path(__file__).resolve().parents[1]
    if not (root / "pyproject.toml").is_file():
        raise FileNotFoundError(
            f"affordlib is installed in {root}, apart from its notebooks and data; run "
            "`make setup` in the checkout, which installs it in place"
        )
    return root


def from_root(path: str | os.PathLike[str]) -> Path:
    """Return an absolute path; a relative one is resolved against the root of the repository."""
    path = Path(os.path.expanduser(path))
    return path if path.is_absolute() else repo_root() / path


def resolve_out_dir(out_dir: str | os.PathLike[str]) -> Path:
    """Return the folder for results, and create it if missing.

    A relative path starts at the repository. Raises NotADirectoryError if a file has that name.
    """
    if not isinstance(out_dir, str | os.PathLike) or not os.fspath(out_dir):
        raise ValueError(f"out_dir must name a folder, such as 'runs/lab', got {out_dir!r}")
    path = from_root(out_dir)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise NotADirectoryError(
            f"out_dir must be a folder, but {path} is, or lies under, a file; choose another"
        ) from None
    return path
