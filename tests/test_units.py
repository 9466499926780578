"""Cross-validation resumes, refuses what is stale, and its tables say what the parts hold."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch

from affordlib.interactions import (
    InteractionTensors,
    Scaler,
    open_interactions,
    split_interactions,
)
from affordlib.models.checkpoint import (
    checkpoint_sha256,
    read_weights,
    save_checkpoint,
    write_weights,
)
from affordlib.paths import repo_root
from affordlib.results import read_results
from experiments import grasps as grasps_module
from experiments import pooled, tables, units
from experiments.parts import pack, packed, parts_in
from experiments.units import Unit, configuration_sha256, read_part, run_unit, run_units

COMMITTED = repo_root() / "data" / "results" / "effect_prediction.json"
FEW = [Unit("constant", "grasp", fold=fold) for fold in range(3)]


@pytest.fixture(scope="module")
def grasps():
    return open_interactions("grasp")


# Units


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"model": "lstm"}, "model must be one of.*'lstm'"),
        ({"data": "lever_up"}, "data must be one of"),
        ({"n": 5}, 'n must be "all" or at least 10, got 5'),
        ({"fold": 10}, r"fold must lie in \[0, 9\], got 10"),
        ({"model": "logistic"}, "grasps, not 'push'"),
        ({"model": "film_table_frame", "data": "grasp"}, "has no direction"),
    ],
)
def test_units_that_cannot_be_are_refused(fields, reason):
    with pytest.raises(ValueError, match=reason):
        Unit(**({"model": "film", "data": "push"} | fields))


def test_all_units_have_parts_of_their_own():
    every = [
        Unit(model, data, n, fold, seed)
        for model in ("paper", "film", "constant", "nearest")
        for data in units.TASKS
        for n in ("all", 100)
        for fold in (0, 1)
        for seed in (0, 1)
    ]
    assert len({unit.file for unit in every}) == len(every)
    assert len({configuration_sha256(unit) for unit in every}) == len(every)


def test_killed_between_parts_only_the_missing_ones_run(tmp_path, monkeypatch):
    ran, real = [], units.baseline_predictions

    def counted(*arguments):
        if len(ran) == 2:
            raise KeyboardInterrupt
        ran.append(1)
        return real(*arguments)

    monkeypatch.setattr(units, "baseline_predictions", counted)
    with pytest.raises(KeyboardInterrupt):
        run_units(FEW, tmp_path, progress=False)
    kept = parts_in(tmp_path)
    assert sorted(kept) == [unit.file for unit in FEW[:2]]
    monkeypatch.setattr(units, "baseline_predictions", real)
    assert run_units(FEW, tmp_path, progress=False) == 1
    assert run_units(FEW, tmp_path, progress=False) == 0
    assert parts_in(tmp_path).items() >= kept.items()
    assert packed(tmp_path).is_file()
    assert not tmp_path.exists()
    tmp_path.mkdir()


def test_a_training_that_was_killed_goes_on_to_the_same_part(tmp_path, monkeypatch):
    monkeypatch.setattr(units, "FEW_STEPS", 6)
    short = replace(
        units.CHECKPOINT_SPECS["film_500"].training, validate_every=2, batch_size=8, ema=0.0
    )
    shipped = replace(units.CHECKPOINT_SPECS["film_500"], training=short)
    monkeypatch.setattr(units, "CHECKPOINT_SPECS", units.CHECKPOINT_SPECS | {"film_500": shipped})
    unit, real, seen = Unit("film", "grasp"), torch.nn.utils.clip_grad_norm_, []

    def dies(*arguments):
        seen.append(1)
        if len(seen) == 4:
            raise KeyboardInterrupt
        return real(*arguments)

    run_unit(unit, tmp_path)
    whole = json.loads((tmp_path / unit.file).read_text())
    (tmp_path / unit.file).unlink()
    monkeypatch.setattr(torch.nn.utils, "clip_grad_norm_", dies)
    with pytest.raises(KeyboardInterrupt):
        run_unit(unit, tmp_path)
    assert [path.suffix for path in tmp_path.iterdir()] == [".pt"]
    monkeypatch.setattr(torch.nn.utils, "clip_grad_norm_", real)
    assert run_unit(unit, tmp_path)
    again = json.loads((tmp_path / unit.file).read_text())
    assert again["fold_test"] == whole["fold_test"]
    assert [path.name for path in tmp_path.iterdir()] == [unit.file]


@pytest.mark.parametrize("name", ["configuration_sha256", "data_sha256"])
def test_stale_parts_are_refused_in_the_table_and_made_again(tmp_path, name):
    run_units(FEW, tmp_path, progress=False)
    part = parts_in(tmp_path)[FEW[0].file]
    tmp_path.mkdir(exist_ok=True)
    (tmp_path / FEW[0].file).write_text(json.dumps(part | {name: "of another time"}))
    pack(tmp_path)
    with pytest.raises(ValueError, match=f"{FEW[0].file} has another {name}.*run the unit again"):
        tables.assemble(tmp_path, tmp_path / "out")
    assert run_units(FEW, tmp_path, progress=False) == 1
    assert parts_in(tmp_path)[FEW[0].file] == part
    assert tables.assemble(tmp_path, tmp_path / "out").is_file()


def test_the_hash_is_of_what_decides_the_numbers(monkeypatch):
    unit = Unit("film", "push")
    first = configuration_sha256(unit)
    shipped = units.CHECKPOINT_SPECS["film_500"]

    def hash_with(**change):
        changed = replace(shipped, training=replace(shipped.training, **change))
        monkeypatch.setattr(
            units, "CHECKPOINT_SPECS", units.CHECKPOINT_SPECS | {"film_500": changed}
        )
        return configuration_sha256(unit)

    assert hash_with(learning_rate=2e-3) != first
    assert hash_with(device="cpu", max_minutes=3.0) == first
    monkeypatch.setattr(units, "FORMAT", units.FORMAT + 1)
    assert configuration_sha256(unit) != first


def test_a_large_set_need_not_be_here_but_its_parts_must_agree(tmp_path):
    unit = Unit("nearest", "rotate_x10")
    part = {"unit": asdict(unit), "n": 1000, "data_sha256": {"rotate_x10": "a"}}
    part["configuration_sha256"] = configuration_sha256(unit)
    (tmp_path / unit.file).write_text(json.dumps(part))
    assert read_part(unit, tmp_path) == part
    other = replace(unit, fold=1)
    more = part | {"unit": asdict(other), "data_sha256": {"rotate_x10": "b"}}
    more["configuration_sha256"] = configuration_sha256(other)
    (tmp_path / other.file).write_text(json.dumps(more))
    with pytest.raises(ValueError, match=r"fold1-seed0\.json is of another 'rotate_x10'"):
        pooled.data_of(pooled.read_parts(tmp_path))
    part["configuration_sha256"] = "old"
    (tmp_path / unit.file).write_text(json.dumps(part))
    with pytest.raises(ValueError, match="another configuration_sha256"):
        read_part(unit, tmp_path)


def test_a_set_that_was_collected_again_is_the_same_where_its_ends_are():
    def part(sha256, fold, interactions, ends):
        test = {"interaction": interactions, "truth": {"z": ends}}
        told = {"data_sha256": {"grasp_x10": sha256}, "fold_test": test}
        return Unit("film", "grasp_x10", fold=fold), told

    first = [part("a", 0, [4, 7], [0.25, 0.0]), part("a", 1, [5], [0.1])]
    again = part("b", 1, [5], [0.1 + 5e-7])
    for parts_of in ([*first, again], [again, *first]):
        assert set(pooled.data_of(parts_of)["grasp_x10"]) == {"a", "b"}
    for other in (part("b", 1, [5], [0.1001]), part("b", 2, [6], [0.1]), part("b", 2, [], [])):
        with pytest.raises(ValueError, match="is of another 'grasp_x10'"):
            pooled.data_of([*first, other])


def test_one_training_is_not_counted_twice(tmp_path):
    run_units([FEW[0], replace(FEW[0], n=100)], tmp_path, progress=False)
    with pytest.raises(ValueError, match="would be one row of the table"):
        tables.read_parts(tmp_path)


def test_sets_ten_times_as_large_are_asked_the_same():
    small, large = Unit("film", "push"), Unit("film", "push_x10")
    (network, short), (same, long) = units.learner(small), units.learner(large)
    assert network == same
    assert replace(long, steps=short.steps) == short
    assert long.steps > short.steps
    assert configuration_sha256(small) != configuration_sha256(large)


@pytest.mark.parametrize(
    ("data", "name"),
    [
        ("push", "film_500"),
        ("push_x10", "film_5000"),
        ("drag", "drag_film_500"),
        ("grasp_x10", "grasp_film_1000"),
        ("rotate_x10", "rotate_film_1000"),
    ],
)
def test_shipped_networks_are_those_of_the_tables(data, name):
    shipped = units.CHECKPOINT_SPECS[name]
    assert units.learner(Unit("film", data)) == (shipped.network, shipped.training)
    assert (units.task_of(data).symmetries or ()) == shipped.symmetries


def test_the_shipped_checkpoint_stands_for_its_own_training_only(pushes):
    def found(fold, **change):
        network, training = units.learner(Unit("paper", "push", fold=fold))
        split = split_interactions(pushes.sizes["interaction"], 0, fold)
        scaler = Scaler.fit(InteractionTensors.from_dataset(pushes, split.train))
        scaler = replace(scaler, **change)
        return units._shipped(network, training, scaler, pushes, split)

    model, told = found(0)
    assert told["checkpoint"] == "cnp_500"
    assert model.effect_channels == ("x", "y")
    assert found(1) is None
    assert found(0, effect_scale=(0.03, 0.03)) is None  # of other data


def test_a_dask_client_makes_the_same_parts(tmp_path):
    from dask.distributed import Client

    run_units(FEW, tmp_path / "here", progress=False)
    with Client(processes=False, dashboard_address=None, n_workers=1) as client:
        assert run_units(FEW, tmp_path / "away", client, progress=False) == len(FEW)
    for unit in FEW:
        here, away = (read_part(unit, tmp_path / side) for side in ("here", "away"))
        assert here == away


# As committed

REQUIRED = {
    "push": "model n_interactions object_class folds final_error_mean_m final_error_sem_m "
    "final_error_median_m final_error_p95_m trajectory_error_mean_m",
    "grasp": "model n_interactions rollable error_mean_m tp_percent tn_percent fp_percent "
    "fn_percent n",
    "rotate": "model n_interactions error_mean_rad n",
    "inverse": "model final_error_mean_m theta_error_mean_rad n",
    "calibration": "model channel coverage_50 coverage_90 nll n",
    "baselines": "model knows data n",
}


@pytest.fixture(scope="module")
def committed():
    return read_results(COMMITTED)["tables"]


def test_committed_tables_have_their_columns(committed):
    for name, columns in (REQUIRED | {"drag": REQUIRED["push"]}).items():
        assert committed[name], f"table {name} is empty"
        for row in committed[name]:
            assert set(columns.split()) <= row.keys()


def test_committed_science(committed):
    def told(table, model, n, object_class="all", column="final_error_mean_m"):
        (row,) = (
            row
            for row in committed[table]
            if (row["model"], row["n_interactions"], row["object_class"])
            == (model, n, object_class)
        )
        return row[column]

    for table in ("push", "push_test"):
        assert told(table, "film", 500) < told(table, "paper", 500) < told(table, "constant", 500)
        assert told(table, "paper", 500) <= 0.007
        assert told(table, "film", 500) <= 0.001
        assert told(table, "film", 500, "cuboid") <= 0.0015
        assert told(table, "film", 500, column="final_error_p95_m") <= 0.004
        assert told(table, "film", 5000) <= 0.0005
        assert told(table, "film", 5000, "cuboid") <= 0.0008
        for n, most_deg in ((500, 3.0), (5000, 1.5)):
            turned = told(table, "film", n, "cuboid", "yaw_error_mean_rad")
            assert np.degrees(turned) <= most_deg
    assert told("drag", "film", 500) < 0.0002
    assert told("rotate", "film", 1000, column="error_mean_rad") < np.radians(2)
    grasps = {(r["model"], r["n_interactions"], r["rollable"]): r for r in committed["grasp"]}
    for rolls in (True, False):
        ours, guess = (grasps[name, 1000, rolls] for name in ("film", "logistic"))
        assert ours["auc"] > guess["auc"]
        assert ours["tn_percent"] > guess["tn_percent"] + 5
        assert ours["tp_low_percent"] <= ours["tp_percent"] <= ours["tp_high_percent"]


def test_committed_means_of_all_are_those_of_the_classes(committed):
    for table in ("push", "drag", "push_test"):
        rows = committed[table]
        for whole in (r for r in rows if r["object_class"] == "all"):
            key = whole["model"], whole["n_interactions"]
            classes = [
                r["final_error_mean_m"]
                for r in rows
                if (r["model"], r["n_interactions"]) == key and r["object_class"] != "all"
            ]
            assert whole["final_error_mean_m"] == pytest.approx(np.mean(classes))


def test_whatever_decides_a_training_decides_its_hash(monkeypatch):
    unit = Unit("film", "push")
    before, (network, training) = configuration_sha256(unit), units.learner(unit)
    for changed in ((replace(network, blocks=5), training), (network, replace(training, ema=0.5))):
        monkeypatch.setattr(units, "learner", lambda _, changed=changed: changed)
        assert configuration_sha256(unit) != before
    monkeypatch.setattr(units, "learner", lambda _: (network, replace(training, max_minutes=3.0)))
    assert configuration_sha256(unit) == before


def test_a_checkpoint_is_its_scales_too(tmp_path, film):
    path = save_checkpoint(film, tmp_path / "a.safetensors", {"note": 1})
    first = checkpoint_sha256(path)
    save_checkpoint(film, path, {"note": 2})
    assert checkpoint_sha256(path) == first
    tensors, told = read_weights(path, "")
    told["config"]["temperature"] = [3.0] * 3
    write_weights(path, tensors, told)
    assert checkpoint_sha256(path) != first


def test_parts_that_would_be_one_row_are_refused(tmp_path):
    text = json.dumps({"unit": asdict(Unit("constant", "grasp", 100)), "n": 100})
    other = json.dumps({"unit": asdict(Unit("constant", "grasp_x10", 100)), "n": 100})
    told = {"grasp": json.loads(text), "grasp_x10": json.loads(other)}
    for part in told.values():
        unit = Unit(**part["unit"])
        part |= {"configuration_sha256": configuration_sha256(unit)}
        if unit.data == "grasp":
            part |= units.hashes(unit)
        (tmp_path / unit.file).write_text(json.dumps(part))
    with pytest.raises(ValueError, match="would be one row of the table"):
        pooled.read_parts(tmp_path)


def test_a_fold_may_lack_a_class():
    def part(categories):
        errors = [0.001 * (k + 1) for k in range(len(categories))]
        names = ("final_error", "trajectory_error", "after_contact_error")
        return {"n": 100, "fixed_test": {"family": categories, **dict.fromkeys(names, errors)}}

    folds = [part([0, 0, 1]), part([0, 0, 1]), part([0, 0])]
    told = [(Unit("film", "drag", fold=k), fold) for k, fold in enumerate(folds)]
    rows = tables.error_rows(told, "drag", "fixed_test")
    assert [row["trainings_sd_m"] for row in rows[1:]] == pytest.approx([0, 0])
    assert rows[0]["trainings_sd_m"] == pytest.approx(np.std([2.25, 2.25, 1.5], ddof=1) / 1000)


def test_a_second_cross_validation_counts_no_grasp_twice(tmp_path):
    run_units(FEW, tmp_path, progress=False)
    one = grasps_module.grasp_rows(pooled.read_parts(tmp_path))
    run_units([replace(unit, seed=1) for unit in FEW], tmp_path, progress=False)
    assert grasps_module.grasp_rows(pooled.read_parts(tmp_path)) == one
