"""The errors of each state, in its unit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pinnobs_gym.leaderboard.grid import Column, Grid
from pinnobs_gym.leaderboard.numerals import number
from pinnobs_gym.scoring.metrics import STATE_WINDOWS
from pinnobs_gym.scoring.rows import Row
from pinnobs_gym.simulation.system import System


def by_state(system: System, rows: Sequence[Row]) -> Grid:
    """Return the table of the median RMSE of each state over episodes, by window.

    Args:
        system: the plant, for its names and units.
        rows: of one estimator in one game.
    """
    lines = []
    for name in system.state_names:
        errors = []
        for window in STATE_WINDOWS:
            found = [row["state_rmse"][window].get(name, np.nan) for row in rows]
            known = [error for error in found if not np.isnan(error)]
            errors.append(number(float(np.median(known))) if known else "")
        lines.append((name, system.units.get(name, ""), *errors))
    columns = (
        Column("state", numeric=False),
        Column("unit", numeric=False),
        *(Column(f"RMSE, {window}") for window in STATE_WINDOWS),
    )
    return Grid("Median error of each state", columns, tuple(lines))
