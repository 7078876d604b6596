"""A training of a shared gain in progress."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pinnobs_gym.estimation.learned.gain_network import memory_size, shapes
from pinnobs_gym.estimation.learned.trained_file import identity
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.pinn_gain import Layers, TrainedGain
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System, output_scale, vector
from trainers.pinn_gain.config import Config
from trainers.pinn_gain.held_out import HeldOut
from trainers.pinn_gain.rollout import Model
from trainers.pinn_gain.smooth import smooth
from trainers.pinn_gain.streams import Data, Streams

_RESTARTS = 3
_PATIENCE = 10
"""Chunks in a row without a finite loss after which training begins again."""
_WARM_UP = 20
"""Iterations over which Adam's step grows to its full size."""
_AVERAGE = 0.98
"""What the moving average of the weights keeps from one iteration to the next."""
_SLOW = 5.0
"""Weight w of the size of scaled errors beside their logarithm."""
_RESOLUTION = 1e-3
"""Scaled error below which an error is hardly made smaller."""


@dataclass(frozen=True, eq=False)
class Best:
    """The weights of the least held-out loss so far."""

    loss: float
    """See `HeldOut.loss`."""
    iteration: int
    """The iteration after which they were found; 0 is the EKF itself."""
    seed: int
    """What these weights began from."""
    layers: Layers


