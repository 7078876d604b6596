from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
import torch
from plain_network import Network
from small_trainings import (
    Failing,
    Interrupting,
    Mixer,
    constant_gain,
    duffing,
    gradient_of,
    random_record,
    same_weights,
    train_pinn_obs,
)

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.learned.mlp import Activation, Architecture
from pinnobs_gym.estimators.pinn_obs import PinnObs, PinnObsDirect, PinnObsReplay, TrainedNetwork
from pinnobs_gym.scoring import acceptance
from pinnobs_gym.scoring.evaluation import run_episodes
from pinnobs_gym.scoring.playing import play
from pinnobs_gym.systems import SYSTEMS
from trainers.pinn_obs import PinnObsConfig, PinnObsTrainer
from trainers.pinn_obs.objective import Lead, Objective, Weights
from trainers.pinn_obs.passes import flattened
from trainers.pinn_obs.points import fast_frequencies, points_of

GUIDE = "a smoother of its training record"
SMALL = PinnObsConfig(depth=2, width=8, iterations=60, log_every=10)


def by_autograd(network, system, points, weights, lead):
    """The loss of `Objective` in torch, its gradient and the time derivative by autograd."""
    t, y, u, present = (torch.tensor(getattr(points, n)) for n in ("t", "y", "u", "present"))
    t.requires_grad_()
    xhat, L = network(t)
    options = {"create_graph": True, "retain_graph": True}
    rate = [torch.autograd.grad(xhat[:, i].sum(), t, **options)[0] for i in range(system.nx)]
    innovation = (y - system.h(t, xhat, u)) * present
    residual = torch.stack(rate, -1) - system.f(t, xhat, u) - (L @ innovation[..., None])[..., 0]
    initial = xhat[0] - torch.tensor(points.xhat0)
    w = {n: torch.tensor(getattr(weights, n)) for n in ("initial", "equation", "output")}
    q = torch.tensor(points.equation)
    loss = (w["initial"] * initial**2).sum() + (q[:, None] * w["equation"] * residual**2).sum()
    loss = loss + (torch.tensor(points.output) * w["output"] * innovation**2).sum()
    loss = loss + (torch.tensor(lead.by_L) * (L - torch.tensor(lead.L)) ** 2).sum()
    loss = loss + (torch.tensor(lead.by_xhat) * (xhat - torch.tensor(lead.xhat)) ** 2).sum()
    loss.backward()
    return loss.item(), gradient_of(network)


@pytest.mark.parametrize("samples", [30, 2500])
@pytest.mark.parametrize("activation", get_args(Activation))
def test_the_gradient_by_hand_is_that_of_autograd(activation, samples):
    system, rng = Mixer(), np.random.default_rng(0)
    record = random_record(system, samples)
    record.y[0, [2, 5, 5, 9], [0, 0, 1, 1]] = np.nan
    points, _ = points_of(system, record, samples - 10)
    weights = Weights(rng.random(3), rng.random(3), rng.random(2))
    n = len(points.t)
    lead = Lead(*(rng.random((n, *size)) for size in ((3,), (3,), (3, 2), (3, 2))))
    architecture = Architecture(
        *(3, 2, 3, 7, activation, "float64"),
        span=(record.t[0], record.t[-1]),
        decays=(0.02, 0.3),
        frequencies=(9.0,),
        scale=tuple(rng.uniform(0.5, 2, 9)),
    )
    network = Network(architecture, torch.Generator().manual_seed(1))
    loss, gradient = Objective(architecture, system, points, weights, lead)(
        flattened(network.layers)
    )
    expected_loss, expected = by_autograd(network, system, points, weights, lead)
    assert loss == pytest.approx(expected_loss, rel=1e-12)
    assert abs(expected).max() > 0.1
    np.testing.assert_allclose(gradient, expected, rtol=1e-10, atol=1e-10 * abs(expected).max())
    single = Objective(replace(architecture, dtype="float32"), system, points, weights, lead)
    loss, gradient = single(flattened(network.layers).astype("float32"))
    assert gradient.dtype == np.float32
    assert loss == pytest.approx(expected_loss, rel=1e-5)
    np.testing.assert_allclose(gradient, expected, rtol=1e-4, atol=1e-4 * abs(expected).max())


