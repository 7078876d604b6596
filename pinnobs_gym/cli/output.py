"""Writing of result files: estimates and figures."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pinnobs_gym.estimation.estimator import Estimates
from pinnobs_gym.files import replacing
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_estimates(path: Path, system: System, record: Record, estimates: Estimates) -> None:
    """Write the first episode's estimates as CSV: t, a column per state, and with covariances a
    column ``<state>_std`` of standard deviations per state."""
    header = ["t", *system.state_names]
    columns = [record.t[:, None], estimates.xhat[0]]
    if estimates.P is not None:
        header += [f"{name}_std" for name in system.state_names]
        variance = np.diagonal(estimates.P[0], axis1=1, axis2=2)
        columns.append(np.sqrt(np.maximum(variance, 0)))
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(np.concatenate(columns, axis=1).tolist())


def write_figure(path: Path, figure: Figure) -> None:
    """Write a figure in the format of the path's suffix."""
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=120, format=path.suffix[1:])
