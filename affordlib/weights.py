"""Files of weights: tensors and a description of plain JSON values, with a hash of both.

Safetensors files, replaced atomically; reading one runs no code in it.
"""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save
from torch import nn

from affordlib.results import file_at, from_root, write_atomically

SUFFIX = ".safetensors"
_KEY = "affordlib"


def resolve_checkpoint(name_or_path: str | Path) -> Path:
    """Return the file of a shipped checkpoint's name or of a path; FileNotFoundError if none."""
    path = Path(name_or_path)
    path = path if path.suffix == SUFFIX else Path(f"data/checkpoints/{name_or_path}{SUFFIX}")
    try:
        return file_at(path)
    except FileNotFoundError as error:
        others = ("np_", "reachability")  # these have their own load functions
        files = from_root("data/checkpoints").glob(f"*{SUFFIX}")
        shipped = sorted(path.stem for path in files if not path.stem.startswith(others))
        raise FileNotFoundError(
            f"checkpoint {str(name_or_path)!r}: {error}; give one of the shipped names {shipped} "
            f"or the path of a {SUFFIX} file"
        ) from None


def weights_sha256(tensors: dict[str, torch.Tensor], text: str) -> str:
    """SHA-256 hash of weights and description."""
    return hashlib.sha256(save(tensors) + text.encode()).hexdigest()


def write_weights(
    path: str | Path, tensors: dict[str, torch.Tensor], description: dict[str, Any]
) -> Path:
    """Write tensors and a description of plain JSON values as one file; returns its path."""
    tensors = {name: value.contiguous() for name, value in tensors.items()}
    text = json.dumps(description, allow_nan=False)
    content = json.dumps({"sha256": weights_sha256(tensors, text), "description": text})
    path = from_root(path)
    write_atomically(path, save(tensors, {_KEY: content}), mark=f'"{_KEY}"'.encode())
    return path


def read_weights(
    path: str | Path, remedy: str, make: Callable[[dict, dict], Any] = lambda *both: both
) -> Any:
    """Return what `make` makes of a file's tensors and description; ValueError if it cannot."""
    path = file_at(path)
    try:
        with safe_open(path, "pt") as file:
            content = json.loads((file.metadata() or {})[_KEY])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        text = content["description"]
        if content["sha256"] != weights_sha256(tensors, text):
            raise ValueError("its hash differs: the file was changed after it was written")
        for name, value in tensors.items():
            if value.is_floating_point() and not value.isfinite().all():
                raise ValueError(f"{name} holds numbers that are not finite")
        return make(tensors, json.loads(text))
    except Exception as error:
        raise ValueError(f"{path} is damaged or unfit ({error!r:.300}); {remedy}") from error


def restored(
    path: str | Path, remedy: str, make: Callable[[dict[str, Any]], nn.Module]
) -> tuple[Any, dict[str, Any]]:
    """Load a file, as `read_weights`, into the module that `make` creates of its description."""

    def filled(tensors, description):
        model = make(description)
        own = model.state_dict()
        if other := [k for k in own if k not in tensors or tensors[k].dtype != own[k].dtype]:
            raise ValueError(f"{other[0]} is missing or has another type")
        model.load_state_dict(tensors, assign=next(iter(own.values())).is_meta)
        return model.eval(), description

    return read_weights(path, remedy, filled)
