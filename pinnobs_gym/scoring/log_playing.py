"""Running an estimator on a sensor log with reference states."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pinnobs_gym.estimation.estimator import BaseEstimator, Estimates
from pinnobs_gym.logs.reference import ReferencedLog
from pinnobs_gym.scoring.log_game import LogGame
from pinnobs_gym.scoring.playing import Played, timed
from pinnobs_gym.simulation.matrices import sandwich
from pinnobs_gym.simulation.model import model_step_moments


def play_log(game: LogGame, estimator: BaseEstimator, episode: int) -> Played:
    """Run an estimator on the log of an episode number.

    The times of the reference between two samples are rows without outputs for an estimator that
    passes the check ``blank_rows`` (`pinnobs_gym.estimation.plant_checks`): they leave its other
    estimates as they are. Any other runs on the samples alone, and the model moves the estimate and
    the covariance of the sample before to each of these times.

    Args:
        game: the logs.
        estimator: the estimator to run.
        episode: the episode's number in the game.

    Raises:
        ValueError: if the estimates do not have shape (1, num_samples, nx), or the estimator does
            not take the record.
    """
    log = game.logs[episode]
    if log.own.all() or "blank_rows" not in estimator.exempt_from:
        estimates, cost = timed(estimator, log.record)
        cost *= log.record.num_samples / log.own.sum()  # per sample of the log, as for all
    else:
        found, cost = timed(estimator, log.record.samples(log.own))
        estimates = _moved(log, estimator, found)
    end = game.transient_end(log)
    return Played(game, (episode,), log.record, log.truth, estimates, cost, transient=end)


def _moved(log: ReferencedLog, estimator: BaseEstimator, found: Estimates) -> Estimates:
    """Return estimates at all rows of a record, given those at the samples of the log: at the
    others, those which the model makes of the sample before."""
    record, own, system = log.record, log.own, estimator.system
    sample = np.cumsum(own) - 1  # the sample of each row, or the one before it
    names = ("xhat", "P", "innovation", "S", "outside")
    values = {name: getattr(found, name) for name in names}
    spread = {
        name: None if value is None else np.asarray(value, dtype=float)[:, sample]
        for name, value in values.items()
    }
    whole = Estimates(**spread)  # pyright: ignore[reportArgumentType]
    noise = estimator.noise
    with np.errstate(all="ignore"):  # a diverged estimate stays so
        for k in np.flatnonzero(~own):
            t0, t1 = float(record.t[k - 1]), float(record.t[k])
            inputs = record.u[:, k - 1], record.u[:, k]
            x, F, Q = model_step_moments(system, noise, t0, t1, whole.xhat[:, k - 1], *inputs)
            whole.xhat[:, k] = x
            if whole.P is not None:
                P = whole.P[:, k - 1].transpose(1, 2, 0)
                whole.P[:, k] = (sandwich(F, P) + Q).transpose(2, 0, 1)
    if whole.innovation is None:
        return whole
    zero = np.where(own[:, None], whole.innovation, 0.0)
    return replace(whole, innovation=zero)
