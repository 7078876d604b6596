"""PINN-Obs by three recipes on all six systems: the paper's, a fast one with the paper's loss, and
the fast one guided by a Kalman smoother of the same record; and its posterior beside a smoother."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import torch
from paper_case import Case
from pinn_posterior import posteriors
from plain_network import Network
from three_recipes import GUIDED, SEEDS, paper_setup
from three_recipes import readme_table as readme_table

from benchmarks import Figure, at_most, cpu_seconds
from pinnobs_gym.estimation.learned.mlp import Architecture
from pinnobs_gym.systems import SYSTEMS
from trainers.pinn_obs import PinnObsTrainer, guided, paper, transfer

PAPER_ITERATIONS = 101_431
"""Iterations of the paper's best training (its table of depths and widths, 9×20)."""
LOSS, RMSE = 9.56e-4, 0.0562
"""Loss and RMSE of that training."""


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
        what = f"ReverseDuffing, {GUIDED}, {depth}x20, to the paper's loss and RMSE"
        yield Figure(f"{what}, median of seeds", float(np.median(times)), "CPU-s", "", None)
        yield at_most(
            f"{what}, slowest of {len(SEEDS)} seeds, over R", max(times) / whole, "", 1 / part
        )
    yield from replays(duffing, whole / 350)
    yield from transfers(duffing)
    for name in SYSTEMS.classes():
        yield from paper_setup(name)
    yield from posteriors()


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
    """Measure the CPU seconds of the guided recipe until loss and RMSE reach the paper's.

    They are checked every ten iterations. The result is infinite if the limit is exceeded.
    """
    spent, start = 0.0, time.process_time()
    config = replace(guided(), depth=depth, seed=seed)
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
            config = replace(guided(), seed=seed, budget=budget)
            values.append(one.replayed(one.trained(config, std)))
        what = f"ReverseDuffing, {GUIDED}, replay on the own record, noise {std:g}, RMSE"
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
    what = f"ReverseDuffing, {GUIDED}, gain meant to transfer, RMSE, worst of seeds"
    yield at_most(f"{what}, from x0=[1, 1.5], xhat0=[0, 0]", max(elsewhere), "", 0.08)
    yield at_most(f"{what}, own record", max(own), "", 0.26)
