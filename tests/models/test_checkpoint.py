"""Checkpoints: they restore the same model or raise, and they record what a model has seen."""

import json
import math
import pickle

import numpy as np
import pytest
import torch
from safetensors.torch import save

from affordlib.interactions import split_interactions
from affordlib.models import load_checkpoint, save_checkpoint
from affordlib.models.evaluation import refuse_seen
from affordlib.planning.skills import Reachability
from affordlib.results import repo_root
from affordlib.weights import read_weights, write_weights
from experiments.runner import checkpoint_sha256
from tests.waiting import printed


def test_the_hash_is_of_all_that_decides_the_predictions(untrained, tmp_path):
    def sha256(about):
        return checkpoint_sha256(save_checkpoint(untrained, tmp_path / "m.safetensors", about))

    first = sha256({})
    assert sha256({"note": "another"}) == first
    untrained.sigma_scale.fill_(3.0)
    assert sha256({}) != first


def test_a_bad_checkpoint_is_named(untrained, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"'nobody'.*'cnp_500'"):
        load_checkpoint("nobody")
    path = save_checkpoint(untrained, tmp_path / "m.safetensors", {})
    whole = path.read_bytes()
    tensors, description = read_weights(path, "")

    def described(**changes):
        return write_weights(path, tensors, description | changes)

    half = {name: value.half() for name, value in tensors.items()}
    scaler = description["scaler"] | {"action_scale": [0.0, 1.0]}
    for spoil in (
        lambda: path.write_bytes(whole[: len(whole) // 2]),
        lambda: path.write_bytes(pickle.dumps({"weights": [1.0]})),
        lambda: path.write_bytes(save(tensors)),
        lambda: write_weights(path, {"a": torch.tensor([math.nan])}, description),
        lambda: write_weights(path, tensors, {"format": "something else"}),
        lambda: write_weights(path, half, description),
        lambda: described(scaler=scaler),
        lambda: described(config=description["config"] | {"sigma_floor": 0}),
    ):
        path.unlink()
        spoil()
        with pytest.raises(ValueError, match=r"(?s)m\.safetensors.*train it again"):
            load_checkpoint(path)


def test_a_shipped_network_from_elsewhere_loads_in_a_fresh_process():
    code = "from affordlib.models import load_checkpoint as load; print(*load('lstm_500')[1])"
    assert "seen_interactions" in printed(code, cwd=repo_root())


def test_a_renamed_checkpoint_is_refused(monkeypatch, tmp_path):
    (tmp_path / "data" / "checkpoints").mkdir(parents=True)
    names = [f"data/checkpoints/{name}.safetensors" for name in ("cnp_500", "film_500")]
    (tmp_path / names[1]).write_bytes((repo_root() / names[0]).read_bytes())
    monkeypatch.setattr("affordlib.results.repo_root", lambda: tmp_path)
    with pytest.raises(ValueError, match=r"film_500\.safetensors .*it is 'cnp_500', renamed"):
        load_checkpoint("film_500")
    load_checkpoint(tmp_path / names[1])  # a path may have any name


def test_no_flipped_bit_loads_as_another_model(untrained, tmp_path):
    rng = np.random.default_rng(0)
    files = {
        save_checkpoint(untrained, tmp_path / "m.safetensors", {"note": "none"}): load_checkpoint,
        Reachability(("push",)).save(tmp_path / "r.safetensors"): Reachability.load,
    }
    for path, load in files.items():
        whole = path.read_bytes()
        header = 8 + int.from_bytes(whole[:8], "little")
        for number in range(50):
            spoiled = bytearray(whole)
            at = rng.integers(header if number % 2 else len(whole))
            spoiled[at] ^= 1 << int(rng.integers(8))
            path.write_bytes(spoiled)
            with pytest.raises(ValueError, match=path.name):
                load(path)


def test_what_is_no_checkpoint_is_not_replaced(untrained, tmp_path):
    (tmp_path / "m.safetensors").write_text("notes")
    (tmp_path / "f.safetensors").mkdir()
    (tmp_path / "l.safetensors").symlink_to(tmp_path / "nowhere")
    for name in "mfl":
        with pytest.raises(FileExistsError, match=f"{name}.safetensors exists and is not"):
            save_checkpoint(untrained, tmp_path / f"{name}.safetensors", {})
    assert (tmp_path / "m.safetensors").read_text() == "notes"


def test_a_model_is_not_judged_on_what_it_saw(pushes, held_out_pushes):
    """Subsets of a recipe, and recipes written with fewer fields, also count as seen."""
    _, about = load_checkpoint("cnp_500")
    split = split_interactions(500)
    refuse_seen(about, pushes, split.test)
    refuse_seen(about, held_out_pushes, np.arange(1000))
    older, rougher = json.loads(about["recipe"]), json.loads(about["recipe"])
    del older["anywhere"], older["world"]["tip_offset_m"]
    rougher["world"]["table_friction"] = 0.6
    larger = json.loads(pushes.attrs["recipe"]) | {"n_interactions": 2000}
    for known, data, part in (
        (about, pushes, split.train),
        (about, pushes, split.validation),
        (about | {"recipe": json.dumps(older)}, pushes, split.train),
        (about | {"recipe": json.dumps(rougher)}, pushes, split.train),
        (about, pushes.assign_attrs(recipe=json.dumps(larger)), np.arange(500)),
    ):
        with pytest.raises(ValueError, match="was trained or tuned on"):
            refuse_seen(known, data, part)
