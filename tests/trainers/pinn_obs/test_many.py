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
from pinnobs_gym.training.loop import Interrupt
from trainers.pinn_obs import PinnObsConfig, PinnObsTrainer
from trainers.pinn_obs.objective import Objective, Weights
from trainers.pinn_obs.stacked import Minimisations, advance

# few points make quick tests
pytestmark = pytest.mark.filterwarnings("ignore:points=40 do not resolve")

train_rows = PinnObsTrainer.train_rows
SMALL = PinnObsConfig(depth=2, width=8, iterations=25, points=40)


def records(name="ReverseDuffing", batch=3):
    source = EpisodeSource(name)
    streams = source.streams(range(batch))
    record = source.record(source.play(source.draw(streams)))
    return source.system, record, source.setup.noise_std


def runs_of(system, record, noise, config=SMALL):
    rows = [record.rows(slice(i, i + 1)) for i in range(record.batch)]
    return [PinnObsTrainer(system, config, record=row, noise_std=noise) for row in rows]


def test_a_batch_finds_what_single_trainings_find():
    system, record, noise = records()
    record.y[1, 30:40] = np.nan
    together = runs_of(system, record, noise)
    advance(together, "cpu", Interrupt())
    for run, alone in zip(together, runs_of(system, record, noise), strict=True):
        while not alone.finished():
            alone.step()
        assert run.iteration == alone.iteration == 25
        ours, theirs = run.result(), alone.result()
        assert ours.loss == pytest.approx(theirs.loss, rel=1e-6)
        np.testing.assert_allclose(ours.xhat(record.t), theirs.xhat(record.t), atol=1e-6)
        np.testing.assert_allclose(ours.gain(record.t), theirs.gain(record.t), atol=1e-4)


def test_each_record_of_a_batch_ends_when_it_would_alone():
    system, record, noise = records(batch=4)
    config = replace(SMALL, iterations=60, patience=8, improvement=0.3)
    together = runs_of(system, record, noise, config)
    advance(together, "cpu", Interrupt())
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
    state = Minimisations([first, flat], np.stack([run.theta for run in runs]), "cpu")
    _, ended = state.round()
    assert ended == [1]
    before = state.x[1]
    made = [state.round()[0] for _ in range(5)]
    assert any(0 in rows for rows in made)
    assert np.array_equal(state.x[1], before)
    assert np.isfinite(state.x).all()


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
