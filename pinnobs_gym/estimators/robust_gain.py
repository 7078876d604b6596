"""A bank of Kalman filters under several beliefs about the plant, whose probabilities are learned
in advance and updated by each sample."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pinnobs_gym.estimation.compiled_code import noise_at, of_rows
from pinnobs_gym.estimation.estimator import Estimates, Estimator, State
from pinnobs_gym.estimation.gaussian import checked
from pinnobs_gym.estimation.learned.beliefs import OUTLIER_SIZE, Beliefs, starts
from pinnobs_gym.estimation.learned.trained import LearnedEstimator, Trained
from pinnobs_gym.estimation.learned.trained_file import check_same
from pinnobs_gym.estimation.outliers import OutlierLaw
from pinnobs_gym.estimation.sigma_points import SigmaPointMemory
from pinnobs_gym.estimation.takes import EVERYTHING
from pinnobs_gym.estimators.ukf import UKF
from pinnobs_gym.simulation.noise import AssumedNoise, Level, SampledLevel
from pinnobs_gym.simulation.notices import say_once
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.residual import Periods, nearest
from pinnobs_gym.simulation.system import System
from pinnobs_gym.simulation.uncertain_plant import with_uncertain_plant

if TYPE_CHECKING:
    from pinnobs_gym.estimation.export.algorithm import Algorithm
    from pinnobs_gym.simulation.kernels.plant_code import PlantCode

__all__ = ["BeliefFilter", "RobustGain", "RobustGainMemory", "SigmaPointMemory", "TrainedBeliefs"]
# A saved state of `Live` is made of the dataclasses that this module knows, SigmaPointMemory among
# them.

NOISE = (0.1, 15.0)
"""Range of the output noise of training episodes, over that of the setup."""
_NUMBERS = 2 * 10**7
"""Approximate number of values of all hypotheses that are held at a time."""
_UNLIKELY = 0.02
"""Probability, over that of the likeliest hypothesis, below which one has no part in estimates: a
filter that has long been lost may be arbitrarily far away."""


@dataclass(frozen=True)
class BeliefFilter(UKF):
    """The unscented Kalman filter under one belief. What it cannot do is not told: a belief may be
    far from what is true, and then has no part in the estimate."""

    template = "sigma_points"

    def _say_if_too_large(self, noise: AssumedNoise) -> None:
        pass

    def _notice(self, function: str) -> str:
        return ""


def filters_of(
    beliefs: Beliefs, system: System, noise_std: Level | SampledLevel | None, process_noise: Any
) -> tuple[BeliefFilter, ...]:
    """Return the filter of each belief: on the model or, where the plant may deviate from it, on
    the model with these deviations as further states.

    Args:
        beliefs: the beliefs.
        system: the model.
        noise_std: the known output noise, as `BaseEstimator.noise_std`.
        process_noise: the known process noise, as `BaseEstimator.process_noise`.

    Raises:
        ValueError: in one line, if the plant has nothing that may deviate.
    """
    filters = []
    known = system.noise(noise_std, process_noise)
    for noise, deviation, outliers in zip(
        beliefs.assumed_noise.tolist(),
        beliefs.deviation.tolist(),
        beliefs.outliers.tolist(),
        strict=True,
    ):
        plant: System | None = system
        level = process_noise
        if deviation:
            plant = with_uncertain_plant(system, deviation)
            if plant is None:
                raise ValueError(f"{type(system).__name__} has nothing that may deviate")
            L = np.zeros((plant.nx, known.L(0.0).shape[1]))
            L[: system.nx] = known.L(0.0)[..., 0]
            level = L.tolist()
        law = {"outliers": outliers, "outlier_size": OUTLIER_SIZE} if outliers else {}
        filters.append(BeliefFilter(plant, noise_std, level, assumed_noise=noise, **law))
    return tuple(filters)


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainedBeliefs(Trained):
    """Learned beliefs. Their loss is the mean negative logarithm of the density of the true states
    at samples of held-out episodes, over that of the filter that is best there in hindsight; or
    that of the outputs, if they were learned from outputs alone."""

    beliefs: Beliefs
    """The beliefs that were kept."""
    leak: float
    """Part of the probabilities that returns to those before the first sample, at each sample."""

    def check_fits(self, path: str | Path, system: System) -> None:
        check_same(path, {"nx": self.beliefs.mean.shape[1]}, {"nx": system.nx})


@dataclass(frozen=True)
class RobustGainMemory:
    """The memory of the bank in addition to the fields of `State`."""

    states: tuple[State, ...]
    """The state of the filter of each belief, of batch × hypotheses rows."""
    probability: np.ndarray
    """Probabilities of the hypotheses, shape (hypotheses, batch)."""
    lost: np.ndarray
    """Which filters have diverged, bool, shape (hypotheses, batch)."""


@dataclass(frozen=True, eq=False)
class Adaptation:
    """The noise with which samples were used, and the beliefs behind it."""

    process_noise: np.ndarray
    """Root mean square of the process noise, as `GaussianEstimator.assumed_noise`, shape (batch,
    num_samples)."""
    output_noise: np.ndarray
    """Factor of each output's standard deviation, at least 1, shape (batch, num_samples, ny)."""
    beliefs: np.ndarray
    """Probabilities of the beliefs, shape (batch, num_samples, beliefs)."""


