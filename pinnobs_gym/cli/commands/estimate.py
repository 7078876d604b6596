"""`estimate ...`: estimate the states behind a sensor log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pinnobs_gym.cli.console import console
from pinnobs_gym.cli.options import parse, settings_of
from pinnobs_gym.cli.output import print_judgement, write_estimates, write_figure
from pinnobs_gym.cli.own_model import own_model
from pinnobs_gym.envs.figures import state_figure
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.files import check_writable
from pinnobs_gym.logs.judgement import judge
from pinnobs_gym.logs.reading import read_log
from pinnobs_gym.simulation.record import Prior


@dataclass(frozen=True)
class Estimate:
    """Estimate the states from a sensor log: a CSV file with columns t, y1, ... and u1, ..."""

    system: str
    """Name or module:Class of the model."""
    log: Path
    """The CSV file; sample times may be irregular, empty cells are missing outputs."""
    estimator: str = "ekf"
    """Name or module:Class of the estimator."""
    set: tuple[str, ...] = ()
    """Settings of the estimator, such as assumed_noise=0.1."""
    xhat0: tuple[float, ...] | None = None
    """Initial estimate; the benchmark's if not given."""
    P0_std: tuple[float, ...] | None = None
    """Its standard deviations; the benchmark's if not given."""
    noise_std: tuple[float, ...] = ()
    """Standard deviations of the output noise; the benchmark's if not given."""
    process_noise: tuple[float, ...] = ()
    """Standard deviations of the process noise after one second (of a map: after one step), in
    state units per √s: one for all states or one for each; the benchmark's if not given."""
    out: Path = Path("estimates.csv")
    """File of the estimates; a figure is written beside it, with the suffix .png."""
    strict: bool = False
    """End with status 1 if the judgement of the log has a warning; files are written all the
    same."""

    def run(self) -> int:
        """Estimate, and write the results."""
        system, setup = own_model(
            self.system,
            noise_std=self.noise_std,
            process_noise=self.process_noise,
            xhat0=self.xhat0,
            P0_std=self.P0_std,
        )
        log = read_log(self.log, system, Prior.of(system, setup, 1))
        system, record = log.system, log.record
        kind = ESTIMATORS.resolve(self.estimator)
        if kind.needs_training is not None:
            raise ValueError(
                f"estimator {self.estimator!r} is trained beforehand; for a log take one that is "
                f"not, or trains on the record"
            )
        picture = self.out.with_suffix(".png")
        if picture == self.out or self.log.resolve() in (self.out.resolve(), picture.resolve()):
            raise ValueError(f"out={self.out} would overwrite the log or the picture; name a .csv")
        check_writable(self.out.parent)
        estimator = kind.for_setup(system, setup, **settings_of(kind, self.set))
        estimates = estimator.run(record)
        judgement = judge(system, setup, record, estimates)
        print_judgement(judgement)
        write_estimates(self.out, system, record, estimates)
        P = None if estimates.P is None else estimates.P[0]
        title = f"{self.log.name}: {type(system).__name__}, {estimator.label}"
        figure = state_figure(system, record.t, estimates.xhat[0], y=record.y[0], P=P, title=title)
        write_figure(picture, figure)
        last = ", ".join(
            f"{name} = {value:.6g}"
            for name, value in zip(system.state_names, estimates.xhat[0, -1], strict=True)
        )
        time = f"{record.t[-1]:g}" + ("" if system.discrete else " s")
        console.print(f"{record.num_samples} samples; at t = {time}: {last}")
        console.print(f"estimates: {self.out}; picture: {picture}", soft_wrap=True)
        return 1 if self.strict and judgement.warnings else 0


def run(arguments: Sequence[str]) -> int:
    """Run the command and return its exit status."""
    return parse(Estimate, "estimate", arguments).run()
