"""A training in progress: of T, then of T*."""

from __future__ import annotations

import json
import math
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pinnobs_gym.estimation.learned.kkl_dynamics import at_rest, realised
from pinnobs_gym.estimation.learned.kkl_maps import Layers, Mlp, Scaling, evaluate
from pinnobs_gym.estimation.learned.trained_file import check_same, identity, read, write
from pinnobs_gym.estimators.kkl import Clock, TrainedKKL
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System, output_scale, vector
from trainers.kkl.config import KKLConfig
from trainers.kkl.fitting import Equations, Fit, Objective, Term
from trainers.kkl.labels import driven, initial_states, noise_in_z, simulated
from trainers.kkl.learned_poles import EPISODES, learn

_FREE = ("checkpoint_every", "log_every", "device", "budget")
"""Settings that may change when training is resumed."""
_PARTS = 12
"""Parts of the episode whose errors are weighed alike."""
_USUAL = 0.95
"""Weight of the past in the mean squared error of each part."""
_FORGOTTEN = 8.0
"""How long z's beginning is waited for to be forgotten, over its slowest time constant."""
_SHARE = 0.02
"""Part of the mean squared error that is added to each part's before it is divided by."""


def _no_pairs(config: Any, system: System, record: Record) -> int:
    return 0


@dataclass(frozen=True)
class Method:
    """What the trainers differ in."""

    name: str
    """The trainer's."""
    encoding: Callable[[Run], Objective]
    """Makes the equations that T is fitted to."""
    labelled: bool = True
    """Whether T* is fitted to simulated z, and not to T's own."""
    gap: Callable[[Any, System, Record], int] = _no_pairs
    """Samples from the first to the second of each pair that is kept, if pairs are, for a recipe, a
    system and a record."""


