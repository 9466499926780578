"""Checkpoints: weights, configuration and description of a model in one safetensors file.

Files are replaced atomically and hold a hash of weights and description. The state of a training
that can be resumed is a PyTorch zip file, which is read without running any code in it.
"""

import io
import json
import pickle
import zipfile
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import nn

from affordlib.interactions.dataset import Scaler
from affordlib.models.base import EffectNetwork, NetworkConfig
from affordlib.models.calibration import Novelty
from affordlib.models.cnp import AffordanceCNP, CNPConfig
from affordlib.models.domain import TrainingDomain
from affordlib.models.film import FiLMConfig, FiLMNetwork, LastPoseCNP, LastPoseConfig
from affordlib.models.lstm import LSTMConfig, LSTMNetwork
from affordlib.paths import file_at, from_root
from affordlib.results import write_atomically
from affordlib.weights import SUFFIX, read_weights, resolve_checkpoint, write_weights

FORMAT = "affordlib checkpoint 3"
NOVELTY = "novelty"
_REMEDY = "give another checkpoint, or train it again with notebook 03"
NETWORKS: dict[str, tuple[type[EffectNetwork], type[NetworkConfig]]] = {
    "cnp": (AffordanceCNP, CNPConfig),
    "film": (FiLMNetwork, FiLMConfig),
    "cnp_last_pose": (LastPoseCNP, LastPoseConfig),
    "lstm": (LSTMNetwork, LSTMConfig),
}
"""Network and configuration by the name that checkpoints store; other packages may add theirs."""


def build(
    config: NetworkConfig, scaler: Scaler, domain: TrainingDomain | None = None
) -> EffectNetwork:
    """Create an untrained network of the architecture that the configuration belongs to."""
    for network, config_class in NETWORKS.values():
        if type(config) is config_class:
            return network(config, scaler, domain)
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
    kind = next((name for name, (network, _) in NETWORKS.items() if network is type(model)), None)
    if kind is None:
        raise TypeError(f"model must be one of {list(NETWORKS)}, got a {type(model).__name__}")
    description = {
        "format": FORMAT,
        "model": kind,
        "config": asdict(model.config)
        | {"sigma_floor": model.sigma_floor, "sigma_scale": model.sigma_scale},
        "scaler": asdict(model.scaler),
        "domain": asdict(model.domain),
        "about": about,
    }
    known = {} if model.novelty is None else {NOVELTY: model.novelty.references}
    return write_weights(path, model.state_dict() | known, description)


def _with_tuples(fields: dict[str, Any]) -> dict[str, Any]:
    return {name: tuple(v) if isinstance(v, list) else v for name, v in fields.items()}


def load_checkpoint(name_or_path: str | Path) -> tuple[EffectNetwork, dict[str, Any]]:
    """Load a model, ready to predict, and the `about` of its checkpoint.

    Raises FileNotFoundError, or ValueError when the file is damaged or holds another model.
    """

    def make(description):
        if description["format"] != FORMAT:
            raise ValueError(f"its format is {description['format']!r}, not {FORMAT!r}")
        kind, config_class = NETWORKS[description["model"]]
        parts = {"config": config_class, "scaler": Scaler, "domain": TrainingDomain}
        return kind(*(part(**_with_tuples(description[name])) for name, part in parts.items()))

    path = resolve_checkpoint(name_or_path)
    model, description = restored(path, _REMEDY, make)
    about, words = description["about"], {*path.stem.split("_")}
    if not str(name_or_path).endswith(SUFFIX):  # such as film_500: network and size of the set
        n = str(json.loads(about["recipe"])["n_interactions"])
        if n not in words or not words & {*description["model"].split("_")}:
            raise ValueError(
                f"{path} holds a model {description['model']!r} trained on {n} interactions, "
                f"not what its name says; {_REMEDY}"
            )
    return model, about


def restored(
    path: Path, remedy: str, make: Callable[[dict[str, Any]], nn.Module]
) -> tuple[Any, dict[str, Any]]:
    """Load a file into the module that `make` creates from its description; return both.

    Raises FileNotFoundError, or ValueError when the file is damaged or of another kind.
    """
    tensors, description = read_weights(path, remedy)
    references = tensors.pop(NOVELTY, None)
    try:
        model = make(description)
        own = model.state_dict()
        if other := [k for k in own if k not in tensors or tensors[k].dtype != own[k].dtype]:
            raise ValueError(f"{other[0]} is missing or has another type")
        model.load_state_dict(tensors)
        model.novelty = None if references is None else Novelty(references)
    except (KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        raise ValueError(
            f"{path} does not describe a model of this package ({error}); {remedy}"
        ) from error
    return model.eval(), description


def save_state(path: str | Path, state: dict[str, Any]) -> None:
    """Write a training state, which `load_state` reads, to a file atomically."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    write_atomically(from_root(path), buffer.getvalue(), mark=b"/data.pkl")


def load_state(path: str | Path, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Load what `save_state` wrote; ValueError when the file is damaged or of another kind."""
    path = file_at(path)
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
        state = None if damaged else torch.load(path, weights_only=True, map_location=device)
    except (zipfile.BadZipFile, pickle.PickleError, RuntimeError, EOFError, OSError, ValueError):
        state = None
    if not isinstance(state, dict) or "about" not in state:
        raise ValueError(
            f"resume_checkpoint {str(path)!r} is damaged or holds no training state; delete it "
            "to start training again, or give another path"
        ) from None
    return state
