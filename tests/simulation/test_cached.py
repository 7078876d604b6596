"""What is computed once per plant."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from linear import Linear

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.luenberger import Luenberger
from pinnobs_gym.simulation.cached import cached_by_plant


@dataclass(frozen=True)
class Table(Linear):
    """The same equations with parameters that have no hash."""

    rows: Any = field(default_factory=lambda: np.array([2.0, 0.3]))


@pytest.mark.parametrize("rows", [np.array([2.0, 0.3]), [2.0, 0.3], {"a": 1.0}, lambda: 1.0])
@pytest.mark.parametrize("cls", [EKF, Luenberger])
def test_a_plant_may_have_parameters_of_any_kind(cls, rows):
    source = EpisodeSource(Linear)
    record = source.record(source.play(source.draw(source.streams(range(2)))))
    plain, table = (cls(system).run(record).xhat for system in (Linear(), Table(rows=rows)))
    np.testing.assert_array_equal(table, plain)
    own = EpisodeSource(Table)
    record = own.record(own.play(own.draw(own.streams([0]))))
    assert np.isfinite(cls(Table()).run(record).xhat).all()


def test_equal_plants_share_a_result_and_others_do_not():
    made = []

    @cached_by_plant
    def counted(system, value):
        made.append((system, value))
        return len(made)

    one, same, other = (Table(rows=np.array(row)) for row in ([1.0, 2.0], [1.0, 2.0], [1.0, 3.0]))
    assert [counted(one, 5), counted(same, 5), counted(other, 5), counted(one, 6)] == [1, 1, 2, 3]
    assert counted(Linear(), 5) == 4
    unpicklable = Table(rows=lambda: 1.0)
    assert [counted(unpicklable, 5), counted(unpicklable, 5)] == [5, 6]
    for value in range(100):
        counted(one, value)
    assert counted(one, 99) == counted(same, 99) == len(made)
