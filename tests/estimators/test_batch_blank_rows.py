"""Least squares over records with rows without outputs."""

import numpy as np
import pytest

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimators.batch_least_squares import BatchLeastSquares
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.rescaled import Units, rescaled
from pinnobs_gym.systems import SYSTEMS


@pytest.mark.parametrize("name", ["Satellite", "ReverseDuffing"])
def test_rows_without_outputs_at_the_start_change_no_step_of_the_fit(name):
    """They made the first parts of the fit shorter, and its end another one within its tolerance.
    The model takes the same steps with and without them."""
    source, parts, n, dense = EpisodeSource(SYSTEMS.resolve(name)), 6, 120, 30
    episodes = source.play(source.draw(source.streams(range(2))))
    record, dt = source.record(episodes).first_samples(n), source.setup.dt
    at = np.concatenate([parts * np.arange(dense), parts * dense + np.arange(n - dense)])
    t = np.concatenate([dt / parts * np.arange(parts * dense), record.t[dense:]])
    t[at] = record.t
    y, u = np.full((2, len(t), 1), np.nan), np.zeros((2, len(t), 0))
    y[:, at] = record.y
    system = rescaled(source.system, Units(), model_step=dt / parts)
    fit = BatchLeastSquares.for_setup(system, source.setup)
    expected, found = fit.run(record), fit.run(Record(t, y, u, record.prior))
    assert expected.P is not None
    std = np.sqrt(np.einsum("bkii->bki", expected.P))
    assert (abs(found.xhat[:, at] - expected.xhat) / std).max() < 1e-9