class Run:
    """A training of T, then of T*.

    Args:
        method: the trainer's.
        system: the model.
        config: the recipe.
        record: whose sample times are trained on, and the prior.
        noise_std: standard deviation of the output noise, shape (ny,).
        gap: samples from the first to the second of each pair that is kept, if pairs are.
    """

    def __init__(
        self,
        method: Method,
        system: System,
        config: KKLConfig,
        record: Record,
        noise_std: np.ndarray,
        gap: int = 0,
    ) -> None:
        self._earlier, self._start = 0.0, time.process_time()
        self.method, self.system, self.config = method, system, config
        self.noise_std, self.gap = noise_std, gap
        self.driven = driven(system)
        self.t, self.prior = record.t, record.prior.mean[:1]
        if config.design == "learned":
            x0 = initial_states(system, config.low, config.high, EPISODES, config.seed)
            std = noise_std if config.noise else np.zeros(system.ny)
            poles = learn(system, config.poles, self.t, std, x0, config.seed)
            self.dynamics = realised(poles, system.ny, config.mode)
        else:
            self.dynamics = config.dynamics(system)
        self.dynamics.step(self.interval)  # a bad one is told before anything is simulated
        self.device, self.dtype = _device(config), getattr(torch, config.dtype)
        self._simulate()
        self._prepare()
        self.latest = math.nan
        self.best: dict[str, Best] = {}
        self.facts: dict[str, Any] = {}
        self._begin("T")

    @property
    def interval(self) -> float:
        """Time between samples in s."""
        return float(np.diff(self.t).mean())

    @property
    def seconds(self) -> float:
        """CPU seconds so far."""
        return self._earlier + time.process_time() - self._start

    @property
    def iterations(self) -> int:
        """Steps so far, for both networks."""
        return self.fit.iteration + (self.best["T"].made if self.stage != "T" else 0)

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

    def _prepare(self) -> None:
        """The scalings, and the samples as scaled tensors."""
        config, data = self.config, self.data
        real = abs(np.linalg.eigvals(self.dynamics.A).real)
        told = config.transient or self.driven
        rates = tuple(dict.fromkeys((float(real.min()), float(real.max())))) if told else ()
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
        if self.method.labelled:
            self.labels = self.tensor(self.z_scaling.scaled(data.z if data.T is None else data.T))
            self.z = self.tensor(self.whitening.scaled(data.z))
        shifted = self.noise + self.whitening.mean
        self.z_noise = self.tensor(self.whitening.scaled(shifted))
        self.parts = torch.arange(len(data.t)) * (_PARTS if told else 1) // len(data.t)

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
        told = (after - before) / (2 * h) @ np.linalg.inv(self.clock_scaling.root).T
        told = np.broadcast_to(told[:, None], (*rate.shape[:2], told.shape[-1]))
        return np.concatenate([rate, told], axis=-1)

    def _begin(self, stage: str) -> None:
        self.stage, self._stage_start = stage, self.seconds
        config = self.config
        generator = torch.Generator().manual_seed(2 * config.seed + (stage == "T*"))
        if stage == "T":
            inputs = self.x_scaling.beside(self.clock_scaling) if self.driven else self.x_scaling
            outputs = self.z_scaling
        else:
            inputs, outputs = self.whitening.beside(self.clock_scaling), self.x_scaling
        shape = (config.depth, config.width, config.activation)
        net = Mlp(inputs, outputs, *shape, generator, self.dtype, self.device)
        if stage == "T":
            objective = self.method.encoding(self)
            self._checked = _held_equations(objective, config.seed)
        else:
            if not self.method.labelled:  # T is what it is now
                self.z = self.tensor(self.whitening.scaled(self._own_z()))
            objective = self._decoding
            self._mse = torch.ones(int(self.parts[-1]) + 1, dtype=self.dtype, device=self.device)
        self.fit = Fit(net, objective, config.method, config.learning_rate, generator)
        self._look()

    def _own_z(self) -> np.ndarray:
        """The z along the episodes if T is right: T(x(t)) + Φ(t)(z₀ − T(x₀)), or T(t, x(t)) of a
        driven plant."""
        data, map_of = self.data, self.encoder
        if self.driven:
            told = self.clock(data.t, data.u)[:, None]
            x = np.concatenate(
                [data.x, np.broadcast_to(told, (*data.x.shape[:2], told.shape[-1]))], axis=-1
            )
            return evaluate(map_of, self.config.activation, x)
        T, T0 = (evaluate(map_of, self.config.activation, x) for x in (data.x, data.x0))
        first = self.t[0]
        y0 = self.system.h(first, data.x0, np.asarray(self.system.input(first)))
        z0 = y0 @ at_rest(self.dynamics, self.config.start).T
        if self.config.start == "prior":
            z0 = z0 + evaluate(map_of, self.config.activation, self.prior)
        return T + np.einsum("kij,bj->kbi", data.flow, z0 - T0)

    @property
    def encoder(self) -> Layers:
        """T's best weights."""
        return self.best["T"].layers

    def _decoding(self, generator: torch.Generator) -> Sequence[Equations]:
        """x̂ = x at samples of all parts of the episode, whose errors are divided by what is usual
        there: else the transient, which is never small, is all that counts."""
        k, i = self.draw(generator, self.system.nx)
        rows = self.z_noise.shape[1]
        j = torch.randint(rows, (len(k),), generator=generator).to(self.device)
        a = torch.cat([self.z[k, i] + self.z_noise[k, j], self.times[k]], dim=-1)
        target, part = self.x[k, i], self.parts.to(self.device)[k]
        with torch.no_grad():
            square = (self.fit.net(a) - target).square().mean(dim=-1)
            count = torch.bincount(part, minlength=len(self._mse))
            found = torch.zeros_like(self._mse).index_add_(0, part, square) / count.clamp(min=1)
            self._mse = torch.where(count > 0, _USUAL * self._mse + (1 - _USUAL) * found, self._mse)
            usual = self._mse + _SHARE * self._mse.mean()
            weight = (usual.mean() / usual).sqrt()[part][:, None]
        return [Equations([Term(a)], target, weight)]

    def step(self) -> None:
        """One step of the present network; the next one's turn if that was the last."""
        self.fit.step(self.progress)
        if self.fit.iteration % self.config.check_every == 0:
            self._look()
        if self._stage_over():
            self._look()
            self.best[self.stage].made = self.fit.iteration
            self._begin("T*") if self.stage == "T" else setattr(self, "stage", "done")

    @property
    def progress(self) -> float:
        """How much of the present network's training is over: by steps, or by CPU time if there is
        a budget and that is further."""
        config = self.config
        steps = config.iterations * (config.share if self.stage == "T" else 1.0)
        done = self.fit.iteration / steps
        if config.budget is not None:
            left = config.budget - self._stage_start
            mine = left * config.share / (1 + config.share) if self.stage == "T" else left
            spent = self.seconds - self._stage_start
            done = max(done, spent / max(mine, 1e-9))
        return done

    @property
    def done(self) -> float:
        """How much of the whole training is over."""
        share = self.config.share / (1 + self.config.share)
        if self.stage == "T":
            return share * min(self.progress, 1.0)
        return 1.0 if self.finished() else share + (1 - share) * min(self.progress, 1.0)

    def traded(self) -> dict[str, float]:
        """What a cut-off trades: see `sweep`."""
        noisy, clean = (self._held_squares(noise).cpu().numpy() for noise in (True, False))
        late = self.data.t >= self.data.t[0] + 0.75 * (self.data.t[-1] - self.data.t[0])
        end, without = noisy[late].mean(), clean[late].mean()
        above = np.flatnonzero(noisy > 4 * end)
        scale = self.noise_std / output_scale(self.system)
        own = float(np.sqrt(np.mean(scale**2)))
        return {
            "noisy": float(np.sqrt(end)),
            "clean": float(np.sqrt(without)),
            "noise_gain": float(np.sqrt(max(end - without, 0.0))) / own if own else 0.0,
            "convergence": float(self.data.t[above[-1]]) if len(above) else 0.0,
        }

    def _stage_over(self) -> bool:
        best = self.best[self.stage]
        config = self.config
        steps = config.iterations * (config.share if self.stage == "T" else 1.0)
        waited = (self.fit.iteration - best.iteration) / steps
        return self.progress >= 1 or (waited >= config.patience and self.fit.iteration > 0)

    def finished(self) -> bool:
        """Whether both networks are trained."""
        return self.stage == "done"

    def _look(self) -> None:
        """The error on what is held out; keeps the weights if it is the least so far."""
        with torch.no_grad():
            self.latest = self._held_error()
        best = self.best.get(self.stage)
        if best is None or self.latest < best.error:
            self.best[self.stage] = Best(self.latest, self.fit.iteration, self.fit.net.layers())

    def _held_error(self) -> float:
        net = self.fit.net
        if self.stage == "T":
            found = [e.residual(net).square().mean() for e in self._checked]
            return float(torch.stack(found).sum())
        square = self._held_squares(noise=True)
        parts = torch.zeros_like(self._mse).index_add_(0, self.parts.to(self.device), square)
        count = torch.bincount(self.parts, minlength=len(parts)).to(self.device)
        return float((parts / count).log().mean().exp())

    def _held_squares(self, noise: bool) -> Tensor:
        """Mean squared scaled errors of x̂ on the episodes held out, (kept,)."""
        with torch.no_grad():
            z = self.z[:, self.held]
            if noise:
                z = z + self.z_noise[:, : self.held.stop]
            told = self.times[:, None].expand(-1, z.shape[1], -1)
            error = self.fit.net(torch.cat([z, told], -1)) - self.x[:, self.held]
            return error.square().mean((1, 2))

    def save(self, path: Path) -> None:
        """Write all that `restore` needs to go on exactly; the samples are simulated anew."""
        facts = {
            **self._expected(),
            "stage": self.stage,
            "seconds": self.seconds,
            "stage_start": self._stage_start,
            "best": {
                stage: {"error": b.error, "iteration": b.iteration, "made": b.made}
                for stage, b in self.best.items()
            },
            "facts": self.facts,
        }
        layers = {
            stage: [[torch.tensor(a) for a in layer] for layer in b.layers]
            for stage, b in self.best.items()
        }
        usual = self._mse if self.stage == "T*" else torch.empty(0)
        tensors = {"t": torch.tensor(self.t), "layers": layers, "usual": usual}
        write(path, {"checkpoint": json.dumps(facts), "fit": self.fit.state(), **tensors})

    def restore(self, path: Path) -> None:
        """Take up the training of a checkpoint.

        Raises:
            ValueError: in one line, if it cannot be read or belongs to another training.
        """
        saved = read(path)
        try:
            facts = json.loads(saved["checkpoint"])
            check_same(path, facts, self._expected())
            if not np.array_equal(saved["t"].numpy(), self.t):
                raise ValueError(f"{path} was trained on a record of other sample times")
            for stage, found in facts["best"].items():
                layers = tuple((W.numpy(), b.numpy()) for W, b in saved["layers"][stage])
                self.best[stage] = Best(layers=layers, **found)
            kept = dict(self.best)
            if facts["stage"] != "T":
                self._begin("T*")
            self.fit.take_up(saved["fit"])
            self.best, self.stage = kept, facts["stage"]
            if self.stage == "T*":
                self._mse = saved["usual"].to(self.device)
            self._earlier += facts["seconds"]
            self._stage_start = facts["stage_start"]
            self.facts = facts["facts"]
        except (KeyError, TypeError, AttributeError, RuntimeError) as error:
            reason = str(error).splitlines()[0]
            raise ValueError(f"{path} is not a checkpoint of this trainer: {reason}") from None

    def _expected(self) -> dict[str, Any]:
        """What a checkpoint must agree with."""
        config = {k: v for k, v in asdict(self.config).items() if k not in _FREE}
        told = {"trainer": self.method.name, "noise_std": self.noise_std.tolist()}
        return {**identity(self.system), **told, "config": config}

    def result(self) -> TrainedKKL:
        """The observer of the least validation errors."""
        if self.stage == "T":  # stopped early: T* as it is drawn, so that there is one
            self.best["T"].made = self.fit.iteration
            self._begin("T*")
        about = identity(self.system)
        return TrainedKKL(
            trainer=self.method.name,
            A=self.dynamics.A,
            B=self.dynamics.B,
            mode=self.dynamics.mode,
            start=self.config.start,
            clock=self.clock,
            activation=self.config.activation,
            encoder=self.encoder,
            decoder=self.best["T*"].layers,
            system=about["system"],
            parameters=about["parameters"],
            noise_std=tuple(self.noise_std.tolist()),
            config=json.loads(json.dumps(asdict(self.config))),
            seed=self.config.seed,
            loss=self.best["T*"].error,
            iterations=self.iterations,
            seconds=self.seconds,
            facts={
                "dropped": self.data.dropped,
                "drawn": self.data.drawn,
                "loss_of_T": self.best["T"].error,
                "low": self.data.x.min(axis=(0, 1)).tolist(),
                "high": self.data.x.max(axis=(0, 1)).tolist(),
                **self.facts,
            },
        )


@dataclass(eq=False)
class Best:
    """The weights of the least validation error."""

    error: float
    iteration: int
    layers: Layers
    made: int = 0
    """Steps that were made in all."""


def _held_equations(objective: Objective, seed: int) -> list[Equations]:
    generator = torch.Generator().manual_seed(seed + 10**6)
    return [e for _ in range(5) for e in objective(generator)]


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
    there = config.device != "cpu" and torch.cuda.is_available()
    return torch.device("cuda" if there else "cpu")
