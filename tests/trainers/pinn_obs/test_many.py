"""Many records: one after another on the CPU, at once on a GPU."""

import signal
from dataclasses import replace

import numpy as np
import pytest
import torch
from small_trainings import same_weights, train_pinn_obs

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimators.pinn_obs import PinnObs
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing
from pinnobs_gym.training.loop import Interrupt
from trainers.pinn_obs import PinnObsConfig, PinnObsTrainer
from trainers.pinn_obs.fast_recipe import FastRecipe
from trainers.pinn_obs.objective import Objective, Weights
from trainers.pinn_obs.quasi_newton import CURVATURE, trials
from trainers.pinn_obs.searches import Searches
from trainers.pinn_obs.stacked import Minimisations, advance, evaluate_first

# few points make quick tests
pytestmark = pytest.mark.filterwarnings("ignore:points=40 do not resolve")

train_rows = PinnObsTrainer.train_rows
DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
SMALL = PinnObsConfig(depth=2, width=8, iterations=25, points=40)


def records(name="ReverseDuffing", batch=3):
    source = EpisodeSource(name)
    streams = source.streams(range(batch))
    record = source.record(source.play(source.draw(streams)))
    return source.system, record, source.setup.noise_std


def runs_of(system, record, noise, config=SMALL):
    rows = [record.rows(slice(i, i + 1)) for i in range(record.batch)]
    return [PinnObsTrainer(system, config, record=row, noise_std=noise) for row in rows]


@pytest.mark.parametrize("device", DEVICES)
def test_a_batch_finds_what_single_trainings_find(device):
    system, record, noise = records()
    record.y[1, 30:40] = np.nan
    together = runs_of(system, record, noise)
    advance(together, device, Interrupt())
    for run, alone in zip(together, runs_of(system, record, noise), strict=True):
        while not alone.finished():
            alone.step()
        assert run.iteration == alone.iteration == 25
        ours, theirs = run.result(), alone.result()
        assert ours.loss == pytest.approx(theirs.loss, rel=1e-6)
        np.testing.assert_allclose(ours.xhat(record.t), theirs.xhat(record.t), atol=1e-6)
        np.testing.assert_allclose(ours.gain(record.t), theirs.gain(record.t), atol=1e-4)


@pytest.mark.parametrize("device", DEVICES)
def test_each_record_of_a_batch_ends_when_it_would_alone(device):
    system, record, noise = records(batch=4)
    config = replace(SMALL, iterations=60, patience=8, improvement=0.3)
    together = runs_of(system, record, noise, config)
    advance(together, device, Interrupt())
    alone = runs_of(system, record, noise, config)
    for run in alone:
        while not run.finished():
            run.step()
    ends = [run.iteration for run in alone]
    assert len(set(ends)) > 1
    assert [run.iteration for run in together] == ends


def test_records_of_other_sizes_are_trained_apart():
    system, record, noise = records(batch=2)
    wave = np.sin(40 * 2 * np.pi * record.t / record.t[-1])
    record.y[1, :, 0] = wave  # which gives the network further inputs
    together = runs_of(system, record, noise, replace(SMALL, guide=0.0, iterations=5))
    assert len({tuple(run.recipe.architecture.shapes) for run in together}) == 2
    advance(together, "cpu", Interrupt())
    assert [run.iteration for run in together] == [5, 5]


def test_a_minimisation_without_a_way_down_ends():
    """Here since no term of its loss has any weight."""
    system, record, noise = records(batch=2)
    runs = runs_of(system, record, noise)
    first, second = (run.recipe.objective for run in runs)
    nothing = Weights(np.zeros(system.nx), np.zeros(system.nx), np.zeros(system.ny))
    lead = replace(second.lead, by_xhat=0 * second.lead.by_xhat, by_L=0 * second.lead.by_L)
    flat = Objective(second.architecture, system, second.points, nothing, lead)
    starts = np.stack([run.theta for run in runs])
    state = Minimisations([first, flat], starts, [1, 1], "cpu", SMALL)
    state.rounds(1)
    assert state.progress.live.tolist() == [True, False]
    for _ in range(5):
        state.rounds(1)
    (made, best, _, stuck), (ended, other, _, flat_stuck) = state.reached()
    assert made > 1
    assert (stuck, ended, flat_stuck) == (False, 2, True)
    assert np.array_equal(other.theta, starts[1])
    assert np.isfinite(best.theta).all()


