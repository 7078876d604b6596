"""What estimators take of what a plant may have."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
from benchmarks.plants.motion import Growth, Robertson
from made_rows import rows_of

from pinnobs_gym.envs.game import Game
from pinnobs_gym.envs.registration import register_system
from pinnobs_gym.estimation.checks import ESTIMATOR_CHECKS
from pinnobs_gym.estimation.takes import EVERYTHING, FEATURES, NotTaken, features, lacking
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.kkl import KKL
from pinnobs_gym.estimators.luenberger import Luenberger
from pinnobs_gym.estimators.open_loop import OpenLoop
from pinnobs_gym.leaderboard import ranks_table
from pinnobs_gym.leaderboard.applicable import NOT_APPLICABLE, cell_without_scores
from pinnobs_gym.leaderboard.board import board
from pinnobs_gym.leaderboard.contenders import label
from pinnobs_gym.leaderboard.jobs.plan import jobs_of
from pinnobs_gym.leaderboard.suites import Entry, Suite
from pinnobs_gym.scoring.rows import Stored
from pinnobs_gym.simulation.conformance import CheckFailed
from pinnobs_gym.simulation.noise import SampledLevel
from pinnobs_gym.simulation.system import Setup, System
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing


@dataclass(frozen=True)
class Held(System):
    """A plant with an input and two outputs."""

    state_names = ("x",)
    output_names = ("y1", "y2")
    input_names = ("u",)
    scale = (1.0,)
    setups: ClassVar = {"benchmark": Setup(-1, 1, duration=1, dt=0.1, noise_std=0.1)}

    def f(self, t, x, u):
        return u - x

    def h(self, t, x, u):
        return x + np.array([0.0, 1.0])


@pytest.mark.parametrize(
    ("system", "noise", "expected"),
    [
        (ReverseDuffing(), {}, []),
        (Growth(), {}, ["maps", "process_noise"]),
        (Robertson(), {}, ["stiff"]),
        (Held(), {}, []),
        (Held(measured_input=True), {}, ["held_input"]),
        (Held(), {"process_noise": 0.1}, ["process_noise"]),
        (Held(), {"noise_std": ((0.1, 0.0), (0.05, 0.2))}, ["full_noise"]),
        (Held(), {"noise_std": ((0.1, 0.0), (0.0, 0.2))}, []),
        (
            Held(),
            {"noise_std": SampledLevel(np.arange(3.0), np.full((1, 3, 2), 0.2))},
            ["sampled_noise"],
        ),
    ],
)
def test_what_a_plant_has(system, noise, expected):
    assert features(system, system.noise(**noise)) == expected


def test_an_estimator_without_a_declaration_takes_everything():
    assert OpenLoop.takes == EVERYTHING == set(FEATURES)


@pytest.mark.parametrize("name", list(ESTIMATORS.classes()))
def test_declarations_name_features(name):
    assert ESTIMATORS.classes()[name].takes <= EVERYTHING


def test_a_plant_that_is_not_taken_is_refused_in_one_line():
    with pytest.raises(NotTaken, match="Luenberger does not take Growth: it takes no maps") as e:
        Luenberger(Growth())
    assert "\n" not in str(e.value)
    assert "; of what a plant may have it takes stiff plants, " in str(e.value)
    assert "maps" in lacking(KKL, Growth(), Growth().noise())
    assert isinstance(e.value, ValueError)
    EKF(Growth())


def test_a_declaration_of_what_no_plant_has_fails_the_check():
    @dataclass(frozen=True)
    class Odd(OpenLoop):
        name = "odd"
        takes = frozenset({"maps", "wings"})

    with pytest.raises(CheckFailed, match="takes names wings; known are maps, "):
        ESTIMATOR_CHECKS["takes"](Odd(ReverseDuffing()))


def test_a_leaderboard_plays_what_applies_and_marks_the_rest(tmp_path):
    register_system(Growth)
    suite = Suite(
        systems=("Growth", "ReverseDuffing"),
        estimators=(Entry("ekf"), Entry("luenberger")),
        conditions=("nominal",),
    )
    jobs = jobs_of(suite, tmp_path)
    played = {(job.estimator, job.game.name.system) for job in jobs}
    assert played == {
        ("ekf", "Growth-v0"),
        ("ekf", "ReverseDuffing-v0"),
        ("luenberger", "ReverseDuffing-v0"),
    }
    game, other = (Game.of(name).name for name in ("Growth", "ReverseDuffing"))
    assert cell_without_scores("luenberger", game) == NOT_APPLICABLE
    assert cell_without_scores("luenberger", other) == ""
    assert cell_without_scores("ekf", game) == ""
    assert cell_without_scores("nobody", game) == ""


def test_the_overview_says_which_cells_do_not_apply():
    register_system(Growth)
    game = Game.of("Growth").name
    rows = [
        row
        for name, games in (
            ("ekf", ("pinnobs/Growth-v0", "pinnobs/ReverseDuffing-v0")),
            ("luenberger", ("pinnobs/ReverseDuffing-v0",)),
        )
        for env_id in games
        for row in rows_of(name, [0.1, 0.2], env_id=env_id, game_hash=env_id)
    ]
    part = board(Stored(rows, [])).main
    grid = ranks_table.grid(part.lines, part.places.peer)
    column = list(grid.header).index(label(game))
    cells = {line[1]: line[column] for line in grid.lines}
    assert cells["luenberger"] == NOT_APPLICABLE
    assert cells["ekf"] != NOT_APPLICABLE
