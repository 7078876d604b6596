"""PINN-Obs: the fast and the paper's recipe, gains replayed, on all six systems."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from plain_network import Network

from benchmarks import Figure, at_most, cpu_seconds
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimation.learned.mlp import Architecture
from pinnobs_gym.estimators.pinn_obs import PinnObsReplay, TrainedNetwork
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import System
from pinnobs_gym.simulation.truth import truth
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.training.loop import train
from trainers.pinn_obs import PinnObsConfig, PinnObsTrainer, paper, transfer

SEEDS = range(5)
PAPER_ITERATIONS = 101_431
"""Iterations of the paper's best training (its table of depths and widths, 9×20)."""
LOSS, RMSE = 9.56e-4, 0.0562
"""Loss and RMSE of that training."""
EKF_RMSE = {
    "ReverseDuffing": 0.0216,
    "HarmonicOscillator": 0.168,
    "Academic": 0.0212,
    "ModifiedAcademic": 0.0154,
    "Satellite": 0.0372,
    "InductionMotor": 0.0102,
}
"""RMSE of an independent EKF over the whole episode of the paper setup, without noise."""


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


def figures(repeats: int) -> Iterator[Figure]:
    """Measure all figures of PINN-Obs."""
    duffing = Case.of("ReverseDuffing")
    plain, own = iteration_seconds(duffing, max(repeats, 3))
    whole = plain * PAPER_ITERATIONS
    yield Figure("paper's recipe, plain autograd, per iteration", plain * 1e3, "ms", "", None)
    yield at_most("paper preset / plain autograd, per iteration", own / plain, "x", 0.5)
    yield Figure("R, the paper's iterations in plain autograd", whole, "CPU-s", "", None)
    for depth, part in ((3, 1000), (9, 250)):
        times = [seconds_to_paper(duffing, depth, seed, whole / 100) for seed in SEEDS]
        what = f"ReverseDuffing, {depth}x20, to the paper's loss and RMSE"
        yield Figure(f"{what}, median of seeds", float(np.median(times)), "CPU-s", "", None)
        yield at_most(
            f"{what}, slowest of {len(SEEDS)} seeds, over R", max(times) / whole, "", 1 / part
        )
    yield from replays(duffing, whole / 350)
    yield from transfers(duffing)
    for name in SYSTEMS.classes():
        yield from paper_setup(name)


def iteration_seconds(case: Case, repeats: int) -> tuple[float, float]:
    """Measure the CPU seconds of an iteration of the paper's recipe: plain autograd's, and ours."""
    torch.set_num_threads(1)
    run = PinnObsTrainer(case.system, paper(), record=case.record, noise_std=0.0)
    peer = plain_iteration(case)
    batch = 10
    times = []
    for _ in range(repeats + 1):  # the first repeat fills caches
        theirs = cpu_seconds(lambda: [peer() for _ in range(batch)])
        times.append((theirs, cpu_seconds(lambda: [run.step() for _ in range(batch)])))
    plain, own = np.median(times[1:], axis=0) / batch
    return float(plain), float(own)


def plain_iteration(case: Case) -> Callable[[], None]:
    """Return a function that makes an iteration of the paper's recipe in plain torch.

    dx̂/dt is computed by a reverse pass per state, and the gradient of the loss by another reverse
    pass through these; the optimiser is Adam.
    """
    system, record = case.system, case.record
    chosen = np.sort(np.random.default_rng(0).permutation(record.num_samples)[:6000])
    t = torch.tensor(record.t[chosen], dtype=torch.float32, requires_grad=True)
    y = torch.tensor(record.y[0, chosen], dtype=torch.float32)
    u, start = torch.zeros(len(t), 0), torch.tensor([record.t[0]], dtype=torch.float32)
    xhat0 = torch.tensor(record.prior.mean[0], dtype=torch.float32)
    network = Network(Architecture(system.nx, system.ny))
    adam = torch.optim.Adam(network.parameters(), lr=1e-3)

    def iterate() -> None:
        xhat, L = network(t)
        rates = [
            torch.autograd.grad(xhat[:, i].sum(), t, create_graph=True)[0] for i in range(system.nx)
        ]
        innovation = y - system.h(t, xhat, u)
        residual = torch.stack(rates, -1) - system.f(t, xhat, u)
        residual = residual - (L @ innovation[..., None])[..., 0]
        loss = ((network(start)[0] - xhat0) ** 2).sum() + (residual**2).sum(-1).mean()
        loss = loss + (innovation**2).sum(-1).mean()
        adam.zero_grad()
        loss.backward()
        adam.step()

    return iterate


