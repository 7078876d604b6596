"""Exported files, compiled, and the numbers that they print of a record."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pinnobs_gym.estimation.export.c_files import CFiles
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System

COMPILER = os.environ.get("CC") or shutil.which("gcc") or shutil.which("clang")
"""The C compiler; None if there is none."""
FLAGS = ("-std=c99", "-O1", "-Wall", "-Wextra", "-pedantic", "-Werror")
SANITIZERS = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")


def build(folder: Path, files: CFiles, flags: Sequence[str]) -> Path:
    """Write and compile the files of an estimator, and return the program that replays.

    Raises:
        RuntimeError: with what the compiler says, if it says anything.
    """
    name = files.name
    texts = {f"{name}.h": files.header, f"{name}.c": files.source, f"{name}_replay.c": files.replay}
    for file, text in texts.items():
        (folder / file).write_text(text, encoding="utf-8")
    command = [str(COMPILER), *flags, f"{name}.c", f"{name}_replay.c", "-lm", "-o", "replay"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode or done.stderr:
        raise RuntimeError(done.stderr)
    return folder / "replay"


def csv_of(record: Record, system: System) -> str:
    """Return the first row of a record as the CSV file that the program reads."""
    measured = bool(system.nu) and system.measured_input
    lines = [",".join(["t", *system.output_names, *(system.input_names if measured else ())])]
    for k, t in enumerate(record.t.tolist()):
        y = ["" if np.isnan(v) else repr(v) for v in record.y[0, k].tolist()]
        u = [repr(v) for v in record.u[0, k].tolist()] if measured else []
        lines.append(",".join([repr(t), *y, *u]))
    return "\n".join(lines) + "\n"


def replay(program: Path, text: str) -> tuple[np.ndarray, str]:
    """Run the program on a CSV file. Return its numbers (num_samples, 1 + n), and what it says."""
    done = subprocess.run([program], input=text, capture_output=True, text=True, check=False)
    rows = [[float(cell) for cell in line.split(",")] for line in done.stdout.splitlines()]
    return np.array(rows), done.stderr
