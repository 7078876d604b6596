"""A training in progress, whatever its method."""

from __future__ import annotations

import json
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pinnobs_gym.estimation.learned.mlp import Architecture, Network
from pinnobs_gym.estimation.learned.trained_file import check_same, identity, read, write
from pinnobs_gym.estimators.pinn_obs import Covariance, Trained
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System
from trainers.pinn_obs.config import Config
from trainers.pinn_obs.minimum import Best, Mark, Method
from trainers.pinn_obs.objective import Objective
from trainers.pinn_obs.passes import strung, unstrung

_RESTARTS = 3
_FREE = ("iterations", "budget", "device", "checkpoint_every", "log_every")
"""Settings that may change when training is resumed: they decide nothing but when it ends."""


class Run(ABC):
    """All that changes from one iteration to the next.

    Args:
        system: the model.
        config: the recipe.
        record: of one episode.
        noise_std: standard deviation of the output noise, shape (ny,), in output units.
    """

    def __init__(
        self, system: System, config: Config, record: Record, noise_std: np.ndarray
    ) -> None:
        self.config, self.system, self.record, self.noise_std = config, system, record, noise_std
        self.objective: Objective
        self.iteration, self._earlier, self._start = 0, 0.0, time.process_time()
        self.architecture = self._architecture()
        self._kept: Best | None = None  # of attempts that ended in a loss that is not finite
        self._begin(attempt=0)

    def _begin(self, attempt: int) -> None:
        self.attempt = attempt
        self.best: Best | None = None
        self.mark = Mark(math.inf, self.iteration)
        self.stuck = False
        self._first = strung(self._drawn(torch.Generator().manual_seed(self.seed)))
        self._method: Method | None = None

    @abstractmethod
    def _architecture(self) -> Architecture:
        """The network's sizes; sets ``objective``."""

    @abstractmethod
    def _drawn(self, generator: torch.Generator) -> Network:
        """A network of random weights."""

    @abstractmethod
    def _begun(self, theta: np.ndarray) -> Method:
        """The minimisation from weights theta (n,)."""

    @abstractmethod
    def held_out(self) -> float | None:
        """The loss on samples that are not trained on, if there are any."""

    @property
    def theta(self) -> np.ndarray:
        """The iteration's weights (n,)."""
        return self._first if self._method is None else self._method.x

    def step(self) -> None:
        """One iteration, of which the first only looks at the weights that were drawn."""
        lower = True
        if self._method is None:
            self._method = self._begun(self._first)
        else:
            lower = self._method.step(self.objective)
        self.took(self._method.f, self._method.x, lower)

    def took(self, loss: float, theta: np.ndarray, lower: bool = True) -> None:
        """Count an iteration that ended at weights theta (n,), and keep them if their loss is the
        least; ``lower`` is false if there is none lower to be found."""
        self.iteration += 1
        self.stuck = not lower
        if not math.isfinite(loss):
            self.restart()
        elif self.best is None or loss < self.best.loss:
            self._found(loss, theta)

    def terms(self) -> np.ndarray:
        """The three terms of the loss (3,) at the iteration's weights, unweighted, in the system's
        own units."""
        return self.objective.terms(self.theta)

    def network(self) -> Network:
        """The network of the least loss."""
        assert self.best is not None
        return unstrung(self.architecture, self.best.theta)

    def loss(self) -> float:
        """The paper's loss of that network."""
        assert self.best is not None
        return self.total(self.objective.terms(self.best.theta))

    def covariance(self, network: Network) -> Covariance | None:
        """What is known of the error of that network's estimates; None unless overridden."""
        return None

    @abstractmethod
    def _state(self) -> dict[str, Any]:
        """What the method needs to go on exactly: tensors and plain values."""

    @abstractmethod
    def _resumed(self, state: Mapping[str, Any]) -> Method:
        """The minimisation that goes on from what `_state` gave; called after all else is
        restored."""

    @property
    def seed(self) -> int:
        """What the present weights began from."""
        return self.config.seed + self.attempt

    @property
    def seconds(self) -> float:
        """CPU seconds so far."""
        return self._earlier + time.process_time() - self._start

    def total(self, terms: np.ndarray) -> float:
        """The paper's loss from its terms (3,)."""
        return float(terms @ [self.config.w0, self.config.w_ode, self.config.w_y])

    def _found(self, loss: float, theta: np.ndarray) -> None:
        """Keep weights of the least loss; at once, so that Ctrl-C finds them whole."""
        if loss < (1 - self.config.improvement) * self.mark.loss:
            self.mark = Mark(loss, self.iteration)
        self.best = Best(loss, self.iteration, self.seed, theta)

    def restart(self) -> None:
        """Begin again from the next seed; what was best so far is kept. After the third time there
        is no other, and the training ends."""
        self._keep()
        if self.attempt == _RESTARTS:
            self.stuck = True
        else:
            self._begin(self.attempt + 1)

    def _keep(self) -> None:
        if self.best is not None and (self._kept is None or self.best.loss < self._kept.loss):
            self._kept = self.best

    def finished(self) -> bool:
        """Whether the iterations, the patience or the CPU time are used up, or nothing lower can be
        found."""
        config = self.config
        since = self.iteration - self.mark.iteration
        spent = config.budget is not None and self.iteration > 0 and self.seconds >= config.budget
        used = self.iteration >= config.iterations or since >= config.patience
        return used or spent or self.stuck

    def result(self) -> Trained:
        """The network of the least loss of all attempts.

        Raises:
            FloatingPointError: in one line, if no loss was finite.
        """
        self._keep()
        self.best = self._kept
        if self.best is None:
            advice = "; try a lower learning_rate" if self.config.optimiser == "adam" else ""
            raise FloatingPointError(
                f"the loss of PINN-Obs on {type(self.system).__name__} left the finite numbers from"
                f" seed {self.config.seed} and the {self.attempt} after it{advice}"
            )
        about, network = identity(self.system), self.network()
        return Trained(
            network=network,
            t=self.record.t.copy(),
            y=self.record.y[0].copy(),
            system=about["system"],
            parameters=about["parameters"],
            config=asdict(self.config),
            seed=self.best.seed,
            loss=self.loss(),
            iterations=self.iteration,
            seconds=self.seconds,
            covariance=self.covariance(network),
        )

    def save(self, path: Path) -> None:
        """Write all that `restore` needs to go on exactly.

        The seed of the attempt stands for the state of chance: nothing is drawn after the weights.
        """
        assert self.best is not None
        facts = {**self._expected(), "iteration": self.iteration, "seconds": self.seconds}
        facts |= {"attempt": self.attempt, "stuck": self.stuck, "mark": asdict(self.mark)}
        facts |= {"best_loss": self.best.loss, "best_iteration": self.best.iteration}
        record = {k: torch.tensor(v) for k, v in self._record().items()}
        best = torch.from_numpy(self.best.theta)
        content = {"best": best, "record": record, "state": self._state()}
        write(path, {"facts": json.dumps(facts), **content})

    def restore(self, path: Path) -> None:
        """Take up the training of a checkpoint.

        Raises:
            ValueError: in one line, if it cannot be read or belongs to another training.
        """
        saved = read(path)
        try:
            facts = json.loads(saved["facts"])
            check_same(path, facts, self._expected())
            for name, value in self._record().items():
                if not np.array_equal(saved["record"][name].numpy(), value, equal_nan=True):
                    raise ValueError(f"{path} was trained on another record: its {name} differs")
            self._begin(facts["attempt"])
            found = (facts["best_loss"], facts["best_iteration"], self.seed)
            self.best = Best(*found, saved["best"].numpy())
            self.mark, self.stuck = Mark(**facts["mark"]), facts["stuck"]
            self.iteration = facts["iteration"]
            self._earlier += facts["seconds"]
            self._method = self._resumed(saved["state"])
        except (KeyError, TypeError, AttributeError, RuntimeError) as error:
            reason = str(error).splitlines()[0]
            raise ValueError(f"{path} is not a checkpoint of this trainer: {reason}") from None

    def _expected(self) -> dict[str, Any]:
        """What a checkpoint must agree with."""
        config = {k: v for k, v in asdict(self.config).items() if k not in _FREE}
        told = self.noise_std.tolist()
        return {**identity(self.system), "config": config, "noise_std": told}

    def _record(self) -> dict[str, np.ndarray]:
        record = self.record
        return {"t": record.t, "y": record.y, "u": record.u, "xhat0": record.prior.mean}
