"""Episodes and their pictures in one call each, for notebooks."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Unpack

import numpy as np

from pinnobs_gym.envs.episodes import Changes
from pinnobs_gym.envs.figures import state_figure
from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.estimator import Estimates
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, repr=False)
class SimulatedRecord(Record):
    """A record that knows the model of its plant."""

    system: System = field(kw_only=True)
    """The model, which estimators are given."""


def simulate(
    system: str | type[System],
    seed: int = 0,
    *,
    episodes: int = 1,
    setup: str = "benchmark",
    condition: str = "nominal",
    **changes: Unpack[Changes],
) -> tuple[SimulatedRecord, np.ndarray]:
    """Simulate episodes: the ones that `pinnobs_gym.scoring.evaluation.evaluate` scores, of the
    given seed and those that follow it.

    Args:
        system: name, env id, ``module:Class`` or class of the system.
        seed: of the first episode.
        episodes: number of episodes.
        setup: the setup's name.
        condition: change of the episodes relative to the setup, such as ``dropout10``.
        changes: ``dt``, ``duration``, ``noise_std``, ``parameters`` in place of the setup's.

    Returns:
        The record that estimators are given, with its model in ``record.system``, and the true
        states at its samples, shape (episodes, num_samples, nx), which they are not.

    Raises:
        ValueError: in one line, for an unknown name or a value out of range.
    """
    game = Game.of(system, setup, condition, **changes)
    played = game.episodes(range(seed, seed + episodes))
    record = game.source.record(played)
    truth = np.ascontiguousarray(played.x[: record.num_samples].swapaxes(0, 1))
    parts = (record.t, record.y, record.u, record.prior, record.noise_std)
    return SimulatedRecord(*parts, system=game.source.system), truth


def plot(
    record: Record,
    estimates: Estimates | np.ndarray,
    truth: np.ndarray | None = None,
    *,
    system: System | None = None,
    episode: int = 0,
    title: str = "",
) -> Figure:
    """Return a figure of estimates over time: a panel per state with its band of two standard
    deviations and, if the truth is given, one of the errors over the states' scales.

    Args:
        record: the samples.
        estimates: what `Estimator.run` returns, or x̂ of shape (batch, num_samples, nx).
        truth: true states of the same shape as x̂.
        system: the model, for names and units; that of a record that `simulate` returned if None.
        episode: which episode of the record is drawn.
        title: title of the figure.

    Raises:
        ValueError: in one line, if no system is known, or a shape is not that of the record.
    """
    model = system or getattr(record, "system", None)
    if model is None:
        raise ValueError("the record does not know its system; expected plot(..., system=...)")
    made = estimates if isinstance(estimates, Estimates) else Estimates(np.asarray(estimates))
    expected = (record.batch, record.num_samples, model.nx)
    for name, array in (("estimates", made.xhat), ("truth", truth)):
        if array is not None and np.shape(array) != expected:
            raise ValueError(f"{name} have shape {np.shape(array)}; expected {expected}")
    if not 0 <= episode < record.batch:
        raise ValueError(f"episode={episode}; the record has {record.batch}")
    return state_figure(
        model,
        record.t,
        made.xhat[episode],
        x=None if truth is None else np.asarray(truth)[episode],
        y=record.y[episode],
        P=None if made.P is None else made.P[episode],
        title=title,
        errors=truth is not None,
    )
