"""Estimators as C files: their estimates against those in Python, and what they take of a
controller: bytes of code and state, and operations of an update at the benchmark's sample time."""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from export_figures.built import COMPILER, build, csv_of, replay
from export_figures.operations import operations

import pinnobs_gym
from benchmarks import Figure, at_most
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.estimation.export.c_files import c_files
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.systems import SYSTEMS

FILTERS = ("ekf", "ukf", "ckf", "luenberger", "kkl_supervised", "kkl_pinn", "kkl_autoencoder")
TOLERANCE = {False: 1e-12, True: 1e-5}
"""Largest difference of estimates over the scale, in double and in single precision."""
COUNTED = 200
"""Number of samples whose operations are counted."""


def figures(repeats: int) -> Iterator[Figure]:
    """Measure exported estimators on the first episode of each system."""
    if COMPILER is None:
        print("no C compiler; left out", file=sys.stderr)
        return
    for name in SYSTEMS.classes():
        source = EpisodeSource(name)
        record = source.record(source.play(source.draw(source.streams([0]))))
        for kind in FILTERS:
            cls = ESTIMATORS.resolve(kind)
            made = (
                pinnobs_gym.load(kind, name)
                if cls.needs_training is not None
                else cls.for_setup(source.system, source.setup)
            )
            yield from of_estimator(f"{kind}, {name}", made, record)


def of_estimator(what: str, estimator: BaseEstimator, record: Record) -> Iterator[Figure]:
    """Measure one estimator on a record."""
    for float32 in (False, True):
        off = difference(estimator, record, float32)
        precision = "single" if float32 else "double"
        title = f"{what}: largest difference of estimates over the scale, {precision}"
        yield at_most(title, off, "", TOLERANCE[float32])
    files = c_files(estimator, record.prior, "plant")
    yield Figure(f"{what}: lines", files.source.count("\n"), "", "", None)
    yield Figure(f"{what}: source", len(files.source.encode()), "bytes", "", None)
    code, state = sizes(estimator, record)
    yield Figure(f"{what}: code and constants (-Os)", code, "bytes", "", None)
    yield Figure(f"{what}: state", state, "bytes", "", None)
    count = operations(files, csv_of(record.first_samples(COUNTED), estimator.system))
    yield Figure(f"{what}: operations of an update", count, "", "", None)


def difference(estimator: BaseEstimator, record: Record, float32: bool) -> float:
    """Return the largest difference of estimates over the scale."""
    files = c_files(estimator, record.prior, "plant", float32=float32)
    with tempfile.TemporaryDirectory() as folder:
        program = build(Path(folder), files, ("-std=c99", "-O2"))
        found, _ = replay(program, csv_of(record, estimator.system))
    system, expected = estimator.system, estimator.run(record).xhat[0]
    error = system.state_residual(found[:, 1 : 1 + system.nx], expected)
    return float(abs(error / np.asarray(system.scale)).max())


def sizes(estimator: BaseEstimator, record: Record) -> tuple[int, int]:
    """Return the bytes of compiled code with its constants, and of the state."""
    files = c_files(estimator, record.prior, "plant")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "plant.h").write_text(files.header)
        (folder / "plant.c").write_text(files.source)
        (folder / "size.c").write_text(
            '#include <stdio.h>\n#include "plant.h"\n'
            'int main(void) { printf("%zu", sizeof(plant)); }\n'
        )
        flags = [str(COMPILER), "-std=c99", "-Os"]
        subprocess.run([*flags, "-c", "plant.c"], cwd=folder, check=True)
        subprocess.run([*flags, "size.c", "-o", "size"], cwd=folder, check=True)
        told = subprocess.run(["size", "plant.o"], cwd=folder, capture_output=True, text=True)
        state = subprocess.run([folder / "size"], capture_output=True, text=True, check=True)
    text, data = re.findall(r"\d+", told.stdout)[:2]
    return int(text) + int(data), int(state.stdout)
