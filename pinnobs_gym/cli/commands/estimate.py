"""`estimate ...`: estimate the states behind a sensor log."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pinnobs_gym.cli.console import console, print_next
from pinnobs_gym.cli.options import parse, settings_of
from pinnobs_gym.cli.output import print_judgement, write_estimates, write_figure
from pinnobs_gym.cli.own_model import ModelOptions
from pinnobs_gym.envs.figures import state_figure
from pinnobs_gym.estimation.estimator import BaseEstimator, Estimates
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.files import check_writable
from pinnobs_gym.logs.judgement import judge
from pinnobs_gym.logs.reading import Log, read_log
from pinnobs_gym.logs.times import instant
from pinnobs_gym.simulation.augmented_system import Augmented
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.system import Setup
from pinnobs_gym.training.by_name import load_for_log


@dataclass(frozen=True)
class Estimate:
    """Estimate the states from sensor logs: CSV files with columns t, y1, ... and u1, ..., or with
    the outputs' and inputs' own names."""

    system: str
    """Name or module:Class of the model."""
    log: tuple[Path, ...]
    """The CSV files, each estimated by itself; sample times may be irregular, or dates and times by
    ISO 8601, and empty cells are missing outputs."""
    columns: tuple[str, ...] = ()
    """Columns of other names or units, such as t=millis*1e-3 y1=voltage "u1={I (mA)}/1000"."""
    estimator: str = "ekf"
    """Name or module:Class of the estimator."""
    trained: Path | None = None
    """File of the trained estimator, from pinnobs train, for one that is trained beforehand."""
    set: tuple[str, ...] = ()
    """Settings of the estimator, such as assumed_noise=0.1."""
    model: ModelOptions = field(default_factory=ModelOptions)
    """What the model is told."""
    out: Path = Path("estimates.csv")
    """File of the estimates, of several logs estimates-LOG.csv; t is in s, from the first sample on
    if the log has dates. A figure is written beside it, with the suffix .png."""
    strict: bool = False
    """End with status 1 if the judgement of a log has a warning; files are written all the same."""

    def run(self) -> int:
        """Estimate each log, and write the results."""
        system, setup = self.model.told(self.system)
        kind = ESTIMATORS.resolve(self.estimator)
        if self.trained is None and kind.needs_training is not None:
            raise ValueError(
                f"estimator {self.estimator!r} is trained beforehand; give its file, --trained "
                "FILE, or take one that is not, or trains on the record"
            )
        if self.trained is not None and kind.needs_training is None:
            raise ValueError(
                f"estimator {self.estimator!r} is not one that is trained first; name that of the "
                "file, --estimator NAME"
            )
        if self.trained is not None and self.set:
            raise ValueError("--trained and --set; expected one of them")
        outs = _outs(self.out, self.log)
        prior = Prior.of(system, setup, 1)
        logs = [read_log(path, system, prior, self.columns) for path in self.log]
        estimators = [self._estimator(kind, log, setup) for log in logs]
        check_writable(self.out.parent)
        doubted = False
        for log, estimator, out in zip(logs, estimators, outs, strict=True):
            doubted |= _estimate(log, estimator, setup, out)
        if doubted or kind.exported is BaseEstimator.exported:
            columns = ["--columns", *self.columns] if self.columns else []
            told = [*columns, *self.model.words()]
            print_next("fit", "--system", self.system, "--log", *self.log, *told, "--noise")
        else:
            measured = any(log.system.measured_input for log in logs)
            print_next("export", self.estimator, *self._as_exported(kind, measured))
        return 1 if self.strict and doubted else 0

    def _as_exported(self, kind: type[BaseEstimator], measured: bool) -> list[object]:
        """Return the options by which `pinnobs export` writes the estimator that was run, on logs
        with inputs if ``measured``."""
        words: list[object] = ["--system", self.system, *self.model.words()]
        words += [] if self.trained is None else ["--trained", self.trained]
        words += ["--set", *self.set] if self.set else []
        words += ["--measured-input"] if measured else []
        return [*words, "-o", re.sub(r"\W", "_", ESTIMATORS.name_of(kind)) + ".c"]

    def _estimator(self, kind: type[BaseEstimator], log: Log, setup: Setup) -> BaseEstimator:
        """Return the estimator of a log."""
        if self.trained is not None:
            return load_for_log(kind, self.trained, log.system, setup, log.record)
        return kind.for_setup(log.system, setup, **settings_of(kind, self.set))


def _outs(out: Path, logs: Sequence[Path]) -> list[Path]:
    """Return the file of the estimates of each log.

    Raises:
        ValueError: in one line, if two are the same file, or one is a log or its own picture.
    """
    if not logs:
        raise ValueError("no log; expected --log FILE")
    outs = [out]
    if len(logs) > 1:
        outs = [out.with_name(f"{out.stem}-{log.stem}{out.suffix}") for log in logs]
    written: dict[str, Path] = {}
    for log, own in zip(logs, outs, strict=True):
        if own.suffix == ".png" or not own.name:
            raise ValueError(f"out={out} would overwrite the picture; name a .csv")
        for each in (own, own.with_suffix(".png")):
            if each.resolve() in [other.resolve() for other in logs]:
                raise ValueError(f"out={out} would overwrite the log {each}; name another file")
            place = str(each.resolve()).casefold()  # some systems do not tell capital letters
            if place in written:
                raise ValueError(
                    f"logs {written[place]} and {log} would both be written to {each}; expected "
                    "logs of different names"
                )
            written[place] = log
    return outs


def _estimate(log: Log, estimator: BaseEstimator, setup: Setup, out: Path) -> bool:
    """Estimate the states of a log; write them with a figure, and print the last ones. Returns
    whether the judgement of the log has a warning."""
    system, record = log.system, log.record
    for note in log.notes:
        console.print(note, soft_wrap=True, highlight=False)
    estimates = estimator.run(record)
    judgement = judge(system, setup, record, estimates)
    print_judgement(judgement)
    write_estimates(out, system, record, estimates)
    P = None if estimates.P is None else estimates.P[0]
    title = f"{log.path.name}: {type(system).__name__}, {estimator.label}"
    figure = state_figure(system, record.t, estimates.xhat[0], y=record.y[0], P=P, title=title)
    picture = out.with_suffix(".png")
    write_figure(picture, figure)
    last = ", ".join(
        f"{name} = {value:.6g}"
        for name, value in zip(system.state_names, estimates.xhat[0, -1], strict=True)
    )
    time = instant(record.t[-1], record.t) + ("" if system.discrete else " s")
    counted = f"{log.path.name}: {record.num_samples} samples"
    console.print(f"{counted}; at t = {time}: {last}", soft_wrap=True)
    if isinstance(system, Augmented):
        for line in _found(system, log, estimates):
            console.print(line, soft_wrap=True)
    if estimates.outside is not None and estimates.outside.any():
        count = f"{int(estimates.outside.sum())} of {record.num_samples} samples"
        what = f"{count} are outside of what {estimator.label} was trained on"
        console.print(f"{what}: column outside", soft_wrap=True)
    console.print(f"estimates: {out}; picture: {picture}", soft_wrap=True)
    return bool(judgement.warnings)


def _found(system: Augmented, log: Log, estimates: Estimates) -> list[str]:
    """Return a line for each unknown constant: its last estimate and what was known of it."""
    prior, lines, plant = log.record.prior, [], system.plant
    while isinstance(plant, Augmented):
        plant = plant.plant
    for i in range(plant.nx, system.nx):
        name = system.state_names[i]
        unit = f" {system.units[name]}" if name in system.units else ""
        mean, std = prior.mean[0, i], np.sqrt(prior.cov[0, i, i])
        after = "" if estimates.P is None else f" ± {np.sqrt(max(estimates.P[0, -1, i, i], 0)):.2g}"
        lines.append(
            f"found: {name} = {estimates.xhat[0, -1, i]:.6g}{after}{unit} (before the log: "
            f"{mean:.6g} ± {std:.2g})"
        )
    return lines


def run(arguments: Sequence[str]) -> int:
    """Run the command and return its exit status."""
    return parse(Estimate, "estimate", arguments).run()
