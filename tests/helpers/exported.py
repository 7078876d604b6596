"""Exported C files, compiled, and the estimates of a record that they give."""

import os
import shutil
import subprocess

import numpy as np
import pytest

from pinnobs_gym.export.c_files import c_files

COMPILER = os.environ.get("CC") or shutil.which("gcc") or shutil.which("clang")
needs_c = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler")
FLAGS = ("-std=c99", "-O1", "-Wall", "-Wextra", "-pedantic", "-Werror")
SANITIZERS = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")


def build(folder, estimator, prior, *, sanitize=True, **options):
    """Write and compile the files of an estimator, and return the program that replays."""
    files = c_files(estimator, prior, "plant", **options)
    for name, text in (
        ("plant.h", files.header),
        ("plant.c", files.source),
        ("plant_replay.c", files.replay),
    ):
        (folder / name).write_text(text)
    flags = [*FLAGS, *(SANITIZERS if sanitize else ())]
    command = [COMPILER, *flags, "plant.c", "plant_replay.c", "-lm", "-o", "replay"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    return folder / "replay"


def csv_of(record, system):
    """The first row of a record as the CSV file that the program reads."""
    measured = system.nu and system.measured_input
    lines = [",".join(["t", *system.output_names, *(system.input_names if measured else ())])]
    for k, t in enumerate(record.t.tolist()):
        y = ["" if np.isnan(v) else repr(v) for v in record.y[0, k].tolist()]
        u = [repr(v) for v in record.u[0, k].tolist()] if measured else []
        lines.append(",".join([repr(t), *y, *u]))
    return "\n".join(lines) + "\n"


def replay(program, text):
    """Run the program on a CSV file. Returns its numbers (num_samples, 1 + n), and what it says."""
    done = subprocess.run([program], input=text, capture_output=True, text=True, check=False)
    rows = [[float(cell) for cell in line.split(",")] for line in done.stdout.splitlines()]
    return np.array(rows), done.stderr


def assert_replays(program, estimator, record, tolerance):
    """Check that the program gives the estimates and standard deviations of the first row."""
    system = estimator.system
    record = record.rows(slice(0, 1))
    found, said = replay(program, csv_of(record, system))
    assert not said
    expected = estimator.run(record)
    scale = np.asarray(system.scale, dtype=float)
    error = system.state_residual(found[:, 1 : 1 + system.nx], expected.xhat[0]) / scale
    assert abs(error).max() <= tolerance
    if expected.P is not None:
        std = np.sqrt(np.einsum("kii->ki", expected.P[0]))
        assert (abs(found[:, 1 + system.nx :] - std) / scale).max() <= tolerance