def test_points_lie_on_the_records_lines():
    system = Mixer(measured_input=True)
    record = random_record(system, 30)
    record.y[0, 7, 1] = np.nan
    points, samples = points_of(system, record, 1000)
    assert np.array_equal(samples.t, record.t)
    assert set(record.t) <= set(points.t)
    assert points.t[1] - points.t[0] == pytest.approx(0.02 * (record.t[1] - record.t[0]), rel=1e-6)
    assert points.equation.sum() == pytest.approx(1)
    np.testing.assert_allclose(points.output.sum(0), 1)
    for j in range(2):
        expected = np.interp(points.t, record.t, record.y[0, :, j])
        there = points.present[:, j] > 0
        np.testing.assert_allclose(points.y[there, j], expected[there], atol=1e-12)
        expected = np.interp(points.t, record.t, record.u[0, :, j])
        np.testing.assert_allclose(points.u[:, j], expected, atol=1e-12)
    lost = (points.t > record.t[6]) & (points.t < record.t[8])
    assert np.array_equal(points.present[:, 1] == 0, lost)
    assert points.present[:, 0].all()


def test_a_fast_oscillation_is_found():
    record = random_record(Mixer(), 2000)
    assert fast_frequencies(replace(record, y=0 * record.y)) == ()
    fast, slow = np.cos(9.3 * record.t), np.sin(0.2 * record.t)
    (omega,) = fast_frequencies(replace(record, y=np.stack([fast, fast + slow], -1)[None]))
    assert omega == pytest.approx(9.3, rel=1e-3)
    assert fast_frequencies(replace(record, y=np.stack([slow, slow], -1)[None])) == ()


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_the_papers_example_is_solved_better_than_in_the_paper(seed):
    game = Game.of("ReverseDuffing", "paper")
    system, record = game.source.system, game.record([0])
    estimator = PinnObs(
        system, config=PinnObsConfig(seed=seed), noise_std=game.source.setup.noise_std
    )
    (trained,) = estimator.fit(record)
    played = play(game, PinnObsDirect(system, trained=trained), [0])
    error = played.estimates.xhat - played.truth
    assert trained.loss <= 9.56e-4
    assert np.sqrt(np.mean(error**2)) <= 0.0562
    assert abs(trained.xhat(record.t[:1]) - record.prior.mean).max() < 1e-2


def test_noise_is_not_fitted():
    game = Game.of("Academic")
    system, setup, record = game.source.system, game.source.setup, game.record([3])
    trained = train_pinn_obs(
        system, PinnObsConfig(iterations=500), record=record, noise_std=setup.noise_std
    )
    output = system.h(record.t, trained.xhat(record.t), record.u[0]) - record.y[0]
    later = record.t > 5
    assert output[later].std() == pytest.approx(0.02, rel=0.15)


def test_every_known_system_can_be_trained_on():
    for name, cls in SYSTEMS.classes().items():
        game = Game.of(name)
        system, record = game.source.system, game.record([0])
        record.y[0, ::7] = np.nan
        start = train_pinn_obs(system, replace(SMALL, iterations=2), record=record, noise_std=0.1)
        end = train_pinn_obs(system, replace(SMALL, iterations=30), record=record, noise_std=0.1)
        assert end.loss < start.loss, name
        assert np.isfinite(end.xhat(record.t)).all()
        assert cls.__name__ == end.system


def test_resuming_goes_on_exactly(tmp_path):
    system, record = duffing()
    path = tmp_path / "checkpoint.pt"
    straight = train_pinn_obs(system, SMALL, record=record)
    part = replace(SMALL, iterations=45, checkpoint_every=20)
    train_pinn_obs(system, part, record=record, checkpoint=path, log=Interrupting(31))
    resumed = train_pinn_obs(system, SMALL, record=record, checkpoint=path, resume=True)
    assert (resumed.iterations, resumed.loss) == (60, straight.loss)
    assert same_weights(resumed, straight)
    with pytest.raises(ValueError, match="noise_std"):
        train_pinn_obs(system, SMALL, record=record, checkpoint=path, resume=True, noise_std=0.1)
    other = replace(SMALL, gain_penalty=0.5)
    with pytest.raises(ValueError, match=r"gain_penalty=0\.1; expected 0\.5"):
        train_pinn_obs(system, other, record=record, checkpoint=path, resume=True)


def test_a_file_gives_the_same_network_back(tmp_path):
    system, record = duffing()
    trained = train_pinn_obs(system, SMALL, record=record)
    trained.save(tmp_path / "weights.pt")
    again = TrainedNetwork.load(tmp_path / "weights.pt", system)
    assert again.architecture == trained.architecture
    assert np.array_equal(again.xhat(record.t), trained.xhat(record.t))
    assert np.array_equal(again.gain(record.t), trained.gain(record.t))
    assert trained.covariance is not None
    assert np.array_equal(again.covariance(record.t), trained.covariance(record.t))


