"""The simulated training samples of the maps of a KKL observer."""

from __future__ import annotations

import warnings

import numpy as np
import torch
from torch import Tensor

from pinnobs_gym.estimation.learned.kkl_dynamics import Dynamics, at_rest, realised
from pinnobs_gym.estimation.learned.kkl_maps import Scaling
from pinnobs_gym.estimators.kkl import Clock
from pinnobs_gym.simulation.system import System, vector
from trainers.kkl.config import KKLConfig
from trainers.kkl.labels import (
    MOST_ESCAPED,
    SETTLED,
    driven,
    drives,
    initial_states,
    noise_in_z,
    simulated,
)

_PARTS = 12
"""Number of parts of the episode whose errors have the same weight."""
_FORGOTTEN = 8.0
"""Duration of the skipped transient of z, over its slowest time constant."""


class Samples:
    """Simulated states and z at the kept samples of many episodes, as scaled tensors.

    Args:
        system: the model.
        config: the settings.
        t: sample times of an episode in s, shape (num_samples,).
        prior: prior mean, shape (1, nx).
        noise_std: standard deviation of the output noise, shape (ny,).
        gap: number of samples between the two of each kept pair; 0 without pairs.
        labelled: whether networks are fitted to the simulated z, and not to T's own.
        poles: poles of z in 1/s, in place of those of the settings.

    Raises:
        ValueError: in one line, if the settings give no observer of the system.
    """

    def __init__(
        self,
        system: System,
        config: KKLConfig,
        t: np.ndarray,
        prior: np.ndarray,
        noise_std: np.ndarray,
        gap: int,
        labelled: bool,
        poles: tuple[float, ...] | None = None,
    ) -> None:
        self.system, self.config, self.noise_std, self.gap = system, config, noise_std, gap
        self.driven = driven(system)
        self.t, self.prior = t, prior
        self.dynamics: Dynamics = (
            config.dynamics(system)
            if poles is None
            else realised(poles, drives(system), config.mode)
        )
        self.dynamics.step(self.interval)  # raise an error before the simulation
        self.device, self.dtype = _device(config), getattr(torch, config.dtype)
        self._simulate()
        self._prepare(labelled)

    @property
    def interval(self) -> float:
        """Time between samples in s."""
        return float(np.diff(self.t).mean())

    def _simulate(self) -> None:
        """Simulate the episodes and the effect of output noise on z."""
        config, system = self.config, self.system
        # Initial states in random order, so that the held-out ones are a random subset.
        held = max(20, config.trajectories // 10)
        total = config.trajectories + held
        x0 = initial_states(system, config.low, config.high, total, config.seed)
        rng = np.random.default_rng([config.seed, 1])
        x0 = x0[rng.permutation(total)]
        # A T* without the time since the first sample is fitted after the transient only.
        first = 0
        if not (config.transient or self.driven):
            settled = self.t[0] + _FORGOTTEN / self.dynamics.slowest
            first = min(int(np.searchsorted(self.t, settled)), (len(self.t) - 1) // 2)
        self.kept = kept_samples(len(self.t), first, config.samples, self.gap, rng)
        self.data = simulated(
            system,
            self.dynamics,
            self.t,
            x0,
            self.kept,
            config.start,
            self.prior,
            np.random.default_rng([config.seed, 3]),
        )
        self._warn()
        # The first episodes are held out for validation.
        batch = self.data.x.shape[1]
        self.held = slice(0, min(held, batch // 2))
        std = self.noise_std if config.noise else np.zeros(system.ny)
        rest = at_rest(self.dynamics, config.start)
        rows = batch if std.any() else 1
        std = np.append(std, np.zeros(drives(system) - system.ny))  # inputs are known
        self.noise = noise_in_z(self.dynamics, self.t, std, self.kept, rows, rng, rest)

    def _warn(self) -> None:
        """Warn of initial states that escape."""
        data = self.data
        of = f"of {data.drawn} initial states of {type(self.system).__name__}"
        if data.reached:
            warnings.warn(
                f"over {MOST_ESCAPED:.0%} {of} escape when integrated backward: T is fitted to "
                f"states that they reach forward in {SETTLED / self.dynamics.slowest:.3g} s",
                stacklevel=2,
            )
        if data.dropped:
            where = "forward" if data.reached else "backward"
            warnings.warn(
                f"{data.dropped} {of} escape when integrated {where}, and are left out",
                stacklevel=2,
            )

    def _prepare(self, labelled: bool) -> None:
        """Compute the scalings, and the samples as scaled tensors."""
        config, data = self.config, self.data
        # Inputs besides z: decaying exponentials of the time, and the plant's inputs.
        real = abs(np.linalg.eigvals(self.dynamics.A).real)
        clocked = config.transient or self.driven
        rates = tuple(dict.fromkeys((float(real.min()), float(real.max())))) if clocked else ()
        sizes = abs(data.u).max(axis=(0, 1)) if self.driven else np.empty(0)
        self.clock = Clock(rates, tuple(float(size) or 1.0 for size in sizes))
        t = np.broadcast_to(data.t[:, None], data.u.shape[:2])
        times = self.clock(t, data.u) if self.clock.size else np.empty((*t.shape, 0))
        # States by their scale, labels to unit variances, and the inputs of T* whitened.
        scale = vector(self.system.scale, self.system.nx, "scale")
        self.x_scaling = Scaling(data.x.mean(axis=(0, 1)), np.diag(scale))
        self.z_scaling = Scaling.of(data.z)
        self.clock_scaling = Scaling.of(times)
        self.whitening = Scaling.white(data.z, self.noise)
        self.times = self.tensor(self.clock_scaling.scaled(times))
        self.x = self.tensor(self.x_scaling.scaled(data.x))
        # The training episodes, and those of them along which T(x) is known.
        known = np.ones(len(data.x0), dtype=bool)
        if labelled and data.T is not None:
            known = np.isfinite(data.T[0]).all(axis=1)
        self.episodes, self.known = (
            torch.from_numpy(self.held.stop + np.flatnonzero(rows[self.held.stop :]))
            for rows in (np.ones_like(known), known)
        )
        self.labels = None
        if labelled:
            self.labels = self.tensor(self.z_scaling.scaled(data.z if data.T is None else data.T))
            self.z = self.tensor(self.whitening.scaled(data.z))
        # The noise is added to whitened z, so its own scaling must not subtract the mean.
        shifted = self.noise + self.whitening.mean
        self.z_noise = self.tensor(self.whitening.scaled(shifted))
        self.parts = torch.arange(len(data.t)) * (_PARTS if clocked else 1) // len(data.t)

    def tensor(self, array: np.ndarray) -> Tensor:
        """Return a tensor of the array's shape, of the training's precision and on its device."""
        return torch.tensor(np.ascontiguousarray(array), dtype=self.dtype, device=self.device)

    def draw(
        self,
        generator: torch.Generator,
        outputs: int,
        part: float = 1.0,
        known: bool = False,
    ) -> tuple[Tensor, Tensor]:
        """Draw the indices of kept samples and of training episodes, (count,) each.

        Args:
            generator: random generator.
            outputs: number of outputs of the network; ``config.batch`` counts equations.
            part: fraction of the batch to draw.
            known: whether to draw from episodes with known T(x) only.
        """
        count = max(8, round(part * self.config.batch / outputs))
        k = torch.randint(len(self.data.t), (count,), generator=generator)
        among = self.known if known else self.episodes
        episodes = among[torch.randint(len(among), (count,), generator=generator)]
        return k.to(self.device), episodes.to(self.device)

    def outputs(self) -> np.ndarray:
        """Return the noise-free outputs at the kept samples, (kept, batch, ny)."""
        return np.asarray(self.system.h(self.t[self.kept][:, None], self.data.x, self.data.u))

    def encoded(self, k: Tensor, i: Tensor) -> Tensor:
        """Return the scaled inputs of T, (count, inputs), at kept samples k of episodes i, (count,)
        each."""
        x = self.x[k, i]
        return torch.cat([x, self.clocked(k, i)], dim=-1) if self.driven else x

    def clocked(self, k: Tensor, i: Tensor) -> Tensor:
        """Return the scaled clock's inputs, (count, inputs), at kept samples k of episodes i,
        (count,) each; they are the same in all episodes unless inputs are drawn."""
        return self.times[k, i % self.times.shape[1]]

    def pairs(self) -> np.ndarray:
        """Return the pairs of kept samples that are ``gap`` samples apart, as indices
        (pairs, 2)."""
        where = {int(k): index for index, k in enumerate(self.kept)}
        later = {k: where.get(k + self.gap) for k in where}
        return np.array([[where[k], i] for k, i in later.items() if i is not None])

    def rates(self) -> np.ndarray:
        """Return the time derivatives in 1/s of T's scaled inputs at the kept samples,
        (kept, batch, size)."""
        data, system = self.data, self.system
        t = self.t[self.kept]
        each = [system.f(t[k], data.x[k], data.u[k]) for k in range(len(t))]
        rate = np.array(each) @ np.linalg.inv(self.x_scaling.root).T
        if not self.driven:
            return rate
        # Central differences of the clock's inputs.
        h = 1e-4 * self.interval
        after, before = (self.clock(data.t + d, system.input(t + d)) for d in (h, -h))
        clock_rate = (after - before) / (2 * h) @ np.linalg.inv(self.clock_scaling.root).T
        shape = (*rate.shape[:2], clock_rate.shape[-1])
        clock_rate = np.broadcast_to(clock_rate[:, None], shape)
        return np.concatenate([rate, clock_rate], axis=-1)


def kept_samples(
    count: int, first: int, wanted: int, gap: int, rng: np.random.Generator
) -> np.ndarray:
    """Draw the indices of the samples to train on, in ascending order.

    They include the first and the last index allowed. Of the others half are uniform, and half
    uniform in the logarithm of the index if ``first`` is 0, else uniform, too. With a gap, each
    index k comes with k + gap.

    Args:
        count: number of samples of an episode.
        first: first index allowed.
        wanted: number of indices to draw, approximately.
        gap: distance of the two samples of a pair; 0 without pairs.
        rng: random generator.
    """
    last = count - 1 - gap
    chosen = {first, last}
    wanted = min(wanted // (2 if gap else 1), last + 1 - first)
    while len(chosen) < wanted:
        even = int(rng.integers(first, last + 1))
        late = int(np.exp(rng.uniform(0, np.log(last + 1)))) if first == 0 else even
        chosen |= {even, min(late, last)}
    later = {k + gap for k in chosen}
    return np.array(sorted(chosen | later))


def _device(config: KKLConfig) -> torch.device:
    if config.device == "cuda" and not torch.cuda.is_available():
        raise ValueError("device='cuda', but there is no GPU here; expected cpu or auto")
    present = config.device != "cpu" and torch.cuda.is_available()
    return torch.device("cuda" if present else "cpu")
