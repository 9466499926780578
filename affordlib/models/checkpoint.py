"""Checkpoints: weights as safetensors, everything else as JSON beside them; never pickle."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from affordlib.interactions.batches import Normaliser
from affordlib.models.anchored import AnchoredConfig, AnchoredNetwork
from affordlib.models.attention import AttentionConfig, AttentiveCNP
from affordlib.models.cnp import AffordanceCNP, CNPConfig
from affordlib.models.film import FiLMConfig, FiLMNetwork
from affordlib.models.lstm import LSTMConfig, LSTMNetwork
from affordlib.models.network import EffectNetwork, NetworkConfig
from affordlib.paths import repo_root

FORMAT = "affordlib checkpoint 1"
SUFFIX = ".safetensors"
NETWORKS: dict[str, tuple[type[EffectNetwork], type[NetworkConfig]]] = {
    "cnp": (AffordanceCNP, CNPConfig),
    "film": (FiLMNetwork, FiLMConfig),
    "attention": (AttentiveCNP, AttentionConfig),
    "anchored": (AnchoredNetwork, AnchoredConfig),
    "lstm": (LSTMNetwork, LSTMConfig),
}


def build(config: NetworkConfig, normaliser: Normaliser) -> EffectNetwork:
    """An untrained network of the architecture that the configuration belongs to."""
    for network, config_class in NETWORKS.values():
        if type(config) is config_class:
            return network(config, normaliser)
    known = [config_class.__name__ for _, config_class in NETWORKS.values()]
    raise TypeError(f"config must be one of {known}, got {config!r}")


def save_checkpoint(model: EffectNetwork, path: str | Path, about: dict[str, Any]) -> Path:
    """Write `path` (ending in .safetensors) and the JSON beside it; returns the path.

    about: what the reader of the checkpoint should know, such as the data set and the interactions
    that the model was trained on; plain JSON values.
    """
    path = Path(path)
    if path.suffix != SUFFIX:
        raise ValueError(f"path must end in {SUFFIX!r}, got {str(path)!r}")
    kind = next((name for name, (network, _) in NETWORKS.items() if network is type(model)), None)
    if kind is None:
        raise TypeError(f"model must be one of {list(NETWORKS)}, got a {type(model).__name__}")
    description = {
        "format": FORMAT,
        "model": kind,
        "config": asdict(model.config)
        | {"sigma_floor": model.sigma_floor, "temperature": model.temperature},
        "normaliser": asdict(model.normaliser),
        "about": about,
    }
    text = json.dumps(description, indent=1, allow_nan=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder:
        weights, sidecar = Path(folder) / "weights", Path(folder) / "json"
        tensors = {name: value.contiguous() for name, value in model.state_dict().items()}
        save_file(tensors, weights)
        weights.chmod(0o644)
        sidecar.write_text(text + "\n")
        os.replace(sidecar, path.with_suffix(".json"))
        os.replace(weights, path)
    return path


def resolve_checkpoint(name_or_path: str | Path) -> Path:
    """The weights' file of a shipped checkpoint's name, or of a path; raises when there is none."""
    path = Path(name_or_path)
    folder = repo_root() / "data" / "checkpoints"
    if path.suffix != SUFFIX:
        path = folder / f"{name_or_path}{SUFFIX}"
    for file in (path, path.with_suffix(".json")):
        if not file.is_file():
            shipped = sorted(p.stem for p in folder.glob("*.json"))
            raise FileNotFoundError(
                f"checkpoint {str(name_or_path)!r}: there is no file {file}; give one of the "
                f"shipped names {shipped} or the path of a {SUFFIX} file with its .json beside it"
            )
    return path


def checkpoint_sha256(name_or_path: str | Path) -> str:
    """Hash of all that decides a checkpoint's answers: weights, configuration and scales."""
    path = resolve_checkpoint(name_or_path)
    told = json.loads(path.with_suffix(".json").read_text())
    decisive = json.dumps({key: told[key] for key in ("model", "config", "normaliser")})
    return hashlib.sha256(path.read_bytes() + decisive.encode()).hexdigest()


def _with_tuples(fields: dict[str, Any]) -> dict[str, Any]:
    return {name: tuple(v) if isinstance(v, list) else v for name, v in fields.items()}


def load_checkpoint(name_or_path: str | Path) -> tuple[EffectNetwork, dict[str, Any]]:
    """A model, ready to predict, and what its checkpoint says about it.

    Raises FileNotFoundError, or ValueError when the files are damaged or of another model.
    """
    path = resolve_checkpoint(name_or_path)
    remedy = "give another checkpoint, or train it again with notebook 03"
    try:
        description = json.loads(path.with_suffix(".json").read_text())
        if description["format"] != FORMAT:
            raise ValueError(f"its format is {description['format']!r}, not {FORMAT!r}")
        kind, config_class = NETWORKS[description["model"]]
        model = kind(
            config_class(**_with_tuples(description["config"])),
            Normaliser(**_with_tuples(description["normaliser"])),
        )
        about = description["about"]
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"checkpoint {path.with_suffix('.json')} does not describe a model of this package "
            f"({error}); {remedy}"
        ) from error
    try:
        model.load_state_dict(load_file(path))
    except (RuntimeError, SafetensorError, OSError) as error:
        raise ValueError(
            f"checkpoint {path} does not hold the weights of the model that "
            f"{path.with_suffix('.json').name} describes; {remedy}"
        ) from error
    return model.eval(), about
