"""Checkpoints: weights, configuration and description of a model in one file (`weights.py`).

The state of a training that can be resumed is a PyTorch zip file, which is read without running any
code in it.
"""

import importlib
import io
import re
import zipfile
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from affordlib.interactions.dataset import Scaler
from affordlib.models.base import NETWORKS, EffectNetwork, NetworkConfig
from affordlib.models.domain import TrainingDomain
from affordlib.results import file_at, from_root, write_atomically
from affordlib.weights import SUFFIX, resolve_checkpoint, restored, write_weights

FORMAT = "affordlib checkpoint 4"
_REMEDY = "give another checkpoint, or train it again with notebook 03"
_MODULES = re.compile(r"(affordlib\.models|experiments)\.\w+")
"""Modules that a checkpoint may name: importing one registers its network."""


def build(
    config: NetworkConfig, scaler: Scaler, domain: TrainingDomain | None = None
) -> EffectNetwork:
    """Create an untrained network of the architecture that the configuration belongs to."""
    for made, config_class in NETWORKS.values():
        if type(config) is config_class:
            return made(config, scaler, domain)
    known = [config_class.__name__ for _, config_class in NETWORKS.values()]
    raise TypeError(f"config must be one of {known}, got {config!r}")


def save_checkpoint(model: EffectNetwork, path: str | Path, about: dict[str, Any]) -> Path:
    """Write a model to `path` (ending in .safetensors) atomically, and return the path.

    about: facts for users of the checkpoint, such as the data set and the interactions that the
    model was trained on; plain JSON values.
    """
    path = Path(path)
    if path.suffix != SUFFIX:
        raise ValueError(f"path must end in {SUFFIX!r}, got {str(path)!r}")
    kind = next((name for name, (made, _) in NETWORKS.items() if made is type(model)), None)
    if kind is None:
        raise TypeError(f"model must be one of {list(NETWORKS)}, got a {type(model).__name__}")
    names = {"name": path.stem, "module": type(model).__module__, "model": kind}
    parts = {part: asdict(getattr(model, part)) for part in ("config", "scaler", "domain")}
    description = {"format": FORMAT, **names, **parts, "about": about}
    return write_weights(path, model.state_dict(), description)


def load_checkpoint(name_or_path: str | Path) -> tuple[EffectNetwork, dict[str, Any]]:
    """Load a model, ready to predict, and the `about` of its checkpoint.

    Raises ValueError when the file is damaged, or is not the shipped checkpoint of its name.
    """
    path = resolve_checkpoint(name_or_path)

    def make(description):
        if description["format"] != FORMAT:
            raise ValueError(f"its format is {description['format']!r}, not {FORMAT!r}")
        if Path(name_or_path).suffix != SUFFIX and description["name"] != path.stem:
            raise ValueError(f"it is {description['name']!r}, renamed")
        dict(description["about"])  # raises where it is none
        if not _MODULES.fullmatch(description["module"]):
            raise ValueError(f"its network is in {description['module']!r:.80}")
        importlib.import_module(description["module"])
        kind, config_class = NETWORKS[description["model"]]
        parts = {"config": config_class, "scaler": Scaler, "domain": TrainingDomain}
        for name, part in parts.items():
            items = description[name].items()
            parts[name] = part(**{k: tuple(v) if isinstance(v, list) else v for k, v in items})
        return kind(**parts)

    model, description = restored(path, _REMEDY, make)
    return model, description["about"]


def save_state(path: str | Path, state: dict[str, Any]) -> None:
    """Write a training state, which `load_state` reads, to a file atomically."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    write_atomically(from_root(path), buffer.getvalue(), mark=b"/data.pkl")


def load_state(path: str | Path, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Load what `save_state` wrote; ValueError when the file is damaged or of another kind."""
    path, state = file_at(path), None
    with suppress(Exception), zipfile.ZipFile(path) as archive:
        state = archive.testzip() or torch.load(path, weights_only=True, map_location=device)
    if not isinstance(state, dict) or "about" not in state:
        raise ValueError(
            f"resume_checkpoint {str(path)!r} is damaged or holds no training state; delete it "
            "to start training again, or give another path"
        ) from None
    return state