@pytest.mark.parametrize("device", DEVICES)
def test_after_a_search_that_fails_the_next_is_along_the_steepest_descent(device):
    """As it is in single trainings, here of networks that are too small for the record."""
    system, record, noise = records(batch=3)
    config = PinnObsConfig(depth=1, width=2, iterations=400, patience=400, points=40)
    runs = runs_of(system, record, noise, config)
    evaluate_first(runs, device)
    objectives, starts = [r.recipe.objective for r in runs], np.stack([r.theta for r in runs])
    state, waited = Minimisations(objectives, starts, [1] * 3, device, config), 0
    for _ in range(40):
        state.rounds(20)
        waited += int(state.waiting.sum())
    assert waited > 0
    for (_, best, _, _), alone in zip(
        state.reached(), runs_of(system, record, noise, config), strict=True
    ):
        while not alone.finished():
            alone.step()
        assert best.loss == pytest.approx(alone.best.loss, rel=1e-3)


class Asking(ReverseDuffing):
    """A model that reads numbers back."""

    def f(self, t, x, u):
        return super().f(t, x, u) if bool(abs(x).max() < 1e9) else 0 * x


@pytest.mark.parametrize("device", DEVICES)
def test_a_model_that_reads_numbers_back_is_trained_too(device):
    _, record, noise = records(batch=2)
    together = runs_of(Asking(), record, noise)
    advance(together, device, Interrupt())
    for run, alone in zip(together, runs_of(Asking(), record, noise), strict=True):
        while not alone.finished():
            alone.step()
        assert run.result().loss == pytest.approx(alone.result().loss, rel=1e-6)


def test_no_number_is_read_back_within_a_round():
    """On the meta device, which has none."""
    system, record, noise = records(batch=2)
    runs = runs_of(system, record, noise, replace(SMALL, guide=0.0))
    objectives, starts = [r.recipe.objective for r in runs], np.stack([r.theta for r in runs])
    state = Minimisations(objectives, starts, [1, 1], "meta", SMALL)
    for _ in range(2):
        state.rounds(1)
    assert state.progress.best.device.type == "meta"


def test_searches_at_once_are_those_one_by_one():
    """On functions with several minima, without one, and not finite beyond a step."""
    functions = [
        lambda a: (np.cos(3 * a) - a, -3 * np.sin(3 * a) - 1),
        lambda a: ((a - 5.0) ** 2, 2 * (a - 5.0)),
        lambda a: (-a, -1.0),
        lambda a: (a**4 - a, 4 * a**3 - 1) if a < 0.9 else (np.inf, np.nan),
        lambda a: (abs(a - 1e-3), -1.0 if a < 1e-3 else 1.0),
        lambda a: (1e3 * (a - 0.011) ** 2, 2e3 * (a - 0.011)),
    ]
    first = [0.3, 0.1, 1.0, 2.0, 1.0, 0.7]
    starts = np.array([function(0.0) for function in functions])
    singles = [trials(f, slope, a, CURVATURE) for (f, slope), a in zip(starts, first, strict=True)]
    steps, found = [next(search) for search in singles], [None] * len(functions)
    f, slope = torch.tensor(starts).T
    together = Searches(len(functions), f)
    together.begin(torch.ones(len(functions)) > 0, f, slope, torch.tensor(first, dtype=f.dtype))
    for _ in range(30):
        values = [
            function(a) for function, a in zip(functions, together.step.tolist(), strict=True)
        ]
        for i, search in enumerate(singles):
            if found[i] is None:
                assert together.step[i].item() == pytest.approx(steps[i], rel=1e-9)
                try:
                    steps[i] = search.send(values[i])
                except StopIteration as stop:
                    found[i] = stop.value
        accepted, failed = together.advance(*torch.tensor(values, dtype=f.dtype).T)
        for i, (yes, no) in enumerate(zip(accepted.tolist(), failed.tolist(), strict=True)):
            assert not yes or found[i] is True
            assert not no or found[i] is False
        assert together.active.tolist() == [value is None for value in found]
    assert True in found
    assert False in found


