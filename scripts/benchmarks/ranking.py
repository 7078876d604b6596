"""The ranking: what a fair prior changes, whether equal estimators tie, who is told apart, and how
far all are from the floor."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import null_test
import numpy as np
import one_score

from benchmarks import Figure, at_least, at_most
from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.leaderboard.board import board
from pinnobs_gym.leaderboard.published.reading import published_floors
from pinnobs_gym.registry import trainer_class
from pinnobs_gym.scoring import rows as stored_rows
from pinnobs_gym.scoring.evaluation import evaluate, make_estimator
from pinnobs_gym.scoring.exact_bayes import LEAST_ESS
from pinnobs_gym.scoring.playing import play
from pinnobs_gym.scoring.rows import Row, Stored
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.training.by_name import load, train_by_name

EPISODES = 100
BUDGET = 45.0
"""CPU seconds of each training."""
ASKED = {
    "ukf": 0.578,
    "ckf": 0.580,
    "enkf": 0.612,
    "ekf": 0.636,
    "mhe": 0.637,
    "pinn_gain": 0.602,
    "kkl_supervised": 0.705,
    "kkl_pinn": 0.724,
}
"""Interquartile mean of NRMSE over that of the EKF with the former prior, measured before the
random numbers of the systems were independent, told the moments of the initial set."""


ROWS = Path("runs/leaderboard/rows.jsonl")
"""Rows whose errors over the floor are measured, if there are any."""


def figures(repeats: int) -> Iterator[Figure]:
    """Measure all figures of the ranking."""
    yield from with_fair_prior()
    for name, rate in null_test.made_up().items():
        yield at_least(f"null test, made-up scores, {name}: all tied", rate, "", 0.93)
    for name, rate in null_test.filter_rates().items():
        bound = None if "one seed" in name else 0.93
        yield at_least(f"null test, EnKF, {name}: all tied", rate, "", bound)
    yield from groups()
    for name, largest in one_score.differences().items():
        what = f"{name}: scores alone and in batches of 7, 60 and 256, largest relative difference"
        yield at_most(what, largest, "", 1e-12)
    rows = stored_rows.load(ROWS).rows
    yield from over_floor(rows, published_floors(map(stored_rows.game_of, rows)))


def with_fair_prior() -> Iterator[Figure]:
    """Compare estimators that are told the moments of the initial set with the EKF as it was
    before, told another prior, on the same episodes of all systems.

    The figure is exp of the interquartile mean of log(NRMSE / that EKF's) over all systems and
    episodes together, whole episode, nominal; a bootstrap over episodes gives its interval.
    """
    former = {
        name: _whole(Game.of(name, condition="poor_prior"), "ekf") for name in SYSTEMS.classes()
    }
    for estimator, asked in ASKED.items():
        ratios = [
            np.log(_whole(Game.of(name), estimator) / former[name]) for name in SYSTEMS.classes()
        ]
        rng = np.random.default_rng(0)
        drawn = [_iqm([rng.choice(each, len(each)) for each in ratios]) for _ in range(2000)]
        low, high = np.quantile(drawn, [0.025, 0.975])
        what = f"{estimator} / EKF with the former prior ({low:.3f}-{high:.3f})"
        yield Figure(what, _iqm(ratios), "", f"= {asked}", bool(low <= asked <= high))


def _whole(game: Game, name: str) -> np.ndarray:
    """Return the NRMSE of whole episodes, shape (EPISODES,)."""
    cls = ESTIMATORS.resolve(name)
    trained = _trained(cls, game.nominal) if cls.needs_training else cls
    played = play(game, make_estimator(trained, game, {}), range(EPISODES))
    scores = played.scores_alone
    return np.where(scores.diverged, np.maximum(scores.nrmse, 1.0), scores.nrmse)


def _trained(cls: type[BaseEstimator], game: Game) -> BaseEstimator:
    """Return a learned estimator, trained for `BUDGET`."""
    trainer = trainer_class(cls)
    result = train_by_name(trainer, cls.trainer_config({"budget": BUDGET}), game)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "trained.pt"
        result.save(path)
        return load(cls, path, game)


def _iqm(ratios: Sequence[np.ndarray]) -> float:
    """Return exp of the interquartile mean of all log ratios."""
    ordered = np.sort(np.concatenate(ratios))
    cut = len(ordered) // 4
    return float(np.exp(ordered[cut : len(ordered) - cut].mean()))


def groups() -> Iterator[Figure]:
    """Rank all online estimators that are not trained, nominal, over all systems."""
    rows: list[Row] = []
    for name, cls in ESTIMATORS.classes().items():
        if cls.track == "online" and not (cls.needs_training or cls.trains_on_record):
            for system in SYSTEMS.classes():
                rows += evaluate(name, system, episodes=EPISODES)
    nominal = board(Stored(rows, [])).main.conditions["nominal"]
    for window, placed in nominal.windows.items():
        for name, place in sorted(placed.items(), key=lambda item: item[1].rank or 0):
            factor = place.factor
            shown = f"{factor.value:.3g} ({factor.low:.3g}-{factor.high:.3g})"
            what = f"{window} rank of {name}, {shown} of {nominal.peer}'s error"
            yield Figure(what, float(place.rank or np.nan), "", "", None)


def over_floor(rows: Sequence[Row], shipped: Sequence[Row] = ()) -> Iterator[Figure]:
    """Compare every estimator with the floor of each game, in both windows, and tell how precise
    the floors are.

    Args:
        rows: scored episodes of estimators and, possibly, of floors.
        shipped: further rows of floors.
    """
    found = board(Stored(list(rows), []), shipped)
    for table in found.main.tables:
        game = ", ".join((table.game.system, table.game.setup, table.game.condition))
        for entry in table.entries:
            own = entry.standing
            ratios = {"steady": own.over_floor_steady, "transient": own.over_floor_transient}
            for window, ratio in ratios.items():
                if ratio is not None:
                    shown = f"({ratio.low:.3g}-{ratio.high:.3g})"
                    what = f"{game}: {entry.name} over the floor, {window} {shown}"
                    yield Figure(what, ratio.value, "", "", None)
    for (name, track), floor in sorted(found.floors.by_game.items()):
        game = ", ".join((name.system, name.setup, name.condition, track))
        known = list(floor.rows.values())
        sizes = [size for row in known if (size := row.get("effective_sample_size")) is not None]
        if sizes:
            what = f"{game}: smallest effective sample size of {len(sizes)} episodes"
            yield at_least(what, min(sizes), "", LEAST_ESS)
        errors = [error for row in known if (error := row.get("monte_carlo")) is not None]
        if errors:
            what = f"{game}: largest Monte-Carlo error of {len(errors)} episodes"
            yield Figure(what, 100 * max(errors), "%", "", None)
