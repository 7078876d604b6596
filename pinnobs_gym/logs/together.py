"""Several logs with the same sample times as one record."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pinnobs_gym.logs.reading import Log
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import System

_SAME = 1e-3
"""Largest difference of a time from that of the first log, over the median step."""


def together(logs: Sequence[Log]) -> tuple[System, Record]:
    """Return the model and the record of several logs, at least one, a row for each.

    Raises:
        ValueError: in one line that names two of the logs, if their sample times differ, only one
            of them has inputs, or both have the same outputs.
    """
    first, records = logs[0], [log.record for log in logs]
    t = first.record.t
    for i, log in enumerate(logs[1:], 1):
        if log.system.measured_input != first.system.measured_input:
            raise ValueError(
                f"only one of logs {first.path} and {log.path} has columns of inputs; expected "
                "them in all logs, or none"
            )
        _check_times(first, log)
        _check_new(logs[:i], log)
    levels = None
    if any(record.noise_std is not None for record in records):
        unknown = np.full(records[0].y.shape, np.nan)
        levels = np.concatenate(
            [unknown if record.noise_std is None else record.noise_std for record in records]
        )
    prior = Prior(
        np.concatenate([record.prior.mean for record in records]),
        np.concatenate([record.prior.cov for record in records]),
    )
    y, u = (np.concatenate([getattr(record, n) for record in records]) for n in ("y", "u"))
    return first.system, Record(t, y, u, prior, levels)


def _check_times(first: Log, log: Log) -> None:
    """Raise ValueError, in one line, unless two logs have the same sample times."""
    t, own = first.record.t, log.record.t
    if len(own) != len(t):
        raise ValueError(
            f"logs {first.path} and {log.path} have {len(t)} and {len(own)} samples; expected logs "
            "with the same sample times"
        )
    step = float(np.median(np.diff(t))) if len(t) > 1 else 0.0
    wrong = np.flatnonzero(abs(own - t) > _SAME * step)
    if len(wrong):
        k = int(wrong[0])
        raise ValueError(
            f"log {log.path}, line {log.lines[k]}: t={own[k]:.9g}; expected t={t[k]:.9g}, as log "
            f"{first.path} has, since logs that are learned from together need the same times"
        )


def _check_new(earlier: Sequence[Log], log: Log) -> None:
    """Raise ValueError, in one line, if a log has the outputs of an earlier one: one that is held
    out would be learned from."""
    for other in earlier:
        if np.array_equal(other.record.y, log.record.y, equal_nan=True):
            raise ValueError(
                f"logs {other.path} and {log.path} have the same outputs; expected each log once"
            )
