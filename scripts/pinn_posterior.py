"""The preset ``posterior`` of PINN-Obs beside an extended Rauch-Tung-Striebel smoother, on the
benchmark setup."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from benchmarks import Figure, at_least, at_most

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.estimator import Estimates
from pinnobs_gym.estimators.pinn_obs import PinnObsReplay, estimates_of
from pinnobs_gym.estimators.rts_smoother import RTSSmoother
from pinnobs_gym.scoring.metrics import score
from pinnobs_gym.scoring.playing import play
from pinnobs_gym.systems import SYSTEMS
from trainers.pinn_obs import PinnObsTrainer, posterior

RECORDS = 20
"""Episodes of each system, of the seeds from 0 on."""
NOISY, PER_SAMPLE = "process_noise1e-3", 1e-3
"""A condition, and its process noise over the scale, from one sample to the next."""
WITHOUT = "InductionMotor"
"""The system whose oscillations a network of this size does not resolve, as a warning says."""


def posteriors() -> Iterator[Figure]:
    """Score five systems, without process noise and with some that is told."""
    for name in SYSTEMS.classes():
        if name != WITHOUT:
            yield from of_system(name, "nominal")
            yield from of_system(name, NOISY)


def of_system(name: str, condition: str) -> Iterator[Figure]:
    """Score the network's estimates, their covariances and the replay of its gain."""
    game = Game.of(name, "benchmark", condition)
    system, setup = game.source.system, game.source.setup
    level = setup.process_noise
    if condition == NOISY:
        level = tuple(PER_SAMPLE / np.sqrt(setup.dt) * np.asarray(system.scale))
    told = setup.noise_std, level
    peer = play(game, RTSSmoother(system, *told), range(RECORDS))
    record = peer.record
    networks = PinnObsTrainer.train_rows(
        system, posterior(), record=record, noise_std=told[0], process_noise=told[1]
    )
    replays = [
        PinnObsReplay(system, *told, trained=trained).run(record.rows(slice(i, i + 1))).xhat[0]
        for i, trained in enumerate(networks)
    ]
    parts = system, record, peer.truth
    own, replayed = (
        score(*parts, estimates, setup.transient_end).rows()
        for estimates in (estimates_of(networks, record.t), Estimates(np.stack(replays)))
    )
    smoothed = peer.scores_alone.rows()

    what = f"{name}, posterior, {condition}, {RECORDS} records"
    medians = [float(np.median([row["nrmse"] for row in rows])) for rows in (own, smoothed)]
    yield Figure(f"{what}, NRMSE, median", medians[0], "", "", None)
    ratio = medians[0] / medians[1]
    yield at_most(f"{what}, NRMSE / RTS smoother's, medians", ratio, "x", 1.1)
    worst = max(row["nrmse"] for row in own)
    yield Figure(f"{what}, NRMSE, worst", worst, "", "", None)
    yield Figure(f"{what}, ANEES, mean", mean(own, "anees"), "", "", None)
    covered = f"{what}, coverage of 90 % intervals, mean"
    value = mean(own, "coverage")
    if condition == NOISY:
        yield at_least(covered, value, "", 0.85)
        yield at_most(covered, value, "", 0.95)
    else:
        yield Figure(covered, value, "", "", None)
    yield Figure(f"{covered}, RTS smoother's", mean(smoothed, "coverage"), "", "", None)
    tails = [row["nrmse_tail"] for row in replayed]
    yield Figure(f"{what}, replay, NRMSE of the last 25 %, worst", max(tails), "", "", None)
    seconds = max(trained.seconds for trained in networks)
    yield at_most(f"{what}, training, slowest", seconds, "CPU-s", 10.0)


def mean(rows: list[dict], name: str) -> float:
    """Return the mean of a score over episodes."""
    return float(np.mean([row[name] for row in rows]))
