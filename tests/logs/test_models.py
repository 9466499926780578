"""Physics of a quasi-static push, and the neural process pretrained on it."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from affordlib.logs import LoggedPushes, cross_validate, fit, load_model, neural_process, save_model
from affordlib.logs.fit import MODELS, mirrors, sigma_scale
from affordlib.logs.neural_process import load_neural_process, rotation, transformed
from affordlib.logs.physics import ELLIPSOID, AnalyticPusher, quasi_static_push
from experiments.pretrain_np import save_neural_process, simulate

TRIANGLE_M = np.array([(-0.05, -0.05), (0.1, -0.05), (-0.05, 0.1)])
rows = pytest.fixture(lambda: simulate(1, torch.Generator().manual_seed(8))[0][0])
simulated = pytest.fixture(lambda: simulate(24, torch.Generator().manual_seed(5)), scope="module")
shipped = pytest.fixture(lambda: load_neural_process(), scope="module")


def log_of(rows, context=None, outline_m=TRIANGLE_M):
    """Simulated pushes (n, 10) of a triangle as a log."""
    rows = rows.double().numpy() * [0.05, 0.05, 1, 1, 1, 1, 0.05, 0.05, 0.05, 1]
    way = {"contact_m": rows[:, :2], "normal": rows[:, 2:4], "direction": rows[:, 4:6]}
    moved = {"length_m": rows[:, 6], "displacement_m": rows[:, 7:9], "turn_rad": rows[:, 9]}
    groups = np.array(["a", "b"] * len(rows))[: len(rows)]
    about = {"groups": groups, "context": context or {}, "outline_m": outline_m}
    return LoggedPushes(**way, **moved, **about)


def test_push_through_the_centre_of_friction_goes_straight():
    feet = torch.tensor([[[1.0, 0.0, 0.25], [-1, 0, 0.25], [0, 1, 0.25], [0, -1, 0.25]]])
    push = torch.tensor([[-1.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.4]])
    got = quasi_static_push(push, feet, torch.tensor([0.3]))
    torch.testing.assert_close(got, torch.tensor([[0.4, 0.0, 0.0]]))


def test_sticking_pusher_with_an_ellipsoid_turns_as_the_closed_form_says():
    # Lynch and Mason, Stable pushing, IJRR 1996: with r the lever and c the ratio of torque to
    # force, a sticking pusher along x at (0, r) turns by -r / (c² + r²) per distance.
    r, c, small = 0.5, 0.8, 1e-3
    angle = torch.arange(3) * (2 * math.pi / 3)
    feet = torch.stack([c * angle.cos(), c * angle.sin(), torch.full((3,), 1 / 3)], -1)[None]
    push = torch.tensor([[-0.7, r, 1.0, 0.0, 1.0, 0.0, small]])
    got = quasi_static_push(push, feet, torch.tensor([5.0]), ELLIPSOID)[0, 2] / small
    lever = np.array([-0.7, r])
    dissipation = minimize(
        lambda w: (1 + w[0] * lever[1]) ** 2 + (w[0] * lever[0]) ** 2 + c**2 * w[0] ** 2, [0.0]
    )
    assert float(got) == pytest.approx(dissipation.x[0], rel=1e-3)


def test_frictionless_pusher_moves_the_contact_along_the_normal_force_only():
    # The force is along the normal; with an ellipsoidal limit surface, v_y = 0 at the centroid.
    angle = torch.arange(3) * (2 * math.pi / 3)
    feet = torch.stack([angle.cos(), angle.sin(), torch.full((3,), 1 / 3)], -1)[None]
    push = torch.tensor([[-0.7, 0.3, 1.0, 0.0, math.cos(0.6), math.sin(0.6), 1e-3]])
    x, y, turn = quasi_static_push(push, feet, torch.tensor([0.0]), ELLIPSOID)[0].tolist()
    assert abs(y) < 1e-3 * x
    assert turn == pytest.approx(-0.3 * x, rel=1e-2)  # torque -0.3, c = 1


def test_simulated_pushes_turn_and_mirror_with_the_object(simulated):
    rows, feet, _ = simulated
    matrix = rotation(torch.tensor([0.7]), torch.tensor([True]))
    got, friction = [], torch.full((48,), 0.4)
    for m in (torch.eye(2)[None], matrix):
        push, support = transformed(rows[:1], m), transformed(feet[:1], m)
        got.append(quasi_static_push(push[0, :, :7], support.expand(48, -1, -1), friction))
    both = torch.cat([rows[:1, :, :7], got[0][None]], -1)
    torch.testing.assert_close(transformed(both, matrix)[0, :, 7:], got[1], atol=2e-5, rtol=0)


def test_analytic_pusher_finds_the_numbers_that_made_the_pushes(simulated):
    push = simulated[0][0, :40, :7]
    found = AnalyticPusher.fitted(push, AnalyticPusher(0.3, 0.6).predict(push))
    assert (found.friction, found.size) == pytest.approx((0.3, 0.6), rel=0.1)


def test_order_of_context_and_what_is_not_seen_do_not_matter(shipped, simulated):
    rows, feet, _ = simulated
    query, context, given = rows[:4, 32:], rows[:4, :20], feet[:4]
    with torch.no_grad():
        expected = shipped(query, context, given)
        order = torch.randperm(20, generator=torch.Generator().manual_seed(0))
        got = shipped(query, context[:, order], given.flip(1))
        seen = torch.arange(32).expand(4, -1) < 20
        hidden = shipped(query, rows[:4, :32], given, seen)
        alone = shipped(query[:, 3:4], context, given)
    last = [value[:, 3:4] for value in expected]
    for a, b in ((expected, got), (expected, hidden), (last, alone)):
        torch.testing.assert_close(a, b, atol=1e-5, rtol=0)


def test_prediction_turns_and_mirrors_with_the_object(shipped, simulated):
    rows, feet, _ = simulated
    matrix = rotation(torch.tensor([math.pi / 2]), torch.tensor([True]))
    expected = shipped.predict(rows[0, 32:, :7], rows[0, :20], feet[0])
    turned = [transformed(v[:1], matrix)[0] for v in (rows, feet)]
    got = shipped.predict(turned[0][32:, :7], turned[0][:20], turned[1])
    torch.testing.assert_close(got[0], expected[0] * torch.tensor([1, -1, -1]), atol=1e-5, rtol=0)
    torch.testing.assert_close(got[1], expected[1], atol=1e-5, rtol=0)


def test_context_and_feet_make_predictions_better(shipped, simulated):
    rows, feet, truth = simulated
    truth, off = neural_process.in_contact_frame(rows, truth)[:, 32:], []
    for n, given in ((0, 0), (5, 0), (20, 0), (0, 1)):
        with torch.no_grad():
            mean, std = shipped(rows[:, 32:], rows[:, :n], feet * given)
        assert bool((std > 0).all())
        off.append(float((mean - truth).norm(dim=-1).mean()))
    assert off[0] > off[1] > off[2], off
    assert off[3] < off[0], off


def test_tuning_lowers_the_error_where_the_world_is_another(rows):
    rows[:, 7:] *= 0.85  # pushes move objects 15 % less than in pretraining
    train, test = log_of(rows[:40]), log_of(rows[40:])
    model = fit(train, "np")
    truth = np.column_stack([test.displacement_m, test.turn_rad]) / [0.05, 0.05, 1]
    untuned = fit(train, "np")  # with the log as context alone
    for k in range(3):
        for name, weights in load_neural_process().state_dict().items():
            untuned.state[f"member {k}.{name}"] = weights.numpy()
    off = [np.abs(m.predict(test)[0] / [0.05, 0.05, 1] - truth).mean() for m in (model, untuned)]
    assert off[0] < off[1], off


def test_sigma_scale_is_that_of_the_residuals_of_few_pushes_too():
    off = torch.randn(4000, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([2, 2, 3])
    torch.testing.assert_close(sigma_scale(off), torch.tensor([2.0, 2, 3]), atol=0.1, rtol=0)
    of_ten = torch.stack([sigma_scale(some) for some in off.split(10)]).log().mean(dim=0).exp()
    torch.testing.assert_close(of_ten, torch.tensor([2.0, 2, 3]), atol=0, rtol=0.12)


def test_fit_refuses_what_it_does_not_know_and_other_files_hold_no_model(rows, tmp_path):
    with pytest.raises(ValueError, match="model must be one of"):
        fit(log_of(rows), "x")
    for few, model in ((rows[:7], "np"), (rows, "physics_feet")):
        with pytest.raises(ValueError, match=r"at least 8 pushes .*context\['feet'\]"):
            fit(log_of(few), model)
    narrow = log_of(rows, outline_m=0.9 * TRIANGLE_M)
    with pytest.raises(ValueError, match="pushes: their outline_m or tool_radius_m"):
        fit(log_of(rows), "constant").predict(narrow)
    untrained = neural_process.NeuralProcess()
    with pytest.raises(ValueError, match="holds no model of pushes"):
        load_model(save_neural_process(untrained, tmp_path / "np.safetensors", {}))
    with pytest.raises(FileNotFoundError, match=r"there is no file .*missing"):
        load_model(tmp_path / "missing.safetensors")
    with pytest.raises(ValueError, match=r"film_500.* train it: .*pretrain_np"):
        load_neural_process("film_500")


@pytest.mark.parametrize("name", MODELS)
def test_a_model_predicts_the_same_after_it_was_saved(name, tmp_path):
    rows, feet, _ = simulate(1, torch.Generator().manual_seed(8))
    known = np.repeat(feet.double().numpy() * [0.05, 0.05, 1], 20, axis=0)
    words, places = np.array(["felt", "steel"] * 10), np.arange(40.0).reshape(20, 2)
    data = log_of(rows[0, :20], {"feet": known, "surface": words, "place": places})
    model = fit(data, name, seed=3)
    path = save_model(model, tmp_path / "model.safetensors")
    np.testing.assert_array_equal(model.predict(data), load_model(path).predict(data))
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(ValueError, match=r"damaged.*fit the model to its log again"):
        load_model(path)


def test_cross_validation_leaves_the_number_of_threads_alone(monkeypatch, rows):
    monkeypatch.setattr("joblib.cpu_count", lambda: 1)  # runs in this process
    torch.set_num_threads(2)
    cross_validate(log_of(rows[:16]), models=(), folds=2)
    assert torch.get_num_threads() == 2


@pytest.mark.parametrize("name", ["gaussian_process", "rate_gp"])
def test_sigma_grows_outside_the_log(name, rows):
    """Far contacts are unlike the log's; a push much longer than the log's is warned of."""
    some = rows[rows[:, 0] > rows[:, 0].median()]
    model = fit(log_of(some), name)
    near, far = log_of(some), log_of(rows[rows[:, 0] < rows[:, 0].quantile(0.2)])
    assert model.predict(far)[1].mean() > 1.5 * model.predict(near)[1].mean()
    longer = replace(near, length_m=4 * near.length_m)
    with pytest.warns(UserWarning, match=r"much longer than those of the log, at most .*widened"):
        assert (model.predict(longer)[1] > 1.5 * model.predict(near)[1]).all()


def test_the_mirrors_of_outlines():
    square = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * 0.03
    assert len(mirrors(square)) == 4
    assert not mirrors(np.array([[0.0, 0.05], [-0.04, -0.01], [0.04, -0.04]]))
