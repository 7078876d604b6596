"""What a long log costs from the command to its estimates, and which wrong logs are told."""

from __future__ import annotations

import csv
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from benchmarks import Figure, at_least, at_most, cpu_seconds

from log_figures.recorded import Car
from pinnobs_gym.logs.formulas import parsed
from pinnobs_gym.logs.reading import read_log
from pinnobs_gym.simulation.record import Prior

ROWS = 37_000
"""Number of rows of the log."""
DT = 0.02
"""Time between them in s."""
SCRIPTS = Path(__file__).parents[1]
UNITS = (1e-9, 1e-6, 1e-3, 1e3, 1e6, 1e9)
"""Factors by which times are in a wrong unit."""
HOSTILE = (
    "9**9**9",
    "(" * 60 + "t" + ")" * 60,
    "(" * 10**6,
    "-" * 400 + "t",
    "t**" * 150 + "t",
    "__import__('os').system('true')",
    "t.__class__",
    "[t for t in t]",
    "open(t)",
    "lambda: t",
)
"""Formulas that are none, or have no finite value."""


def figures(repeats: int) -> Iterator[Figure]:
    """Measure the command on a plant without written Jacobians, then the reading alone."""
    with tempfile.TemporaryDirectory() as folder:
        log, moments = Path(folder) / "log.csv", Path(folder) / "dates.csv"
        write(log, [f"{t:.9g}" for t in DT * np.arange(ROWS)])
        write(moments, dates())
        for kernels, told, bound in (("1", "", 5.0), ("0", ", without a C compiler", None)):
            spent = [command(log, kernels) for _ in range(1 + (repeats if bound else 0))]
            what = f"pinnobs estimate, {ROWS} rows of a car, no Jacobians{told}"
            yield Figure(f"{what}: first call", spent[0], "CPU-s", "", None)
            if bound:
                yield at_most(f"{what}: later calls", float(np.median(spent[1:])), "CPU-s", bound)
        for path, kind in ((log, "numbers"), (moments, "dates")):
            seconds = np.median([cpu_seconds(lambda path=path: read(path)) for _ in range(repeats)])
            yield at_most(f"reading {ROWS} rows, times as {kind}", float(seconds), "CPU-s", 1.0)
        yield from told_units(Path(folder))
    yield from refused_formulas()


def write(path: Path, times: list[str]) -> None:
    """Write the log of a car on a curved road, with a position each second."""
    rng, t = np.random.default_rng(0), DT * np.arange(ROWS)
    gyro, acc = 0.1 * np.sin(0.05 * t), 0.5 * np.sin(0.1 * t)
    heading, speed = 2 * (1 - np.cos(0.05 * t)), 10 + 5 * (1 - np.cos(0.1 * t))
    px, py = (np.cumsum(DT * speed * part(heading)) for part in (np.cos, np.sin))
    noise = rng.standard_normal((5, ROWS)) * np.array([[0.5], [0.5], [0.2], [0.01], [0.1]])
    seen = np.array([px, py, speed, gyro + 0.01, acc]) + noise
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["t", *Car.output_names, *Car.input_names])
        for k, row in enumerate(seen.T.tolist()):
            fix = row[:2] if k % 50 == 0 else ["", ""]
            writer.writerow([times[k], *fix, *row[2:]])


def dates() -> list[str]:
    """Return the times as dates by ISO 8601."""
    start = np.datetime64("2026-03-01T12:00:00.000")
    steps = np.arange(ROWS) * np.timedelta64(round(1000 * DT), "ms")
    return [f"{moment}Z" for moment in start + steps]


def command(log: Path, kernels: str) -> float:
    """Return the CPU time of the command in a process of its own, in s."""
    call = [sys.executable, "-m", "pinnobs_gym.cli", "estimate"]
    call += ["--system", "log_figures.recorded:Car", "--log", str(log)]
    call += ["--out", str(log.with_name("estimates.csv"))]
    own = {name: value for name, value in os.environ.items() if name != "OPENBLAS_CORETYPE"}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        call,
        cwd=SCRIPTS,
        env={**own, "PINNOBS_KERNELS": kernels},
        check=True,
        stdout=subprocess.DEVNULL,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


def read(path: Path) -> None:
    """Read the log."""
    system, setup = Car.configured()
    read_log(path, system, Prior.of(system, setup, 1))


def told_units(folder: Path) -> Iterator[Figure]:
    """Count the wrong units of time, at steps a little off the setup's, that are told."""
    path, told, count = folder / "unit.csv", 0, 0
    for unit in UNITS:
        for step in (0.4, 1.0, 2.5):
            names = ",".join([*Car.output_names, *Car.input_names])
            rows = (f"{unit * step * DT * k!r},1,1,1,0,0" for k in range(20))
            path.write_text("\n".join([f"t,{names}", *rows]))
            count += 1
            try:
                read(path)
            except ValueError as error:
                told += "as if it were in another unit; give --columns" in str(error)
    yield at_least(f"wrong units of time that are told, of {count}", told, "", count)


def refused_formulas() -> Iterator[Figure]:
    """Count hostile formulas that are refused or not finite, and time the slowest."""
    refused, slowest = 0, 0.0
    for text in HOSTILE:

        def tried(text: str = text) -> bool:
            try:
                values = parsed(text).values({"t": np.ones(3)}, 3)
            except ValueError:
                return True
            return not np.isfinite(values).any()

        slowest = max(slowest, cpu_seconds(tried))
        refused += tried()
    yield at_least(
        f"hostile formulas that give nothing, of {len(HOSTILE)}", refused, "", len(HOSTILE)
    )
    yield at_most("the slowest of them", 1e3 * slowest, "ms", 10.0)
