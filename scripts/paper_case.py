"""Episodes of the paper setup with their true states, for the benchmark of PINN-Obs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimators.pinn_obs import PinnObsReplay, TrainedNetwork
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import System
from pinnobs_gym.simulation.truth import truth
from pinnobs_gym.training.loop import train
from trainers.pinn_obs import PinnObsConfig, PinnObsTrainer


@dataclass(frozen=True)
class Case:
    """An episode of the paper setup with its truth."""

    system: System
    record: Record
    x: np.ndarray
    """True states at the samples, shape (num_samples, nx)."""

    @staticmethod
    def of(name: str) -> Case:
        """Return the episode shown in the paper."""
        source = EpisodeSource(name, "paper")
        played = source.play(source.draw(source.streams([0])))
        record = source.record(played)
        return Case(source.system, record, played.x[: record.num_samples, 0])

    def elsewhere(self, x0: list[float], xhat0: list[float]) -> Case:
        """Return an episode of the same plant from another initial state and estimate."""
        record = self.record
        x = truth(self.system, np.array([x0]), record.t, None)[:, 0]
        prior = Prior(np.array([xhat0]), record.prior.cov)
        y = self.system.h(record.t, x, record.u[0])
        return Case(self.system, replace(record, y=y[None], prior=prior), x)

    def noisy(self, std: float, seed: int) -> Case:
        """Return the same episode with noise on its outputs."""
        noise = std * np.random.default_rng(seed).standard_normal(self.record.y.shape)
        return replace(self, record=replace(self.record, y=self.record.y + noise))

    def trained(self, config: PinnObsConfig, noise_std: float = 0.0) -> TrainedNetwork:
        """Train on this record."""
        return train(PinnObsTrainer(self.system, config, record=self.record, noise_std=noise_std))

    def rmse(self, xhat: np.ndarray) -> float:
        """Return the root mean square error over all states and samples, as in the paper."""
        return float(np.sqrt(np.mean((xhat - self.x) ** 2)))

    def direct(self, trained: TrainedNetwork) -> float:
        """Return the RMSE of the network's own estimates."""
        return self.rmse(trained.xhat(self.record.t))

    def replayed(self, trained: TrainedNetwork) -> float:
        """Return the RMSE of the observer with the learned gain; not finite if it diverges."""
        with np.errstate(all="ignore"):
            return self.rmse(PinnObsReplay(self.system, trained=trained).run(self.record).xhat[0])
