"""The table of each state's error."""

import numpy as np
from made_rows import rows_of

from pinnobs_gym.leaderboard.states_table import by_state
from pinnobs_gym.systems import SYSTEMS


def test_medians_of_each_state_are_over_the_episodes_that_have_it():
    system = SYSTEMS.resolve("InductionMotor")()
    first, second, *others = system.state_names
    rows = rows_of("ekf", [0.1] * 4)
    errors = [(1.0, 0.5), (3.0, 0.25), (2.0, np.inf), (9.0, None)]
    for row, (transient, steady) in zip(rows, errors, strict=True):
        row["state_rmse"] = {
            "transient": {first: transient},
            "steady": {} if steady is None else {first: 2 * transient, second: steady},
        }
    grid = by_state(system, rows)
    assert grid.header == ("state", "unit", "RMSE, transient", "RMSE, steady")
    units = [system.units.get(name, "") for name in system.state_names]
    assert grid.lines == (
        (first, units[0], "2.5", "4"),
        (second, units[1], "", "0.5"),
        *((name, unit, "", "") for name, unit in zip(others, units[2:], strict=True)),
    )
