"""`fit ...`: find a model's parameters, or its noise, from sensor logs."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from pinnobs_gym.cli.console import console, print_next, print_table
from pinnobs_gym.cli.fit_figure import fit_figure
from pinnobs_gym.cli.options import parse
from pinnobs_gym.cli.output import write_figure
from pinnobs_gym.cli.own_model import ModelOptions
from pinnobs_gym.files import check_writable, replacing
from pinnobs_gym.leaderboard.grid import Column, Grid
from pinnobs_gym.logs.fit import Fit as Fitted
from pinnobs_gym.logs.fit import Found, fit
from pinnobs_gym.logs.reading import read_log
from pinnobs_gym.logs.unknown import unknown_parameters
from pinnobs_gym.simulation.augmented_system import Augmented
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.system import System


@dataclass(frozen=True)
class Fit:
    """Find a model's parameters, its noise, or both, from sensor logs (see `pinnobs estimate`)."""

    system: str
    """Name or module:Class of the model."""
    log: tuple[Path, ...]
    """CSV files as for pinnobs estimate. Each has an initial state of its own; the parameters are
    those of all."""
    columns: tuple[str, ...] = ()
    """Columns of other names or units, such as t=millis*1e-3."""
    parameters: tuple[str, ...] = ()
    """The unknown parameters, each as k, k=START or k=START,LOW,HIGH; the search begins at the
    model's own value if none is given, and -inf or inf is no bound."""
    noise: bool = False
    """Find the noise, too: a standard deviation for each output, and the size of the model's
    process noise."""
    model: ModelOptions = field(default_factory=ModelOptions)
    """What the model is told."""
    picture: Path = Path("fit.png")
    """File of the figure: measured and fitted outputs, and residuals."""
    out: Path | None = None
    """A JSON file of what was found; none if not given."""

    def run(self) -> int:
        """Fit, print what was found and write the figure."""
        system, setup = self.model.told(self.system)
        if not self.parameters and not self.noise:
            listed = ", ".join(system.parameters) or "none"
            raise ValueError(
                "nothing to find; give --parameters, --noise or both (parameters of "
                f"{type(system).__name__}: {listed})"
            )
        self._check_files()
        parameters = unknown_parameters(system, self.parameters)
        logs = [
            read_log(path, system, Prior.of(system, setup, 1), self.columns) for path in self.log
        ]
        with console.status("fit") as status:
            made = fit(
                logs, setup, parameters, self.noise, lambda text: status.update(f"fit: {text}")
            )
        self._print(made, sum(int(np.count_nonzero(~np.isnan(log.record.y))) for log in logs))
        write_figure(self.picture, fit_figure(logs, made))
        console.print(f"picture: {self.picture}", soft_wrap=True)
        if self.out is not None:
            with replacing(self.out) as temporary:
                temporary.write_text(json.dumps(facts(made), indent=1) + "\n", encoding="utf-8")
            console.print(f"values: {self.out}", soft_wrap=True)
        columns = ["--columns", *self.columns] if self.columns else []
        told = self.model
        if (found := noise_found(made)) is not None:
            process = found.process_noise or told.process_noise
            told = replace(told, noise_std=found.noise_std, process_noise=process)
        words = [*columns, *told.words()]
        print_next("estimate", "--system", self.system, "--log", *self.log, *words)
        return 0

    def _check_files(self) -> None:
        logs = [path.resolve() for path in self.log]
        if not logs:
            raise ValueError("no log is given; expected --log FILE ...")
        twice = next((path for i, path in enumerate(logs) if path in logs[:i]), None)
        if twice is not None:
            raise ValueError(f"log {twice.name} is given twice; expected once")
        for name, path in (("picture", self.picture), ("out", self.out)):
            if path is not None and path.resolve() in logs:
                raise ValueError(f"{name}={path} would overwrite a log")
            if path is not None:
                check_writable(path.parent)
        if not self.picture.suffix:
            raise ValueError(f"picture={self.picture}; expected a name such as fit.png")

    def _print(self, made: Fitted, outputs: int) -> None:
        names = self.log[0].name if len(self.log) == 1 else f"{len(self.log)} logs"
        console.print(f"{names}: {outputs} outputs, {made.method}", soft_wrap=True)
        print_table([[table(made.found)]])
        for name, own in zip(made.system.output_names, made.residuals, strict=True):
            if math.isfinite(own.ratio):
                line = f"residuals of {name}: {own.ratio:.3g} of the expected size"
                if math.isfinite(own.serial):
                    line += f", correlation {own.serial:.2f} from one sample to the next"
                console.print(line, soft_wrap=True)
        for warning in made.warnings:
            console.print(f"warning: {warning}", style="yellow", soft_wrap=True)
        for line in to_paste(made):
            console.print(line, soft_wrap=True)


