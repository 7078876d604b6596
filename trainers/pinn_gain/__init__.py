"""A gain shared by all episodes, trained on the outputs of many records and the model's equations.

The true states are not used. The targets are the smoothed trajectories of whole records (`smooth`),
computed from outputs and model. The gain runs online along these trajectories, on outputs simulated
with noise of many levels, which R reports to it. The errors are backpropagated in time through the
model, the covariance and the gain.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from pinnobs_gym.estimation.learned.gain_network import memory_size, shapes
from pinnobs_gym.estimation.learned.perceptron import Layers
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.pinn_gain import PinnGain, TrainedGain
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System, output_scale, vector
from pinnobs_gym.training.trainer import Trainer
from trainers.adam import Adam
from trainers.pinn_gain.config import PinnGainConfig
from trainers.pinn_gain.held_out import HeldOut
from trainers.pinn_gain.rollout import Model
from trainers.pinn_gain.smooth import smooth
from trainers.pinn_gain.streams import Data, Streams

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MIN_SAMPLES = 10
"""Fewest samples of a record."""
_RESTARTS = 3
"""Largest number of restarts."""
_PATIENCE = 10
"""Consecutive iterations without a finite loss after which training is restarted."""
_WARM_UP = 20
"""Iterations over which Adam's step grows to its full size."""
_AVERAGE = 0.98
"""Weight of the past in the moving average of the weights."""
_SLOW = 5.0
"""Weight w of the scaled error relative to its logarithm in the loss."""
_RESOLUTION = 1e-3
"""Scaled error below which the loss hardly decreases."""


@dataclass(frozen=True, eq=False)
class BestGain:
    """The weights with the least validation loss so far."""

    loss: float
    """See `HeldOut.loss`."""
    iteration: int
    """The iteration of these weights; 0 stands for the initial network."""
    seed: int
    """Seed of the initial weights."""
    layers: Layers