@pytest.mark.parametrize("name", list(SYSTEMS.classes()))
def test_nothing_leaves_the_device(name):
    system, record, noise = records(name, batch=2)
    runs = runs_of(system, record, noise, replace(SMALL, guide=0.0))
    stack = Objective.stacked([run.recipe.objective for run in runs], "meta")
    theta = torch.empty((2, len(runs[0].theta)), dtype=torch.float64, device="meta")
    loss, gradient = stack.values(theta)
    assert (loss.shape, loss.device.type) == ((2,), "meta")
    assert (gradient.shape, gradient.device.type) == (theta.shape, "meta")


@pytest.mark.parametrize("preset", PinnObsTrainer.presets)
def test_without_a_gpu_it_is_one_after_another(preset):
    system, record, noise = records(batch=2)
    sizes = {"width": 80} if preset == "posterior" else {"depth": 2, "width": 8, "iterations": 4}
    small = {**sizes, "device": "cpu"}
    config = PinnObsTrainer.configured({"preset": preset, **small})
    many = train_rows(system, config, record=record, noise_std=noise)
    for i, trained in enumerate(many):
        row = record.rows(slice(i, i + 1))
        assert same_weights(trained, train_pinn_obs(system, config, record=row, noise_std=noise))
    xhat = PinnObs(system, config=config).run(record).xhat
    np.testing.assert_array_equal(xhat, [trained.xhat(record.t) for trained in many])


def test_ctrl_c_keeps_what_every_record_has(monkeypatch):
    system, record, noise = records()
    step = PinnObsTrainer.step

    def interrupted(run):
        step(run)
        if run.iteration == 3:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(PinnObsTrainer, "step", interrupted)
    config = replace(SMALL, device="cpu")
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # it may be ignored here
    try:
        many = train_rows(system, config, record=record, noise_std=noise)
    finally:
        signal.signal(signal.SIGINT, before)
    assert [trained.iterations for trained in many] == [3, 1, 1]
    stopped = runs_of(system, record, noise)
    pressed = Interrupt()
    pressed.requested = True
    advance(stopped, "cpu", pressed)
    assert [run.result().iterations for run in stopped] == [1, 1, 1]


def test_a_device_that_is_not_there_is_refused(monkeypatch):
    system, record, noise = records(batch=1)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ValueError, match="device='cuda'; torch finds no GPU here"):
        train_rows(system, replace(SMALL, device="cuda"), record=record, noise_std=noise)
    with pytest.raises(ValueError, match="device='tpu'; expected auto, cpu or cuda"):
        PinnObsConfig(device="tpu")
    assert train_rows(system, SMALL, record=record, noise_std=noise)[0].iterations == 25


@pytest.mark.parametrize("preset", ["guided", "transfer"])
def test_guides_of_a_batch_are_those_of_single_records(preset):
    """Also of one whose outputs make another noise, and of one with a gap."""
    system, record, std = records("Satellite", batch=3)
    record = record.first_samples(120)
    record.y[1, 30:40] = np.nan
    config = PinnObsTrainer.configured({"preset": preset, "depth": 1, "width": 4, "points": 40})
    rows, noise = [record.rows(slice(i, i + 1)) for i in range(3)], system.noise(std)
    for one, row in zip(FastRecipe.many(system, config, rows, noise), rows, strict=True):
        alone = FastRecipe(system, config, row, noise)
        for name in ("xhat", "L", "smoothed", "P"):
            found, expected = (getattr(recipe.guide, name) for recipe in (one, alone))
            np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-8 * abs(expected).max())


def test_training_many_on_a_device_goes_by_the_batch(monkeypatch):
    """With the CPU in place of a GPU."""
    system, record, noise = records(batch=2)
    monkeypatch.setattr("trainers.pinn_obs._device", lambda config: "cuda")
    called = []

    def on_cpu(trainers, device, interrupt):
        called.append(device)
        advance(trainers, "cpu", interrupt)

    monkeypatch.setattr("trainers.pinn_obs.advance", on_cpu)
    many = train_rows(system, SMALL, record=record, noise_std=noise)
    assert called == ["cuda"]
    for i, trained in enumerate(many):
        alone = train_pinn_obs(system, SMALL, record=record.rows(slice(i, i + 1)), noise_std=noise)
        assert trained.loss == pytest.approx(alone.loss, rel=1e-6)
        assert (trained.iterations, trained.ending) == (alone.iterations, "finished")
