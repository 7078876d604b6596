"""`export ESTIMATOR ...`: write an estimator as C, for other programs and controllers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro

from pinnobs_gym.cli.console import console
from pinnobs_gym.cli.options import parse, settings_of
from pinnobs_gym.cli.own_model import ModelOptions
from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.estimation.export.c_files import CFiles, c_files
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.files import check_writable, replacing
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.system import Setup, System


@dataclass(frozen=True)
class Export:
    """Write an estimator as one C99 file and a header, without allocation or dependencies, and a
    main program that replays a CSV file."""

    system: str
    """Name or module:Class of the model."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The C file, NAME.c; NAME begins the names of its functions. NAME.h and NAME_replay.c are
    written beside it."""
    trained: Path | None = None
    """File of a trained estimator."""
    set: tuple[str, ...] = ()
    """Settings of the estimator, such as assumed_noise=0.1."""
    float32: bool = False
    """Whether numbers are of single precision; times remain double."""
    measured_input: bool = False
    """Whether the inputs are given with each sample, rather than by the equations of the model."""

    model: ModelOptions = field(default_factory=ModelOptions)
    """What the model is told."""

    def write(self, estimator: str) -> int:
        """Write the files of an estimator, given by its name or ``module:Class``."""
        if self.out.suffix != ".c":
            raise ValueError(f"out={self.out}; expected the name of a C file, NAME.c")
        paths = [self.out.with_suffix(".h"), self.out]
        paths.append(self.out.with_name(f"{self.out.stem}_replay.c"))
        for path in paths:
            if path.exists():
                raise ValueError(f"{path} already exists; expected the name of a new file")
        check_writable(self.out.parent)
        system, setup = self.model.told(self.system)
        known = type(system).input is not System.input
        if system.nu and (self.measured_input or not known):
            system = replace(system, measured_input=True)
        made = self._estimator(estimator, system, setup)
        prior = Prior.of(system, setup, 1)
        files = c_files(made, prior, self.out.stem, float32=self.float32)
        for path, text in zip(paths, (files.header, files.source, files.replay), strict=True):
            with replacing(path) as temporary:
                temporary.write_text(text, encoding="utf-8", newline="\n")
        self._report(files, paths)
        return 0

    def _estimator(self, name: str, system: System, setup: Setup) -> BaseEstimator:
        """Return the estimator to write."""
        cls = ESTIMATORS.resolve(name)
        if cls.needs_training is None:
            if self.trained is not None:
                raise ValueError(f"trained={self.trained}: estimator {name!r} is not trained")
            return cls.for_setup(system, setup, **settings_of(cls, self.set))
        if self.trained is None:
            raise ValueError(
                f"estimator {name!r} is trained first; give the file with --trained FILE"
            )
        if self.set:
            raise ValueError(
                f"set={' '.join(self.set)}: the settings of {name!r} are those of its trained file"
            )
        from pinnobs_gym.estimation.learned.trained import LearnedEstimator

        assert issubclass(cls, LearnedEstimator)
        return cls.load(self.trained, system)

    def _report(self, files: CFiles, paths: list[Path]) -> None:
        header, source, replay = paths
        lines = files.source.count("\n")
        console.print(f"{source} ({lines} lines), {header}, {replay}", soft_wrap=True)
        for note in files.notes:
            console.print(note, soft_wrap=True, highlight=False)
        program = replay.with_suffix("")
        console.print(
            f"checksum {files.checksum}; to replay a record: cc -std=c99 -O2 {source} {replay} -lm "
            f"-o {program} && ./{program} < log.csv",
            soft_wrap=True,
            highlight=False,
        )


def run(arguments: Sequence[str]) -> int:
    """Run the command and return its exit status."""
    if arguments and arguments[0] in ("-h", "--help"):
        return parse(Export, "export ESTIMATOR", arguments).write("")
    if not arguments or arguments[0].startswith("-"):
        raise ValueError("name an estimator first: pinnobs export ekf --system ...")
    return parse(Export, f"export {arguments[0]}", arguments[1:]).write(arguments[0])
