"""Trained PINN-Obs: the network's own estimates, and the observer with its learned gain."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from pinnobs_gym.estimation.estimator import Estimates, Estimator, OfflineEstimator, State
from pinnobs_gym.estimation.learned.mlp import Architecture, evaluate
from pinnobs_gym.estimation.learned.perceptron import Layers
from pinnobs_gym.estimation.learned.trained import LearnedEstimator, Trained
from pinnobs_gym.estimation.learned.trained_file import check_same
from pinnobs_gym.estimation.takes import EVERYTHING
from pinnobs_gym.registry import TRAINERS
from pinnobs_gym.simulation.model import substeps
from pinnobs_gym.simulation.motion import inputs_at
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.runge_kutta import runge_kutta
from pinnobs_gym.simulation.system import System
from pinnobs_gym.simulation.value_shape import outputs_at
from pinnobs_gym.simulation.values import shortly


@dataclass(frozen=True, eq=False)
class Covariance:
    """Covariances of a network's estimates, interpolated between given times."""

    t: np.ndarray
    """Times in s, ascending, shape (num_times,)."""
    P: np.ndarray
    """Covariances at these times, shape (num_times, nx, nx), in products of state units."""

    def __call__(self, t: np.ndarray) -> np.ndarray:
        """Return covariances (..., nx, nx) at times t (...) in s, interpolated linearly and held
        constant outside the given times."""
        after = np.clip(np.searchsorted(self.t, t), 1, len(self.t) - 1)
        part = np.clip((t - self.t[after - 1]) / (self.t[after] - self.t[after - 1]), 0, 1)
        part = part[..., None, None]
        return (1 - part) * self.P[after - 1] + part * self.P[after]


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainedNetwork(Trained):
    """A network trained on one record, with the weights of the least training loss."""

    architecture: Architecture
    layers: Layers
    """Weights (fan_out, fan_in) and biases (fan_out,) of each layer."""
    t: np.ndarray
    """Sample times in s of the training record, shape (num_samples,)."""
    y: np.ndarray
    """Outputs of the training record, shape (num_samples, ny)."""
    covariance: Covariance | None = None
    """Covariances of the estimates, if the recipe computes them."""
    recipe: str
    """The recipe in a few words; see `pinnobs_gym.training.settings.TrainingConfig.recipe`."""
    knows: tuple[str, ...]
    """The information that the training used; see the same class."""

    @property
    def notes(self) -> Mapping[str, Any]:
        return {"recipe": self.recipe, "knows": self.knows}

    def xhat(self, t: np.ndarray) -> np.ndarray:
        """Return the network's estimates (..., nx), in state units, at times t (...) in s."""
        return self._evaluate(t)[0]

    def gain(self, t: np.ndarray) -> np.ndarray:
        """Return the learned gains L (..., nx, ny), in state units per s and output unit, at times
        t (...) in s. Outside the record's times they are extrapolated by the network."""
        return self._evaluate(t)[1]

    def check_fits(self, path: str | Path, system: System) -> None:
        sizes = {"nx": self.architecture.nx, "ny": self.architecture.ny}
        check_same(path, sizes, {"nx": system.nx, "ny": system.ny})

    def _evaluate(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return evaluate(self.architecture, self._doubled, t)

    @cached_property
    def _doubled(self) -> Layers:
        return tuple((W.astype(float), b.astype(float)) for W, b in self.layers)


def estimates_of(rows: Sequence[TrainedNetwork], t: np.ndarray) -> Estimates:
    """Return the estimates of one network per row at times t (num_samples,) in s, with covariances
    if all networks have them."""
    xhat = np.stack([trained.xhat(t) for trained in rows])
    covariances = [trained.covariance for trained in rows if trained.covariance is not None]
    complete = len(covariances) == len(rows)
    return Estimates(
        xhat, np.stack([covariance(t) for covariance in covariances]) if complete else None
    )


STEP = 0.7
"""Longest step of the replay, relative to the time constant of the gain; the Runge-Kutta method is
stable up to 2.8."""
OUTSIDE = 0.01
"""Share of the training record by which the times of another may exceed its own."""
_TAKES = EVERYTHING - {"maps", "stiff", "bounds"}
"""What a plant may have: the rate of change is needed, at points of a loss or by explicit steps."""
MOST_STEPS = 200
"""Largest number of steps between two samples that a gain can cause."""


@dataclass(frozen=True)
class PinnObsReplay(LearnedEstimator, Estimator):
    """The observer x̂' = f(t, x̂, u) + L(t)(y − h(t, x̂, u)) with a learned gain L(t) (Farkane et
    al., PINN-Obs, the time-varying observer of "Nonlinear State Observer", run as in "Neural
    Network Training and Testing").

    Between samples the observer is integrated by the classical Runge-Kutta method. The equal steps
    are at most the system's `System.model_step`, and at most `STEP` over the largest eigenvalue of
    L(t)C, C = ∂h/∂x. Outputs are interpolated linearly from one sample to the next, and measured
    inputs as `System.input_hold` says, so that x̂ at a sample uses that sample and none after it. An
    output that is missing at
    either end of the interval contributes no correction in it. At the first sample x̂ is the prior
    mean.

    The gain was learned along one trajectory from one initial estimate. Its training does not make
    the observer stable along other trajectories.

    When to choose it: to study how a gain learned along one record acts on others, or to reproduce
    the paper. Episodes that are far from the record of the training can diverge.
    """

    trained: TrainedNetwork = field(kw_only=True, repr=False)
    """The trained network."""

    name = "pinn_obs_replay"
    takes = _TAKES
    equations = r"""
\dot{\hat x} &= f(t, \hat x, u) + L(t)\, (y - h(t, \hat x, u)), \qquad \hat x(t_0) = \hat x_0
"""
    exempt_from = {
        "blank_rows": "an output counts only between two rows that both have it",
        "units": "its gain was learned in the units of its training",
    }
    knows = ("model", "prior")
    needs_training = "pinn_obs"
    recipe = MappingProxyType({"preset": "transfer"})
    variants = (MappingProxyType({}), MappingProxyType({"preset": "plain"}))

    def unfit(self, t: np.ndarray) -> str:
        """Return which times are not among those of the training record: the gain is a function of
        time, which a network does not continue."""
        first, last = float(self.trained.t[0]), float(self.trained.t[-1])
        margin = OUTSIDE * (last - first)
        if first - margin <= t[0] and t[-1] <= last + margin:
            return ""
        return (
            f"was trained on t={first:g} s to {last:g} s; the record has t={t[0]:g} s to "
            f"{t[-1]:g} s, where its gain was not learned"
        )

    def reset(self, prior: Prior) -> State:
        return State(prior.mean)

    def update(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        xhat = state.xhat
        if state.t is not None:
            with np.errstate(all="ignore"):  # diverged rows are marked by their non-finite values
                xhat = self._step(state, t, y, u)
        return State(xhat, t, u, memory=y)

    def _step(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return x̂ (batch, nx) at time t, integrated from the previous sample. Rows with equal step
        limits are integrated together."""
        assert state.t is not None
        start, x, u0, y0 = state.t, state.xhat.copy(), state.u, state.memory
        fastest = np.broadcast_to(self._fastest(start, t, u0, u), len(x))
        for value in np.unique(fastest):
            rows = fastest == value
            before = None if u0 is None else u0[rows]
            x[rows] = self._integrated(
                (start, t), x[rows], (y0[rows], y[rows]), (before, u[rows]), STEP / float(value)
            )
        return x

    def _integrated(
        self,
        times: tuple[float, float],
        x: np.ndarray,
        outputs: tuple[np.ndarray, np.ndarray],
        inputs: tuple[np.ndarray | None, np.ndarray],
        longest: float,
    ) -> np.ndarray:
        """Return x̂ (batch, nx) at the second of two times.

        Args:
            times: the two times in s.
            x: x̂ at the first, shape (batch, nx).
            outputs: outputs at both, shape (batch, ny) each.
            inputs: inputs at both, shape (batch, nu) each.
            longest: the longest step in s.
        """
        (start, end), (y0, y) = times, outputs
        missing = np.isnan(y0) | np.isnan(y)
        slope = self.system.output_residual(y, y0) / (end - start)
        y0, slope = np.where(missing, 0.0, y0), np.where(missing, 0.0, slope)

        for t, step, u in substeps(self.system, start, end, x, *inputs, longest):
            L = self.trained.gain(t)

            def rate(
                stage: int, x: np.ndarray, t: np.ndarray = t, u: np.ndarray = u, L: np.ndarray = L
            ) -> np.ndarray:
                k = (0, 1, 1, 2)[stage]  # index of the stage's time: start, midpoint or end
                outputs = outputs_at(self.system, t[k], x, u[k])
                given = y0 + (t[k] - start) * slope
                innovation = self.system.output_residual(given, outputs)
                innovation = np.where(missing, 0.0, innovation)
                return self.system.f(t[k], x, u[k]) + innovation @ L[k].T

            x = runge_kutta(rate, x, step)
        return x

    def _fastest(
        self, start: float, end: float, u0: np.ndarray | None, u1: np.ndarray
    ) -> np.ndarray:
        """Return the largest absolute eigenvalue of L(t)C in 1/s at three times from start to end
        (s), limited so that at most `MOST_STEPS` steps result.

        C = ∂h/∂x is evaluated at the network's own estimates. The shape is (batch,) if the input is
        measured, with values u0 and u1 (batch, nu) at both ends, and (1,) otherwise.
        """
        t = np.linspace(start, end, 3)
        if self.system.measured_input and u0 is not None:
            u = inputs_at(self.system, t, np.array([0.0, 0.5, 1.0]), u0, u1)
        else:
            u = np.asarray(self.system.input(t))[:, None]
        x = np.repeat(self.trained.xhat(t)[:, None], u.shape[1], axis=1)
        H = np.asarray(self.system.h_jacobian(t[:, None], x, u))
        largest = abs(np.linalg.eigvals(H @ self.trained.gain(t)[:, None])).max(axis=(0, 2))
        once = STEP / (end - start)  # the rate for which the interval is one step
        return np.clip(largest, once, MOST_STEPS * once)


@dataclass(frozen=True)
class PinnObsDirect(LearnedEstimator, OfflineEstimator):
    """The network's own estimates x̂(t) (Farkane et al., PINN-Obs, "Proposed Adaptive PINN-Based
    Model"), which are valid only for its training record.

    When to choose it: to see what a trained network says of the record of its own training. It
    cannot be used on any other.
    """

    trained: TrainedNetwork = field(kw_only=True, repr=False)
    """The trained network."""

    name = "pinn_obs_direct"
    takes = _TAKES
    equations = r"""
(\hat x(t), L(t)) &= \text{network}(t), \text{ of least loss on this record; see pinn\_obs}
"""
    knows = ("model", "prior")
    exempt_from = {
        **OfflineEstimator.exempt_from,
        **dict.fromkeys(
            ("shapes", "rows_independent", "purity", "save_load", "units", "noise_matrix"),
            "it takes no record but that of its training",
        ),
    }
    needs_training = "pinn_obs"

    def run(self, record: Record) -> Estimates:
        """Return x̂ at every sample, with its covariance if the training computed one.

        Raises:
            ValueError: in one line, if the record is not the network's training record.
        """
        known, given = (1, *self.trained.y.shape), record.y.shape
        if given != known:
            raise ValueError(
                f"y has shape {given}; expected {known}: this PINN-Obs serves only the record that "
                "it was trained on"
            )
        for name, known, given in (
            ("t", self.trained.t, record.t),
            ("y", self.trained.y, record.y),
        ):
            if not np.array_equal(given, known.reshape(given.shape), equal_nan=True):
                raise ValueError(
                    f"the record's {name} is not that of the record this PINN-Obs was trained on;"
                    " train on this record, or use pinn_obs_replay"
                )
        return estimates_of([self.trained], record.t)


@dataclass(frozen=True)
class PinnObs(OfflineEstimator):
    """PINN-Obs trained separately on every record, with the network's x̂(t) as estimates.

    When to choose it: to reproduce the paper, one training per record. `batch_least_squares` and
    `rts_smoother` are more precise on the systems here, at a thousandth of the cost.
    """

    config: Any = field(default_factory=lambda: PinnObs.trainer_config({}))
    """The recipe; all rows use its seed."""
    folder: Path | None = field(default=None, repr=False)
    """Folder for one subfolder ``row-<i>`` per row, with log, checkpoint and trained network;
    nothing is stored if None."""

    name = "pinn_obs"
    takes = _TAKES
    equations = r"""
(\hat x(t), L(t)) &= \text{network}_\vartheta(t) \\
\min_\vartheta \; & w_0 \| \hat x(t_0) - \hat x_0 \|^2
+ w_y \operatorname{mean} \| h(t, \hat x, u) - y \|^2 \\
& + w_{\mathrm{ode}} \operatorname{mean}
\bigl\| \dot{\hat x} - f(t, \hat x, u) - L\, (y - h(t, \hat x, u)) \bigr\|^2 \\
& + w_{\mathrm{guide}} \operatorname{mean} \| \hat x - x^{\mathrm{smoother}} \|^2
+ w_{\mathrm{gain}} \operatorname{mean} \| L - L^{\mathrm{Riccati}} \|^2 \\
\text{or, preset posterior:} \; \min_\vartheta \; & \| \hat x(t_0) - \hat x_0 \|^2_{P_0^{-1}}
+ \textstyle\sum_k \| y_k - h(t_k, \hat x, u) \|^2_{R^{-1}}
+ \int \| \dot{\hat x} - f(t, \hat x, u) \|^2_{Q^{-1}} \, dt
"""
    exempt_from = {
        name: reason
        for name, reason in OfflineEstimator.exempt_from.items()
        if name != "irregular_times"
    }
    knows = ("model", "prior")
    trains_on_record = "pinn_obs"
    variants = (MappingProxyType({}), MappingProxyType({"preset": "plain"}))

    def __post_init__(self) -> None:
        super().__post_init__()
        expected = type(self.trainer_config({}))
        if not isinstance(self.config, expected):
            raise ValueError(
                f"config={shortly(self.config)}; expected a {expected.__name__} of "
                f"{expected.__module__}"
            )

    @property
    def training(self) -> dict[str, Any]:
        config = self.config
        facts = {"trainer": "pinn_obs", "seed": config.seed, "per_record": True}
        return {**facts, "recipe": config.recipe, "knows": config.knows, "config": asdict(config)}

    def fit(self, record: Record) -> list[TrainedNetwork]:
        """Train one network per row; see `trainers.pinn_obs.PinnObsTrainer.train_rows`."""
        trainer: Any = TRAINERS.resolve("pinn_obs")
        return trainer.train_rows(
            self.system,
            self.config,
            record=record,
            noise_std=self.noise_std,
            process_noise=self.process_noise,
            folder=self.folder,
        )

    def run(self, record: Record) -> Estimates:
        """Return x̂ at every sample of networks trained on each row.

        Raises:
            KeyboardInterrupt: if Ctrl-C ended a training: what it left is not a result.
        """
        networks = self.fit(record)
        if any(network.ending == "interrupted" for network in networks):
            raise KeyboardInterrupt
        return estimates_of(networks, record.t)