@dataclass(frozen=True)
class RobustGain(LearnedEstimator, Estimator):
    """A Gaussian-sum filter that adapts its gain by weighing beliefs about the plant: that the
    model is right, that there is process noise of some size, that parameters are off by some part,
    that some outputs are outliers, that the initial state is further away than the prior says.

    Under each belief, unscented Kalman filters start from several parts of the prior, so that the
    law of the state need not be Gaussian before the outputs have told it (Alspach & Sorenson 1972).
    Where parameters may be off, they are further states. The innovations' densities weigh the
    filters as in the multiple-model approach (Magill 1965; Bar-Shalom, Li & Kirubarajan 2001,
    section 11.6). Estimate and covariance are the mean and the covariance of the mixture. The
    probabilities of the beliefs before the first sample, and the parts of the initial set, are
    learned on simulations of the model under random conditions (`trainers.robust_gain`).

    Noise, prior and sample times are those that the estimator is told, which may differ from those
    of the training.

    When to choose it: where the model may be wrong and nobody knows how, or outputs tell the state
    only after a while, and a training of a minute and a hundred times the time of `ukf` do not
    matter.
    """

    trained: TrainedBeliefs = field(kw_only=True, repr=False)
    """The learned beliefs."""

    name = "robust_gain"
    takes = EVERYTHING
    equations = r"""
p_k^{(i)} &\propto \bigl( (1 - \lambda) p_{k-1}^{(i)} + \lambda p_0^{(i)} \bigr)\,
p(e_k^{(i)}), \qquad
p(e) = \prod_j (1 - \varepsilon_i) N(e_j; 0, S_{jj})
+ \varepsilon_i N(e_j; 0, S_{jj} + (\mathrm{size}^2 - 1) R_{jj}) \\
\hat x_k &= \sum_i p_k^{(i)} \hat x_k^{(i)}, \qquad
P_k = \sum_i p_k^{(i)} \bigl( P_k^{(i)} + (\hat x_k^{(i)} - \hat x_k)(\cdot)^\top \bigr)
"""
    needs_training = "robust_gain"
    knows = ("model", "prior", "noise", "initial set", "randomised conditions")
    exempt_from = {
        "model_alone": "its mean is that of points that the model has moved apart",
        "blank_rows": "its filters draw their points anew at every row",
    }

    @cached_property
    def noise(self) -> AssumedNoise:
        """The known noise, with an output noise above zero."""
        return AssumedNoise.of(
            self.system, self.system.noise(self.noise_std, self.process_noise), 0
        )

    @cached_property
    def filters(self) -> tuple[BeliefFilter, ...]:
        """The filter of each belief."""
        self._say_if_far()
        return filters_of(self.trained.beliefs, self.system, self.noise_std, self.process_noise)

    def _say_if_far(self) -> None:
        """Log in one line where the output noise is far from that of the training."""
        R = self.noise.R(0.0)
        std = np.sqrt(np.einsum("iib->i", R) / R.shape[-1])
        trained = np.array(self.trained.noise_std)
        ratio = std / np.where(trained > 0, trained, std)
        if (ratio < 0.99 * NOISE[0]).any() or (ratio > 1.01 * NOISE[1]).any():
            worst = int(np.argmax(abs(np.log(ratio))))
            say_once(
                f"{self.label} on {type(self.system).__name__}: the noise of "
                f"{self.system.output_names[worst]} is {ratio[worst]:.3g} times that of the "
                f"training, which saw {NOISE[0]:g} to {NOISE[1]:g} times; a training at this noise "
                "may do better"
            )

    def reset(self, prior: Prior) -> State:
        prior, beliefs = checked(prior), self.trained.beliefs
        systems = [each.system for each in self.filters]
        states = tuple(
            each.reset(start)
            for each, start in zip(self.filters, starts(beliefs, systems, prior), strict=True)
        )
        probability = np.tile(np.exp(beliefs.log_prior), (len(prior.mean), 1))
        memory = RobustGainMemory(states, probability, np.zeros(probability.shape, dtype=bool))
        return State(prior.mean, P=prior.cov, memory=memory)

    def update(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        memory: RobustGainMemory = state.memory
        batch, states = len(y), []
        for each, before in zip(self.filters, memory.states, strict=True):
            rows = np.repeat(np.arange(batch), len(before.xhat) // batch)
            states.append(of_rows(each, rows).update(before, t, y[rows], u[rows]))
        found = Estimates(
            **{
                name: _by_episode([getattr(own, name)[:, None] for own in states], batch, sizes)
                for name, sizes in self._sizes.items()
            }
        )
        mixed, probability, lost = self._mixed(
            found, self.noise.R(t, y)[None], np.isnan(y)[:, None], memory.probability, memory.lost
        )
        assert mixed.P is not None
        assert mixed.innovation is not None
        assert mixed.S is not None
        return State(
            mixed.xhat[:, 0],
            t,
            u,
            mixed.P[:, 0],
            mixed.innovation[:, 0],
            mixed.S[:, 0],
            RobustGainMemory(tuple(states), probability[:, -1], lost),
        )

    def run(self, record: Record) -> Estimates:
        parts = [mixed for mixed, _ in self._blocks(record)]
        fields = ("xhat", "P", "innovation", "S")
        return Estimates(**{n: np.concatenate([getattr(p, n) for p in parts]) for n in fields})

    def beliefs(self, record: Record) -> np.ndarray:
        """Return the probabilities of the beliefs (`Beliefs.names`) after each sample of a record,
        shape (batch, num_samples, beliefs)."""
        probability = np.concatenate([found for _, found in self._blocks(record)])
        own = self.trained.beliefs
        sums = [probability[..., own.belief == i].sum(axis=-1) for i in range(len(own.weight))]
        return np.stack(sums, axis=-1)

    def adaptation(self, record: Record) -> Adaptation:
        """Return how a record makes the estimator adapt: the means, over the hypotheses with their
        probabilities, of the noise with which they use each sample."""
        beliefs, found = self.trained.beliefs, self.hypotheses(record)
        assert found.innovation is not None
        assert found.S is not None
        probability = np.concatenate([part for _, part in self._blocks(record)])
        belief, (batch, _, n, ny) = beliefs.belief, found.innovation.shape
        factor = np.ones((batch, n, ny))
        R = np.einsum("nii->ni", noise_at(self.noise, record.t)[..., 0])
        for i in np.flatnonzero(beliefs.outliers):
            law, rows = OutlierLaw(float(beliefs.outliers[i]), OUTLIER_SIZE), belief == i
            with np.errstate(all="ignore"):
                larger = law.factors(
                    np.moveaxis(found.innovation[:, rows], -1, 0),
                    np.moveaxis(np.einsum("bknii->bkni", found.S[:, rows]), -1, 0),
                    np.broadcast_to(R, (n, ny)).T[:, None, None],
                )
            larger = np.moveaxis(np.where(np.isfinite(larger), larger, 1.0), 0, -1)
            factor += np.einsum("bnk,bkni->bni", probability[..., rows], larger - 1)
        variance = probability @ beliefs.assumed_noise[belief] ** 2
        return Adaptation(np.sqrt(variance), np.sqrt(factor), self.beliefs(record))

    def hypotheses(self, record: Record) -> Estimates:
        """Return the estimates of the filter of each hypothesis, arrays (batch, hypotheses,
        num_samples, ...); see `Beliefs`. Rows that have diverged are not finite."""
        prior, systems = checked(record.prior), [each.system for each in self.filters]
        found = []
        for each, start in zip(
            self.filters, starts(self.trained.beliefs, systems, prior), strict=True
        ):
            rows = np.repeat(np.arange(record.batch), len(start.mean) // record.batch)
            own = replace(record.rows(rows), prior=start)
            with np.errstate(all="ignore"):
                found.append(of_rows(each, rows).run(own))
        return Estimates(
            **{
                name: _by_episode([getattr(own, name) for own in found], record.batch, sizes)
                for name, sizes in self._sizes.items()
            }
        )

    def _blocks(self, record: Record) -> Iterator[tuple[Estimates, np.ndarray]]:
        """Yield the estimates of some rows after the other, and the probabilities of the hypotheses
        (rows, num_samples, hypotheses)."""
        nx, ny = self.system.nx, self.system.ny
        count = len(self.trained.beliefs.belief)
        numbers = record.num_samples * count * (nx + nx**2 + ny + ny**2)
        size = max(1, _NUMBERS // numbers)
        for first in range(0, record.batch, size):
            rows = np.arange(first, min(first + size, record.batch))
            estimator = of_rows(self, rows)
            yield estimator._through(record.rows(rows))

    def _through(self, record: Record) -> tuple[Estimates, np.ndarray]:
        """Return the estimates of a record, and the probabilities of the hypotheses (batch,
        num_samples, hypotheses)."""
        beliefs = self.trained.beliefs
        probability = np.tile(np.exp(beliefs.log_prior), (record.batch, 1))
        mixed, probability, _ = self._mixed(
            self.hypotheses(record),
            noise_at(self.noise, record.t),
            np.isnan(record.y),
            probability,
            np.zeros(probability.shape, dtype=bool),
        )
        return mixed, probability

    @property
    def _sizes(self) -> dict[str, tuple[int, ...]]:
        """The sizes of the fields of `Estimates` without further states."""
        nx, ny = self.system.nx, self.system.ny
        return {"xhat": (nx,), "P": (nx, nx), "innovation": (ny,), "S": (ny, ny)}

    @np.errstate(all="ignore")  # rows without a sound filter are NaN
    def _mixed(
        self,
        found: Estimates,
        R: np.ndarray,
        missing: np.ndarray,
        probability: np.ndarray,
        lost: np.ndarray,
    ) -> tuple[Estimates, np.ndarray, np.ndarray]:
        """Return the moments of the mixture of the filters at n samples, the probabilities of the
        hypotheses (batch, n, hypotheses), and which filters have diverged (batch, hypotheses).

        Args:
            found: the filters' estimates, arrays (batch, hypotheses, n, ...).
            R: covariance of the output noise, shape (n or 1, ny, ny, batch or 1).
            missing: which outputs are missing, bool, shape (batch, n, ny).
            probability: probabilities of the hypotheses before, shape (batch, hypotheses).
            lost: which filters have diverged before, same shape.
        """
        assert found.P is not None
        assert found.innovation is not None
        assert found.S is not None
        beliefs, leak = self.trained.beliefs, self.trained.leak
        sound = np.isfinite(found.xhat).all(axis=-1) & np.isfinite(found.P).all(axis=(-2, -1))
        gone = np.logical_or.accumulate(np.concatenate([lost[..., None], ~sound], axis=2), axis=2)
        gone = gone[..., 1:]
        density = beliefs.densities(found.innovation, found.S, R, missing)
        density = np.where(gone, -np.inf, density).transpose(2, 0, 1)  # time first
        gone, first = gone.transpose(2, 0, 1), np.exp(beliefs.log_prior)
        before, after = np.empty(density.shape), np.empty(density.shape)
        for k, log in enumerate(density):
            # Predicted probabilities, then Bayes' rule
            probability = (1 - leak) * probability + leak * first
            probability = np.where(gone[k], 0.0, probability)
            probability = probability / probability.sum(axis=1, keepdims=True)
            before[k] = probability
            largest = log.max(axis=1, keepdims=True)
            told = np.isfinite(largest)  # without any density, a sample tells nothing
            likelihood = np.where(told, np.exp(log - np.where(told, largest, 0.0)), 1.0)
            probability = probability * likelihood
            total = probability.sum(axis=1, keepdims=True)
            probability = np.where(total > 0, probability / total, before[k])
            after[k] = probability
        period = self.system.state_period
        xhat, P = _moments(after, found.xhat, found.P, period)
        innovation, S = _moments(before, found.innovation, found.S, None)
        if period is not None:
            xhat = nearest(xhat, 0.0, period)
        return Estimates(xhat, P, innovation, S), after.swapaxes(0, 1), gone[-1]

    def exported(self, code: PlantCode, prior: Prior) -> Algorithm | None:
        return None


def _by_episode(parts: list[np.ndarray], batch: int, sizes: tuple[int, ...]) -> np.ndarray:
    """Return arrays (batch·hypotheses, n, ...) of several filters as one of shape (batch,
    hypotheses, n, *sizes), without further states."""
    own = tuple(slice(size) for size in sizes)
    rows = [part[(..., *own)].reshape(batch, -1, *part.shape[1:2], *sizes) for part in parts]
    return np.concatenate(rows, axis=1)


def _moments(
    probability: np.ndarray, mean: np.ndarray, cov: np.ndarray, period: Periods | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the means (batch, n, m) and the covariances (batch, n, m, m) of mixtures; NaN where
    no part is left.

    Args:
        probability: probabilities of the parts, shape (n, batch, parts).
        mean: means of the parts, shape (batch, parts, n, m).
        cov: their covariances, shape (batch, parts, n, m, m).
        period: period of each of the m values, as `System.state_period`.
    """
    weight = probability.transpose(1, 2, 0)
    largest = weight.max(axis=1, keepdims=True)
    weight = np.where(weight > _UNLIKELY * largest, weight, 0.0)
    weight = weight / weight.sum(axis=1, keepdims=True)  # NaN where no part is left
    if period is not None:  # of an angle, the values nearest to that of the likeliest part
        likeliest = np.take_along_axis(mean, weight.argmax(axis=1)[:, None, :, None], axis=1)
        mean = nearest(mean, likeliest, period)
    used = weight != 0
    mean = np.where(used[..., None], mean, 0.0)
    cov = np.where(used[..., None, None], cov, 0.0)
    middle = np.einsum("bpn,bpnm->bnm", weight, mean)
    off = np.where(used[..., None], mean - middle[:, None], 0.0)
    total = np.einsum("bpn,bpnij->bnij", weight, cov)
    total += np.einsum("bpn,bpni,bpnj->bnij", weight, off, off)
    return middle, (total + total.swapaxes(-2, -1)) / 2