def table(found: Sequence[Found]) -> Grid:
    """Return the table of what was found."""
    columns = (
        Column("", numeric=False),
        Column("unit", numeric=False),
        Column("value"),
        Column("standard error"),
    )
    lines = []
    for each in found:
        digits = 6
        if 0 < each.std < math.inf and each.value:  # two digits of the standard error
            digits = max(
                2, 2 + math.floor(math.log10(abs(each.value))) - math.floor(math.log10(each.std))
            )
        error = "at its bound" if math.isnan(each.std) else f"{each.std:.2g}"
        error = "not determined" if math.isinf(each.std) else error
        lines.append((each.name, each.unit, f"{each.value:.{digits}g}", error))
    return Grid("", columns, tuple(lines))


def to_paste(made: Fitted) -> list[str]:
    """Return lines with what was found, as code and as options of commands."""
    lines, parameters, plant = [], made.system.parameters, _plant(made)
    named = [f"{each.name}={each.value:.8g}" for each in made.found if each.name in parameters]
    if named:
        lines.append(f"in Python: {type(plant).__name__}({', '.join(named)})")
    options = noise_found(made)
    if options is not None:
        lines.append(f"as options: {' '.join(options.words())}")
        if not options.process_noise:
            lines.append(f"Setup.process_noise: {np.round(_levels(made), 12).tolist()}")
    return lines


def noise_found(made: Fitted) -> ModelOptions | None:
    """Return what was found of the noise as options of the model, None if it was not asked for.
    Process noise that is correlated between states cannot be one of them, and is left out."""
    if made.noise is None:
        return None
    found = ModelOptions(noise_std=tuple(_rounded(value) for value in made.noise.noise_std))
    if made.noise.perhaps_none:
        return replace(found, process_noise=(0.0,))
    L = _levels(made)
    if L.shape[0] != L.shape[1] or np.count_nonzero(L) != np.count_nonzero(np.diag(L)):
        return found
    std = {each.name: each.std for each in made.found}
    known = [std.get(f"process noise of {name}", 0.0) for name in _plant(made).state_names]
    levels = zip(np.diag(L), known, strict=True)
    process = tuple(_rounded(value) if error < value else 0.0 for value, error in levels)
    return replace(found, process_noise=process)


def _plant(made: Fitted) -> System:
    """Return the system of a fit without its unknown constants."""
    plant = made.system
    while isinstance(plant, Augmented):
        plant = plant.plant
    return plant


def _levels(made: Fitted) -> np.ndarray:
    """Return the process noise found, (nx, noises), that of the plant's own states."""
    assert made.noise is not None
    nx = _plant(made).nx
    L = made.noise.process_noise[:nx]
    return L if L[:, nx:].any() else L[:, :nx]


def _rounded(value: float) -> float:
    """Return a number with four digits."""
    return float(f"{value:.4g}")


def facts(made: Fitted) -> dict[str, object]:
    """Return what was found as plain values; a standard error that is none is None."""
    found = {
        each.name: {
            "value": each.value,
            "standard_error": each.std if math.isfinite(each.std) else None,
            "unit": each.unit,
        }
        for each in made.found
    }
    return {
        "system": type(made.system).__name__,
        "method": made.method,
        "found": found,
        "correlation": made.correlation.tolist(),
        "warnings": list(made.warnings),
    }


def run(arguments: Sequence[str]) -> int:
    """Run the command and return its exit status."""
    return parse(Fit, "fit", arguments).run()
