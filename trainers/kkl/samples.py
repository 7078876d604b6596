"""The simulated samples that the maps of a KKL observer are fitted to."""

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
from trainers.kkl.labels import driven, initial_states, noise_in_z, simulated
from trainers.kkl.learned_poles import EPISODES, learn

_PARTS = 12
"""Parts of the episode whose errors are weighed alike."""
_FORGOTTEN = 8.0
"""How long z's beginning is waited for to be forgotten, over its slowest time constant."""


class Samples:
    """Simulated states and z at some samples of many episodes, with their scalings, as tensors.

    Args:
        system: the model.
        config: the recipe.
        t: sample times of an episode in s, (num_samples,).
        prior: the prior's mean, (1, nx).
        noise_std: standard deviation of the output noise, (ny,).
        gap: samples from the first to the second of each pair that is kept, if pairs are.
        labelled: whether networks are fitted to the simulated z, and not to T's own.

    Raises:
        ValueError: in one line, if the recipe gives no observer of the system.
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
    ) -> None:
        self.system, self.config, self.noise_std, self.gap = system, config, noise_std, gap
        self.driven = driven(system)
        self.t, self.prior = t, prior
        if config.design == "learned":
            x0 = initial_states(system, config.low, config.high, EPISODES, config.seed)
            std = noise_std if config.noise else np.zeros(system.ny)
            poles = learn(system, config.poles, self.t, std, x0, config.seed)
            self.dynamics: Dynamics = realised(poles, system.ny, config.mode)
        else:
            self.dynamics = config.dynamics(system)
        self.dynamics.step(self.interval)  # a bad one is told before anything is simulated
        self.device, self.dtype = _device(config), getattr(torch, config.dtype)
        self._simulate()
        self._prepare(labelled)

    @property
    def interval(self) -> float:
        """Time between samples in s."""
        return float(np.diff(self.t).mean())

    def _simulate(self) -> None:
        config, system = self.config, self.system
        held = max(20, config.trajectories // 10)
        total = config.trajectories + held
        x0 = initial_states(system, config.low, config.high, total, config.seed)
        rng = np.random.default_rng([config.seed, 1])
        x0 = x0[rng.permutation(total)]
        first = 0
        if not (config.transient or self.driven):
            settled = self.t[0] + _FORGOTTEN / self.dynamics.slowest
            first = min(int(np.searchsorted(self.t, settled)), (len(self.t) - 1) // 2)
        self.kept = kept_samples(len(self.t), first, config.samples, self.gap, rng)
        self.data = simulated(
            system, self.dynamics, self.t, x0, self.kept, config.start, self.prior
        )
        if self.data.dropped:
            warnings.warn(
                f"{self.data.dropped} of {self.data.drawn} initial states of "
                f"{type(system).__name__} escape when integrated backward, and are left out",
                stacklevel=2,
            )
        batch = self.data.x.shape[1]
        self.held = slice(0, min(held, batch // 2))
        std = self.noise_std if config.noise else np.zeros(system.ny)
        rest = at_rest(self.dynamics, config.start)
        rows = batch if std.any() else 1
        self.noise = noise_in_z(self.dynamics, self.t, std, self.kept, rows, rng, rest)

    def _prepare(self, labelled: bool) -> None:
        """The scalings, and the samples as scaled tensors."""
        config, data = self.config, self.data
        real = abs(np.linalg.eigvals(self.dynamics.A).real)
        clocked = config.transient or self.driven
        rates = tuple(dict.fromkeys((float(real.min()), float(real.max())))) if clocked else ()
        sizes = abs(data.u).max(axis=0) if self.driven else np.empty(0)
        self.clock = Clock(rates, tuple(float(size) or 1.0 for size in sizes))
        times = self.clock(data.t, data.u) if self.clock.size else np.empty((len(data.t), 0))
        scale = vector(self.system.scale, self.system.nx, "scale")
        self.x_scaling = Scaling(data.x.mean(axis=(0, 1)), np.diag(scale))
        self.z_scaling = Scaling.of(data.z)
        self.clock_scaling = Scaling.of(times)
        self.whitening = Scaling.white(data.z, self.noise)
        self.times = self.tensor(self.clock_scaling.scaled(times))
        self.x = self.tensor(self.x_scaling.scaled(data.x))
        self.labels = None
        if labelled:
            self.labels = self.tensor(self.z_scaling.scaled(data.z if data.T is None else data.T))
            self.z = self.tensor(self.whitening.scaled(data.z))
        shifted = self.noise + self.whitening.mean
        self.z_noise = self.tensor(self.whitening.scaled(shifted))
        self.parts = torch.arange(len(data.t)) * (_PARTS if clocked else 1) // len(data.t)

    def tensor(self, array: np.ndarray) -> Tensor:
        """As a tensor of the training's precision, where the training runs."""
        return torch.tensor(np.ascontiguousarray(array), dtype=self.dtype, device=self.device)

    def draw(
        self, generator: torch.Generator, outputs: int, part: float = 1.0
    ) -> tuple[Tensor, Tensor]:
        """Indices of kept samples and of episodes that are trained on, (count,) each: as many as
        make a part of the batch with a network of so many outputs."""
        count = max(8, round(part * self.config.batch / outputs))
        k = torch.randint(len(self.data.t), (count,), generator=generator)
        episodes = torch.randint(
            self.held.stop, self.data.x.shape[1], (count,), generator=generator
        )
        return k.to(self.device), episodes.to(self.device)

    def outputs(self) -> np.ndarray:
        """The noise-free outputs at the kept samples, (kept, batch, ny)."""
        return np.asarray(
            self.system.h(self.t[self.kept][:, None], self.data.x, self.data.u[:, None])
        )

    def encoded(self, k: Tensor, i: Tensor) -> Tensor:
        """What T is given at samples k of episodes i."""
        x = self.x[k, i]
        return torch.cat([x, self.times[k]], dim=-1) if self.driven else x

    def pairs(self) -> np.ndarray:
        """Kept samples that are ``gap`` samples apart, as indices (pairs, 2)."""
        where = {int(k): index for index, k in enumerate(self.kept)}
        later = {k: where.get(k + self.gap) for k in where}
        return np.array([[where[k], i] for k, i in later.items() if i is not None])

    def rates(self) -> np.ndarray:
        """Rates of change in 1/s of what T is given, at the kept samples: (kept, batch, size)."""
        data, system = self.data, self.system
        t = self.t[self.kept]
        each = [system.f(t[k], data.x[k], data.u[k]) for k in range(len(t))]
        rate = np.array(each) @ np.linalg.inv(self.x_scaling.root).T
        if not self.driven:
            return rate
        h = 1e-4 * self.interval
        after, before = (self.clock(data.t + d, system.input(t + d)) for d in (h, -h))
        clock_rate = (after - before) / (2 * h) @ np.linalg.inv(self.clock_scaling.root).T
        shape = (*rate.shape[:2], clock_rate.shape[-1])
        clock_rate = np.broadcast_to(clock_rate[:, None], shape)
        return np.concatenate([rate, clock_rate], axis=-1)


def kept_samples(
    count: int, first: int, wanted: int, gap: int, rng: np.random.Generator
) -> np.ndarray:
    """Samples that are trained on, ascending: the first and the last of those from ``first`` on;
    half of the others evenly spread, half, if that is the very first, over the logarithm of the
    time since it. With a gap each comes with the one so much later, of as many pairs."""
    last = count - 1 - gap
    found = {first, last}
    wanted = min(wanted // (2 if gap else 1), last + 1 - first)
    while len(found) < wanted:
        even = int(rng.integers(first, last + 1))
        late = int(np.exp(rng.uniform(0, np.log(last + 1)))) if first == 0 else even
        found |= {even, min(late, last)}
    later = {k + gap for k in found}
    return np.array(sorted(found | later))


def _device(config: KKLConfig) -> torch.device:
    if config.device == "cuda" and not torch.cuda.is_available():
        raise ValueError("device='cuda', but there is no GPU here; expected cpu or auto")
    present = config.device != "cpu" and torch.cuda.is_available()
    return torch.device("cuda" if present else "cpu")
