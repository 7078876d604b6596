"""Sensor logs of one plant, with reference states, as the episodes of a game."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

import numpy as np

from pinnobs_gym.envs.game import Game, GameName
from pinnobs_gym.envs.registration import env_id
from pinnobs_gym.logs.reading import read_log
from pinnobs_gym.logs.reference import ReferencedLog, read_reference
from pinnobs_gym.scoring.known_states import counted
from pinnobs_gym.scoring.metrics import windows
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.system import Setup, System

LOG_SETUP = "log"
"""What stands for the setup in names of such games."""
_EPISODES = 10**12
"""Number of episode numbers: two different logs have the same one with this chance."""


@dataclass(frozen=True)
class LogModel:
    """What estimators are given beside the records of logs."""

    system: System
    """The model."""
    setup: Setup
    """Its noise and prior; of the rest, only the transient window counts."""


@dataclass(frozen=True)
class LogGame:
    """Sensor logs with reference states: what is scored of one plant. Created by `LogGame.of`."""

    name: GameName
    """The env id of the system, the setup `LOG_SETUP` and the condition ``nominal``."""
    source: LogModel
    """What estimators are given beside the records."""
    logs: dict[int, ReferencedLog] = field(hash=False)
    """The logs by the numbers of their episodes, in the order given."""

    @classmethod
    def of(
        cls,
        system: System,
        setup: Setup,
        logs: Sequence[str | Path],
        references: Sequence[str | Path],
        columns: Sequence[str] = (),
    ) -> Self:
        """Read logs and their references.

        Args:
            system: the model, of a registered class.
            setup: the noise and the prior that estimators are told.
            logs: the files of the logs; see `pinnobs_gym.logs.reading.read_log`.
            references: the file of the reference of each; see
                `pinnobs_gym.logs.reference.read_reference`.
            columns: columns of the logs under other names, as `read_log` takes them.

        Raises:
            ValueError: in one line, if a file cannot be read or does not fit the system, a log has
                no reference or is given twice, some logs have inputs and others have none, or the
                outputs determine none of the states of a reference.
        """
        if not logs or len(logs) != len(references):
            raise ValueError(
                f"{len(logs)} log(s) and {len(references)} reference(s); expected one reference "
                "for each log, in the same order"
            )
        prior = Prior.of(system, setup, 1)
        read: dict[int, ReferencedLog] = {}
        for path, reference in zip(logs, references, strict=True):
            log = read_reference(reference, read_log(path, system, prior, columns))
            number = episode_number(log)
            if number in read:
                raise ValueError(
                    f"logs {read[number].log.path} and {path}, with their references, are the same;"
                    " expected each once"
                )
            read[number] = log
            _check(log)
        models = [log.log.system for log in read.values()]
        if len({model.measured_input for model in models}) > 1:
            which = [str(log.log.path) for log in read.values() if log.log.system.measured_input]
            raise ValueError(
                f"only {', '.join(which)} has columns of inputs; expected them in all logs, or none"
            )
        name = GameName(env_id(type(system)), LOG_SETUP, "nominal")
        return cls(name, LogModel(models[0], setup), read)

    @property
    def nominal(self) -> Game:
        """The benchmark of the system, under which published estimators are trained."""
        return Game.of(self.name.env_id)

    @property
    def notes(self) -> tuple[str, ...]:
        """What the user should know of the logs and references, a line each."""
        return tuple(
            note
            for log in self.logs.values()
            for note in (
                *log.log.notes,
                *log.notes,
                *_copied_outputs(log),
                *_empty_windows(log, self.transient_end(log)),
            )
        )

    def transient_end(self, log: ReferencedLog) -> float:
        """Return the end of a log's transient window in s from its first sample: `Setup.transient`
        or, if that is None, a quarter of the log."""
        own, t = self.source.setup.transient, log.record.t
        return float(t[-1] - t[0]) / 4 if own is None else own


def episode_number(log: ReferencedLog) -> int:
    """Return the number of the episode of a log with its reference: a hash of the samples and of
    the reference states. Names of files and the order of columns do not count, nor does the prior,
    which is part of the game."""
    record = log.record
    digest = hashlib.sha256()
    for array in (record.t, record.y, record.u, record.noise_std, log.truth):
        values = np.asarray(np.nan if array is None else array, dtype="<f8") + 0.0  # -0 is 0
        values = np.where(np.isnan(values), np.nan, values)  # NaN has several forms
        digest.update(repr(values.shape).encode() + np.ascontiguousarray(values).tobytes())
    return int(digest.hexdigest(), 16) % _EPISODES


def _check(log: ReferencedLog) -> None:
    """Check that some errors can be scored.

    Raises:
        ValueError: in one line, if the outputs determine none of the known states.
    """
    system = log.log.system
    if not counted(system, log.truth, log.record.prior.mean).any():
        raise ValueError(
            f"reference {log.reference} has only states of {type(system).__name__} that the "
            "outputs do not determine there (System.observable); expected others"
        )


def _copied_outputs(log: ReferencedLog) -> Iterator[str]:
    """Yield a note for each state whose reference has the values of an output of the log."""
    system, y, x = log.log.system, log.record.y[0], log.truth[0]
    for i, state in enumerate(system.state_names):
        for j, output in enumerate(system.output_names):
            both = ~np.isnan(x[:, i]) & ~np.isnan(y[:, j])
            if both.sum() > 1 and np.allclose(x[both, i], y[both, j], rtol=1e-9, atol=0.0):
                yield (
                    f"reference {log.reference}: {state} has the values of output {output} at all "
                    f"{both.sum()} samples in common; if it is that sensor itself, errors of "
                    f"{state} are those to its noisy values"
                )


def _empty_windows(log: ReferencedLog, end: float) -> Iterator[str]:
    """Yield a note for each window that has no known state, whose errors are thus of another one.

    Args:
        log: the log.
        end: the end of the transient window, in s from the first sample.
    """
    known = (~np.isnan(log.truth[0])).any(axis=1)
    t, start = log.record.t[known], float(log.record.t[0])
    part = windows(t, end, start)
    unit = log.log.system.time_unit
    for name, where, empty in (
        ("transient", "up to", t[part["transient"].start] - start > end),
        ("steady", "after", t[-1] - start <= end),
    ):
        if empty:
            yield (
                f"reference {log.reference} has no state {where} t={start + end:g} {unit}, where "
                f"the transient ends; {name} errors are those at "
                f"t={t[part[name].start]:g} {unit} instead"
            )