def test_patience_and_budget_end_training(ticking):
    system, record = duffing()
    config = replace(SMALL, iterations=10**6, patience=5, improvement=0.5)
    assert train_pinn_obs(system, config, record=record).iterations < 1000
    brief = train_pinn_obs(system, replace(config, patience=10**6, budget=0.2), record=record)
    assert brief.iterations <= 20  # the time is looked at after each
    assert 0.2 <= brief.seconds < 0.3


def test_a_loss_that_is_not_finite_begins_again(monkeypatch):
    monkeypatch.setenv("PINNOBS_KERNELS", "0")  # which would call f, too
    Failing.calls.clear()
    config = replace(SMALL, seed=5, guide=0.0)
    trained = train_pinn_obs(Failing(bad=1), config, record=random_record(Failing()))
    assert trained.seed == 6
    Failing.calls.clear()
    with pytest.raises(FloatingPointError, match=r"Failing .*seed 5"):
        train_pinn_obs(Failing(bad=10**6), config, record=random_record(Failing()))
    Failing.calls.clear()
    with pytest.warns(UserWarning, match="no smoother follows this record of Failing"):
        train_pinn_obs(Failing(bad=1), SMALL, record=random_record(Failing()))


def test_presets_are_whole_recipes_of_which_settings_are_changed():
    paper = PinnObsTrainer.configured({"preset": "paper", "width": 7})
    assert (paper.width, paper.depth, paper.optimiser, paper.guide) == (7, 9, "adam", 0.0)
    assert PinnObsTrainer.configured({}) == PinnObsConfig()
    assert PinnObsTrainer.configured({"preset": "transfer"}).transfer
    assert PinnObsTrainer.configured({"preset": "plain"}).guide == 0
    for change, message in (
        ({"preset": "best"}, "preset='best'; expected one of guided, plain, transfer, paper"),
        ({"dtype": "float32"}, "dtype='float32'; expected float64"),
        ({"preset": "paper", "gain_penalty": 1.0}, r"gain_penalty=1\.0; expected 0"),
        ({"deepness": 3}, "setting 'deepness'; expected one of activation, budget, "),
    ):
        with pytest.raises(ValueError, match=message):
            PinnObsTrainer.configured(change)


RECIPES = {
    "guided": ("guided by a smoother", ["model", "prior", "noise", GUIDE]),
    "transfer": ("guided by a smoother", ["model", "prior", "noise", GUIDE]),
    "plain": ("paper's loss", ["model", "prior", "noise"]),
}


@pytest.mark.parametrize("preset", RECIPES)
def test_names_and_knowledge_in_rows_say_the_recipe(preset):
    """Those of the estimator that trains, and of the one that is trained first."""
    name, knows = RECIPES[preset]
    game = Game.of("ReverseDuffing", duration=2.0)
    small = {"depth": 1, "width": 3, "iterations": 2, "preset": preset}
    config = PinnObsTrainer.configured(small)
    trained = train_pinn_obs(game.source.system, config, record=game.record([7]))
    replay = PinnObsReplay(game.source.system, trained=trained)
    (row,) = run_episodes(game, replay, range(1)).rows
    assert (row["estimator"], row["knows"]) == (f"pinn_obs_replay ({name})", knows)
    (row,) = run_episodes(game, PinnObs(game.source.system, config=config), range(1)).rows
    assert (row["estimator"], row["knows"]) == (f"pinn_obs ({name})", knows)


def test_adam_is_called_the_papers_recipe_and_knows_no_noise():
    config = PinnObsTrainer.configured({"preset": "paper"})
    assert PinnObs(SYSTEMS.resolve("Academic")(), config=config).label == (
        "pinn_obs (paper's recipe)"
    )
    assert config.knows == ()


@pytest.mark.parametrize("setup", ["benchmark", "paper"])
def test_a_trained_observer_is_replayed_on_four_records(setup):
    game = Game.of("Academic", setup, duration=4.0)
    system, record = game.source.system, game.record([7])
    trained = constant_gain(system, [[2.0], [1.0]], record)
    replay = PinnObsReplay(system, trained=trained)
    found = acceptance.replays(replay, game, 7)
    rmse = [one.scores["rmse"] for one in found]
    assert len(set(rmse)) == 4
    assert found[0].name == "own record"
    error = replay.run(record).xhat - found[0].played.truth
    assert rmse[0] == pytest.approx(np.sqrt(np.mean(error**2)))
    bad, good = {"nrmse": np.inf}, {"nrmse": 0.01}
    assert acceptance.warning(1e-6, bad)
    assert acceptance.warning(1e-3, bad) is acceptance.warning(1e-6, good) is None