class Run:
    """All that changes from one iteration to the next.

    Args:
        system: the model.
        config: the recipe.
        record: of a batch of episodes.
        noise_std: standard deviation of the output noise that is told, shape (ny,).
    """

    def __init__(
        self, system: System, config: Config, record: Record, noise_std: np.ndarray
    ) -> None:
        self._earlier, self._start = 0.0, time.process_time()
        self.config, self.system, self.record, self.noise_std = config, system, record, noise_std
        ekf = EKF(system, noise_std=tuple(noise_std.tolist()))
        self.std = np.sqrt(ekf.output_variance)
        scale = torch.tensor(vector(system.scale, system.nx, "scale"))[:, None]
        size = torch.tensor(output_scale(system))[:, None]
        self.model = Model(system, config.variant, scale, size, torch.tensor(ekf.tuning()[0]))
        smoothed = smooth(record, ekf)
        usable = np.flatnonzero(smoothed.explained)
        self.usable = len(usable)
        learned = usable[usable < record.batch - config.held_out]
        held = usable[usable >= record.batch - config.held_out]
        if not len(learned) or not len(held):
            raise ValueError(
                f"the model of {type(system).__name__} explains the outputs of {self.usable} of "
                f"{record.batch} records; expected some to learn from and some to hold out"
            )
        self.data = Data.of(system, record, smoothed, learned)
        self.held_out = HeldOut(self.model, Data.of(system, record, smoothed, held), self.noise_std)
        self.best: Best | None = None
        self.iteration, self.stuck = 0, False
        self.value, self.gradient, self.latest = math.nan, math.nan, math.nan
        self._begin(attempt=0)

    @property
    def seed(self) -> int:
        """What the present weights began from."""
        return self.config.seed + self.attempt

    @property
    def seconds(self) -> float:
        """CPU seconds so far."""
        return self._earlier + time.process_time() - self._start

    def _begin(self, attempt: int) -> None:
        self.attempt, self.failures, self.since = attempt, 0, 0
        generator = torch.Generator().manual_seed(self.seed)
        config, system = self.config, self.system
        self.parameters: list[Tensor] = []
        sizes = shapes(config.variant, system.nx, system.ny, config.width)
        for rows, columns in sizes:
            W = torch.randn(rows, columns, generator=generator, dtype=torch.float64)
            last = len(self.parameters) == 2 * len(sizes) - 2
            W = W * (0.0 if last else columns**-0.5)
            self.parameters += [W, torch.zeros(rows, dtype=torch.float64)]
        self.average = [p.clone() for p in self.parameters]
        for parameter in self.parameters:
            parameter.requires_grad_()
        self._optimiser = torch.optim.Adam(self.parameters, lr=config.learning_rate)
        first = 1.0 if config.variant == "kalman" else 0.0
        memory = memory_size(config.variant, system.ny, config.width), first
        chunk = min(config.chunk, self.record.num_samples)
        sizes = (config.streams, chunk)
        self.streams = Streams(self.model, self.data, self.std, *sizes, memory, self.seed)
        if self.best is None:
            self.look()

    def step(self) -> None:
        """One chunk of all streams and a step of Adam."""
        weights = list(zip(self.parameters[::2], self.parameters[1::2], strict=True))
        with np.errstate(all="ignore"):  # streams that are lost begin anew
            moments, errors = self.streams.roll(weights)
        loss = self._loss([moment.P for moment in moments], errors)
        self.iteration += 1
        self.since += 1
        self.value = loss.item()
        self._optimiser.zero_grad()
        if math.isfinite(self.value):
            loss.backward()
            self.gradient = float(torch.nn.utils.clip_grad_norm_(self.parameters, 1.0))
        if math.isfinite(self.value) and math.isfinite(self.gradient):
            self.failures = 0
            for group in self._optimiser.param_groups:
                group["lr"] = self.config.learning_rate * min(1.0, self.since / _WARM_UP)
            self._optimiser.step()
            kept = min(_AVERAGE, 1 - 1 / (1 + self.since / 2))
            for average, parameter in zip(self.average, self.parameters, strict=True):
                average.lerp_(parameter.detach(), 1 - kept)
        else:
            self.failures += 1
        self.streams.go_on(moments[-1])
        if self.failures == _PATIENCE:
            self._restart()
        elif self.iteration % self.config.check_every == 0:
            self.look()

    def _loss(self, covariances: list[Tensor], errors: Tensor) -> Tensor:
        """The mean over streams of log e + we, e the root mean square scaled error of a chunk: the
        first counts all streams alike, the second those that are slow to settle. And that of the
        likelihood of the errors under the covariance's diagonal, its tails made heavy."""
        size = (errors.square().mean((0, 1)) + _RESOLUTION**2).sqrt()
        loss = (size.log() + _SLOW * size).mean()
        if self.config.variant == "gru" or not self.config.consistency:
            return loss
        variance = torch.stack([torch.diagonal(P).T for P in covariances])
        variance = variance / self.model.scale**2 + 1e-10
        surprise = 4 * torch.log1p(errors.square() / (4 * variance)) + variance.log()
        return loss + self.config.consistency * surprise.mean()

    def look(self) -> float:
        """The loss of the averaged weights on the records held out; keeps the weights if it is the
        least so far."""
        layers = layers_of(self.average)
        loss = self.held_out.loss(layers)
        if self.best is None or loss < self.best.loss:
            self.best = Best(loss, self.iteration, self.seed, layers)
        self.latest = loss
        return loss

    def _restart(self) -> None:
        if self.attempt == _RESTARTS:
            self.stuck = True
        else:
            self._begin(self.attempt + 1)

    def finished(self) -> bool:
        """Whether the iterations or the CPU time are used up, or no seed gives finite losses."""
        budget = self.config.budget
        spent = budget is not None and self.iteration > 0 and self.seconds >= budget
        return self.iteration >= self.config.iterations or spent or self.stuck

    def result(self) -> TrainedGain:
        """The network of the least held-out loss.

        Raises:
            FloatingPointError: in one line, if no seed gave finite losses for long.
        """
        if self.iteration % self.config.check_every and not self.stuck:
            self.look()
        assert self.best is not None
        if self.stuck and self.best.iteration == 0:
            raise FloatingPointError(
                f"the loss of pinn_gain on {type(self.system).__name__} left the finite numbers "
                f"from seed {self.config.seed} and the {self.attempt} after it; try a lower "
                "learning_rate"
            )
        about = identity(self.system)
        return TrainedGain(
            layers=self.best.layers,
            variant=self.config.variant,
            system=about["system"],
            parameters=about["parameters"],
            noise_std=tuple(self.noise_std.tolist()),
            config=asdict(self.config),
            seed=self.best.seed,
            loss=self.best.loss,
            iterations=self.iteration,
            seconds=self.seconds,
        )

    def state(self) -> dict[str, Any]:
        """All that changes, but for the best weights: tensors, and plain values in ``facts``."""
        streams = self.streams.state()
        facts = {name: getattr(self, name) for name in _COUNTS}
        return {
            "facts": {**facts, "rng": streams["rng"], "seconds": self.seconds},
            "streams": streams["arrays"],
            "parameters": [p.detach() for p in self.parameters],
            "average": self.average,
            "optimiser": self._optimiser.state_dict(),
        }

    def take_up(self, state: Mapping[str, Any], best: Best) -> None:
        """Go on exactly from what `state` gave."""
        facts = state["facts"]
        self._begin(facts["attempt"])
        self.best = best
        for name in _COUNTS:
            setattr(self, name, facts[name])
        with torch.no_grad():
            for mine, kept in zip(self.parameters, state["parameters"], strict=True):
                mine.copy_(kept)
        self.average = state["average"]
        self._optimiser.load_state_dict(state["optimiser"])
        self.streams.take_up({"arrays": state["streams"], "rng": facts["rng"]})
        self._earlier += facts["seconds"]


_COUNTS = ("iteration", "attempt", "failures", "since", "stuck", "latest")
"""What is counted, and the latest held-out loss."""


def layers_of(parameters: list[Tensor]) -> Layers:
    """The same as NumPy arrays, in pairs."""
    arrays = [p.detach().numpy().copy() for p in parameters]
    return tuple(zip(arrays[::2], arrays[1::2], strict=True))