def seconds_to_paper(case: Case, depth: int, seed: int, limit: float) -> float:
    """Measure the CPU seconds of the fast recipe until loss and RMSE reach the paper's.

    They are checked every ten iterations. The result is infinite if the limit is exceeded.
    """
    spent, start = 0.0, time.process_time()
    config = PinnObsConfig(depth=depth, seed=seed)
    run = PinnObsTrainer(case.system, config, record=case.record, noise_std=0.0)
    while not run.finished():
        for _ in range(10):
            run.step()
        spent += time.process_time() - start
        if spent > limit:
            break
        trained = run.result()
        if trained.loss <= LOSS and case.direct(trained) <= RMSE:
            return spent
        start = time.process_time()
    return float("inf")


def replays(case: Case, budget: float) -> Iterator[Figure]:
    """Score the gain on its training record, without and with output noise."""
    for std, asked in ((0.0, 0.021), (0.05, 0.025)):
        values = []
        for seed in SEEDS:
            one = case.noisy(std, seed) if std else case
            config = PinnObsConfig(seed=seed, budget=budget)
            values.append(one.replayed(one.trained(config, std)))
        what = f"ReverseDuffing, replay on the own record, noise {std:g}, RMSE"
        yield at_most(f"{what}, median of {len(SEEDS)} seeds", float(np.median(values)), "", asked)
        yield at_most(f"{what}, worst", max(values), "", asked)


def transfers(case: Case) -> Iterator[Figure]:
    """Score a gain of the preset ``transfer`` on a record that it was not trained on."""
    other = case.elsewhere([1.0, 1.5], [0.0, 0.0])
    own, elsewhere = [], []
    for seed in SEEDS:
        trained = case.trained(replace(transfer(), seed=seed))
        own.append(case.replayed(trained))
        elsewhere.append(other.replayed(trained))
    what = "ReverseDuffing, gain meant to transfer, RMSE, worst of seeds"
    yield at_most(f"{what}, from x0=[1, 1.5], xhat0=[0, 0]", max(elsewhere), "", 0.08)
    yield at_most(f"{what}, own record", max(own), "", 0.26)


def paper_setup(name: str) -> Iterator[Figure]:
    """Score the network's estimates and the replay of its gain on a system's paper setup."""
    case = Case.of(name)
    results = []
    for seed in SEEDS:
        trained = case.trained(PinnObsConfig(seed=seed))
        results.append((case.direct(trained), case.replayed(trained), trained.seconds))
    direct, replay, seconds = np.median(results, axis=0)
    line = EKF_RMSE[name]
    yield Figure(f"{name}, paper setup, training", float(seconds), "CPU-s", "", None)
    yield at_most(f"{name}, paper setup, direct RMSE", float(direct), "", round(1.1 * line, 5))
    worst = max(result[0] for result in results)
    yield Figure(f"{name}, paper setup, direct RMSE, worst of seeds", worst, "", "", None)
    yield at_most(f"{name}, paper setup, replay RMSE", float(replay), "", round(1.5 * line, 5))
    worst = max(result[1] for result in results)
    yield Figure(f"{name}, paper setup, replay RMSE, worst of seeds", worst, "", "", None)
