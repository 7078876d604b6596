"""Published networks of estimators that train on each record."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimators.pinn_obs import PinnObs, TrainedNetwork
from pinnobs_gym.leaderboard.published.manifest import Manifest, PublishedTraining
from pinnobs_gym.leaderboard.published.trained import opened, record_hash
from pinnobs_gym.scoring.evaluation import StandIn
from pinnobs_gym.simulation.record import Record

NEAR = 1e-6
"""Largest difference between the outputs of an episode on two machines, relative to their range:
compilers round differently."""


@dataclass(frozen=True)
class TrainedBefore(PinnObs):
    """PINN-Obs with networks that were trained earlier, on the same records."""

    networks: tuple[TrainedNetwork, ...] = field(default=(), kw_only=True, repr=False)
    """One network per row of the record."""

    def fit(self, record: Record) -> list[TrainedNetwork]:
        return list(self.networks)


def stand_in(
    estimator: PinnObs, game: Game, published: Manifest, entry: PublishedTraining
) -> StandIn | None:
    """Return what plays a published network in the place of an estimator that would train anew;
    None if the network was trained on another record.

    The record is the same if it has the same hash or, on another machine, if its times are the same
    and its outputs are the same up to `NEAR`.

    Raises:
        ValueError: in one line, if the file is not the one that was published.
    """
    assert entry.seed is not None
    record = game.record([entry.seed])
    with opened(published, entry) as path:
        network = TrainedNetwork.load(path, game.source.system, entry.trainer)
    if record_hash(record) != entry.record and not _is_near(network, record):
        return None
    system, noise = estimator.system, (estimator.noise_std, estimator.process_noise)
    player = TrainedBefore(system, *noise, config=estimator.config, networks=(network,))
    code = {name: getattr(entry, name) for name in ("estimator_code", "estimator_hash")}
    return StandIn(player, network.seconds, code)


def _is_near(network: TrainedNetwork, record: Record) -> bool:
    """Return whether a record of one episode is that of a network up to rounding."""
    y = record.y[0]
    if not np.array_equal(network.t, record.t) or network.y.shape != y.shape:
        return False
    near = NEAR * float(np.ptp(y[np.isfinite(y)]))
    return np.allclose(network.y, y, rtol=0, atol=near, equal_nan=True)
