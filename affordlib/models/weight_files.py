"""Files of weights: safetensors with a description of the model, and a hash of both, inside.

One file is replaced in one step, so weights and description always belong together. The state of
a training that can be resumed is a zip of PyTorch's, read without running any code in it.
"""

from __future__ import annotations

import hashlib
import io
import json
import pickle
import zipfile
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from affordlib.results import write_atomically

_KEY = "affordlib"


def _sha256(tensors: dict[str, torch.Tensor], text: str) -> str:
    return hashlib.sha256(save(tensors) + text.encode()).hexdigest()


def write_weights(
    path: str | Path, tensors: dict[str, torch.Tensor], description: dict[str, Any]
) -> Path:
    """Write tensors and a description of plain JSON values as one file; returns its path.

    A file of weights that is there is replaced; for anything else, FileExistsError.
    """
    tensors = {name: value.contiguous() for name, value in tensors.items()}
    text = json.dumps(description, allow_nan=False)
    content = json.dumps({"sha256": _sha256(tensors, text), "description": text})
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, save(tensors, {_KEY: content}), mark=f'"{_KEY}"'.encode())
    return path


def read_weights(path: str | Path, remedy: str) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Tensors and description of a file that `write_weights` wrote.

    Raises FileNotFoundError, or ValueError with the file and the remedy when it is damaged, is no
    such file, or holds numbers that are not finite.
    """
    try:
        with safe_open(path, "pt") as file:
            content = json.loads((file.metadata() or {})[_KEY])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        text = content["description"]
        if content["sha256"] != _sha256(tensors, text):
            raise ValueError("its hash is another: it was changed after it was written")
        for name, value in tensors.items():
            if value.is_floating_point() and not value.isfinite().all():
                raise ValueError(f"{name} holds numbers that are not finite")
        return tensors, json.loads(text)
    except KeyError as error:
        raise ValueError(f"{path} is no file of weights with a description; {remedy}") from error
    except (SafetensorError, ValueError, TypeError, RecursionError) as error:
        raise ValueError(f"{path} is damaged, or no file of weights ({error}); {remedy}") from error


def weights_bytes(path: str | Path) -> bytes:
    """The weights of a file alone, as safetensors stores them without a description."""
    return save(read_weights(path, "write it again")[0])


def save_state(path: str | Path, state: dict[str, Any]) -> None:
    """Write the state of a training to a file that `load_state` reads, whole or not at all."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    write_atomically(Path(path), buffer.getvalue(), mark=b"/data.pkl")


def load_state(path: str | Path) -> dict[str, Any]:
    """The state that `save_state` wrote; raises ValueError when the file is damaged or foreign."""
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
        state = None if damaged else torch.load(path, weights_only=True, map_location="cpu")
    except (
        zipfile.BadZipFile,
        pickle.UnpicklingError,
        RuntimeError,
        EOFError,
        OSError,
        ValueError,
    ):
        state = None
    if not isinstance(state, dict) or "about" not in state:
        raise ValueError(
            f"checkpoint {path} is damaged, or not the state of a training; delete it to begin "
            "again, or give another path"
        ) from None
    return state
