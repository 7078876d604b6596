"""What a command shows and writes of the estimates of a log: their judgement, and files."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pinnobs_gym.cli.console import console
from pinnobs_gym.estimation.estimator import Estimates
from pinnobs_gym.files import replacing
from pinnobs_gym.logs.judgement import Judgement
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def print_judgement(judgement: Judgement) -> None:
    """Print a judgement: what is found in a block, and a line for each warning."""
    console.print("judgement of the log:")
    for fact in judgement.facts:
        console.print(f"  {fact}", soft_wrap=True)
    for warning in judgement.warnings:
        console.print(f"warning: {warning}", style="yellow", soft_wrap=True)


def write_estimates(path: Path, system: System, record: Record, estimates: Estimates) -> None:
    """Write the first episode's estimates as CSV: t, a column per state, and with covariances a
    column ``<state>_std`` of standard deviations per state. Innovations follow, with a column
    ``<output>_innovation`` per output, and their standard deviations, ``<output>_innovation_std``,
    if the estimator has them; their cells are empty where the output is missing. Before them stands
    a column ``outside`` if the estimator tells it: 1 where the estimate is that of a fallback."""
    header = ["t", *system.state_names]
    columns = [record.t[:, None], estimates.xhat[0]]
    if estimates.P is not None:
        header += [f"{name}_std" for name in system.state_names]
        columns.append(_std(estimates.P[0]))
    if estimates.outside is not None:
        header.append("outside")
        columns.append(estimates.outside[0, :, None])
    rows = np.concatenate(columns, axis=1).tolist()
    if estimates.innovation is not None:
        header += [f"{name}_innovation" for name in system.output_names]
        added = [estimates.innovation[0]]
        if estimates.S is not None:
            header += [f"{name}_innovation_std" for name in system.output_names]
            added.append(_std(estimates.S[0]))
        cells = np.concatenate(added, axis=1).astype(object)
        cells[np.tile(np.isnan(record.y[0]), len(added))] = None  # an empty cell
        rows = [row + more for row, more in zip(rows, cells.tolist(), strict=True)]
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(rows)


def _std(covariances: np.ndarray) -> np.ndarray:
    """Return the standard deviations (num_samples, n) of covariances (num_samples, n, n)."""
    return np.sqrt(np.maximum(np.diagonal(covariances, axis1=1, axis2=2), 0))


def write_figure(path: Path, figure: Figure) -> None:
    """Write a figure in the format of the path's suffix."""
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=120, format=path.suffix[1:])
