"""Files of weights: tensors and a description of plain JSON values, with a hash of both.

Safetensors files, replaced atomically; reading one runs no code in it.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

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
        shipped = [p.stem for p in sorted(from_root("data/checkpoints").glob(f"*{SUFFIX}"))]
        shipped = [name for name in shipped if not name.startswith(others)]
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


def read_weights(path: str | Path, remedy: str) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Read what `write_weights` wrote; ValueError, which ends with the remedy, if it is damaged."""
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
        return tensors, json.loads(text)
    except KeyError as error:
        raise ValueError(f"{path} holds no weights with a description; {remedy}") from error
    except (SafetensorError, ValueError, TypeError, RecursionError) as error:
        raise ValueError(f"{path} is damaged, or holds no weights ({error}); {remedy}") from error