class PinnGainTrainer(Trainer[PinnGainConfig, TrainedGain]):
    """Train a gain on a record of ``config.episodes`` episodes.

    The weights with the least loss on the held-out records are kept, the initial ones included;
    those of the variant ``kalman`` are equivalent to the EKF. If the loss is not finite in ten
    consecutive iterations, training is restarted from the next seed, at most three times.
    """

    name = "pinn_gain"
    takes = PinnGain.takes
    presets = {"default": PinnGainConfig}

    def start(self) -> None:
        config, system, record = self.config, self.system, self.record
        _check(system, record, config)
        ekf = EKF(system, *self.levels)
        self.std = np.sqrt(np.einsum("iib->i", ekf.noise.R(0.0)))
        scale = torch.tensor(vector(system.scale, system.nx, "scale"))[:, None]
        size = torch.tensor(output_scale(system))[:, None]
        self.model = Model(system, config.variant, scale, size, ekf.noise)
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
        facts = self.facts(loss=1.0, seed=config.seed)
        held_out = Data.of(system, record, smoothed, held)
        self.held_out = HeldOut(self.model, held_out, facts, self.levels[1])
        self.best: BestGain | None = None
        self.stuck = False
        self.loss, self.gradient, self.latest = math.nan, math.nan, math.nan
        self._begin(attempt=0)

    @property
    def seed(self) -> int:
        """Seed of the current attempt."""
        return self.config.seed + self.attempt

    def _begin(self, attempt: int) -> None:
        """Draw the initial weights and streams of an attempt."""
        self.attempt, self.failures, self.since = attempt, 0, 0
        # The last layer begins at zero, so that the initial network corrects nothing.
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
        self._optimiser = Adam(self.parameters)
        first = 1.0 if config.variant == "kalman" else 0.0
        memory = memory_size(config.variant, system.ny, config.width), first
        chunk = min(config.chunk, self.record.num_samples)
        sizes = (config.streams, chunk)
        self.streams = Streams(self.model, self.data, self.std, *sizes, memory, self.seed)
        if self.best is None:
            self._validate()

    def step(self) -> None:
        """Roll out all streams over one chunk, and make a step of Adam."""
        weights = list(zip(self.parameters[::2], self.parameters[1::2], strict=True))
        with np.errstate(all="ignore"):  # diverged streams are restarted
            states, errors = self.streams.roll(weights)
        loss = self._loss([state.P for state in states], errors)
        self.iteration += 1
        self.since += 1
        self.loss = loss.item()
        self._optimiser.clear()
        if math.isfinite(self.loss):
            loss.backward()
            self.gradient = float(torch.nn.utils.clip_grad_norm_(self.parameters, 1.0))
        if math.isfinite(self.loss) and math.isfinite(self.gradient):
            # A step of Adam with warm-up, then the moving average of the weights.
            self.failures = 0
            self._optimiser.step(self.config.learning_rate * min(1.0, self.since / _WARM_UP))
            kept = min(_AVERAGE, 1 - 1 / (1 + self.since / 2))
            for average, parameter in zip(self.average, self.parameters, strict=True):
                average.lerp_(parameter.detach(), 1 - kept)
        else:
            self.failures += 1
        self.streams.continue_from(states[-1])
        if self.failures == _PATIENCE:
            self._restart()
        elif self.iteration % self.config.check_every == 0:
            self._validate()

    def _loss(self, covariances: list[Tensor], errors: Tensor) -> Tensor:
        """Return the training loss of a chunk.

        It is the mean over streams of log e + we, where e is a stream's root mean square scaled
        error. The logarithm weighs all streams alike; the second term stresses slow convergence.
        With ``consistency``, the mean negative log-likelihood of the errors under the diagonal of
        the covariance is added, with heavy tails.
        """
        size = (errors.square().mean((0, 1)) + _RESOLUTION**2).sqrt()
        loss = (size.log() + _SLOW * size).mean()
        if self.config.variant == "gru" or not self.config.consistency:
            return loss
        variance = torch.stack([torch.diagonal(P).T for P in covariances])
        variance = variance / self.model.scale**2 + 1e-10
        surprise = 4 * torch.log1p(errors.square() / (4 * variance)) + variance.log()
        return loss + self.config.consistency * surprise.mean()

    def _validate(self) -> None:
        """Compute the validation loss of the averaged weights, and keep them if it is the least."""
        layers = layers_of(self.average)
        loss = self.held_out.loss(layers)
        if self.best is None or loss < self.best.loss:
            self.best = BestGain(loss, self.iteration, self.seed, layers)
        self.latest = loss

    def _restart(self) -> None:
        """Restart from the next seed, or stop after the last restart."""
        if self.attempt == _RESTARTS:
            self.stuck = True
        else:
            self._begin(self.attempt + 1)

    def finished(self) -> bool:
        """Return whether the iterations are used up, or all attempts have failed."""
        return self.iteration >= self.config.iterations or self.stuck

    def progress(self) -> float:
        return self.iteration / self.config.iterations

    def status(self) -> str:
        return f"loss {self.loss:.3g} held out {self.latest:.3f} of EKF's"

    def curves(self) -> Mapping[str, float]:
        assert self.best is not None
        return {
            "loss/train": self.loss,
            "loss/gradient": self.gradient,
            "loss/held_out": self.latest,
            "loss/best": self.best.loss,
        }

    def result(self) -> TrainedGain:
        """Return the gain with the least validation loss.

        Raises:
            FloatingPointError: in one line, if all attempts failed before any weights improved on
                the initial ones.
        """
        if self.iteration % self.config.check_every and not self.stuck:
            self._validate()
        assert self.best is not None
        if self.stuck and self.best.iteration == 0:
            raise FloatingPointError(
                f"the loss of pinn_gain on {type(self.system).__name__} left the finite numbers "
                f"from seed {self.config.seed} and the {self.attempt} after it; try a lower "
                "learning_rate"
            )
        return TrainedGain(
            **self.facts(loss=self.best.loss, seed=self.best.seed),
            layers=self.best.layers,
            variant=self.config.variant,
        )

    def figures(self, trained: TrainedGain) -> dict[str, Figure]:
        return {}

    def state(self) -> dict[str, Any]:
        assert self.best is not None
        return {
            "counts": {name: getattr(self, name) for name in _COUNTS},
            "best": {f.name: getattr(self.best, f.name) for f in fields(BestGain)},
            "streams": self.streams.state(),
            "parameters": [p.detach().numpy() for p in self.parameters],
            "average": [p.numpy() for p in self.average],
            "optimiser": self._optimiser.state(),
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        self._begin(state["counts"]["attempt"])
        self.best = BestGain(**state["best"])
        for name in _COUNTS:
            setattr(self, name, state["counts"][name])
        with torch.no_grad():
            for mine, kept in zip(self.parameters, state["parameters"], strict=True):
                mine.copy_(torch.from_numpy(kept))
        self.average = [torch.from_numpy(kept) for kept in state["average"]]
        self._optimiser.load_state(state["optimiser"])
        self.streams.load_state(state["streams"])


_COUNTS = ("attempt", "failures", "since", "stuck", "latest")
"""The counters and the latest validation loss."""


def layers_of(parameters: list[Tensor]) -> Layers:
    """Convert parameters to NumPy arrays, as pairs of weights and biases."""
    arrays = [p.detach().numpy().copy() for p in parameters]
    return tuple(zip(arrays[::2], arrays[1::2], strict=True))


def _check(system: System, record: Record, config: PinnGainConfig) -> None:
    """Check that a record can be used for training.

    Raises:
        ValueError: in one line, with the value found and the value expected.
    """
    name = type(system).__name__
    sizes = (("y", record.y, system.ny), ("u", record.u, system.nu))
    for symbol, array, size in (*sizes, ("xhat0", record.prior.mean, system.nx)):
        if array.shape[-1] != size:
            raise ValueError(f"{symbol} has {array.shape[-1]} columns; {name} has n={size}")
    if record.batch != config.episodes:
        raise ValueError(f"the record holds {record.batch} episodes; expected {config.episodes}")
    if record.num_samples < MIN_SAMPLES:
        raise ValueError(
            f"the records have {record.num_samples} samples; pinn_gain needs {MIN_SAMPLES} or more"
        )
    if np.isinf(record.y).any():
        raise ValueError(
            f"y holds infinite numbers; {name} needs finite ones, or NaN where missing"
        )
    if np.ptp(np.diff(record.t)) > 1e-6 * np.diff(record.t).mean():
        raise ValueError(
            "the records' sample times are irregular; pinn_gain trains on regular ones"
        )
