"""The particle filter: the bootstrap filter, with the kernels of Liu and West where process noise
is small."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from pinnobs_gym.estimation.circular import gathered
from pinnobs_gym.estimation.compiled_particles import CompiledParticles
from pinnobs_gym.estimation.estimator import Range, State
from pinnobs_gym.estimation.gaussian import checked
from pinnobs_gym.estimation.least_squares import root
from pinnobs_gym.estimation.random_streams import generator
from pinnobs_gym.estimation.recursive import RecursiveEstimator
from pinnobs_gym.estimation.regularisation import (
    Sample,
    shrinkage_of,
    shrinkages,
    usual_shrinkage,
)
from pinnobs_gym.estimation.wrapping import say_of_outputs
from pinnobs_gym.simulation.kernels.plant_library import PlantLibrary
from pinnobs_gym.simulation.matrices import cholesky, factor, moments, spread, total, weighted_mean
from pinnobs_gym.simulation.model import noisy_model_step
from pinnobs_gym.simulation.notices import say_once
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.value_shape import outputs_at
from pinnobs_gym.simulation.values import check_points

_FEW = 10
"""The likelihood is tempered if it would reduce the effective number of particles to less than
their number over this."""
_COLLAPSED = 5
"""Effective number of particles below which covariances are not to be trusted, if it happens in
more than a tenth of the samples: of a random walk they are then half of what they ought to be."""
_ROUNDS = 100
"""Largest number of tempering steps per sample."""
_LARGEST = 1e150
"""Absolute value of a state beyond which a particle counts as overflowed; its square is finite."""
_ZERO = -1e300
"""Logarithm of the weight of a particle that is out of the question. It is finite, so that a zeroth
power of it is one."""
_HALVINGS = 60
"""Number of bisection steps in the search of a tempering power. After a prior that is wide relative
to the output noise, the first power is as small as R/P₀."""


@dataclass(frozen=True)
class ParticleMemory:
    """The weighted particles."""

    particles: np.ndarray
    """States, shape (num_particles, batch, nx)."""
    log_weights: np.ndarray
    """Logarithms of the weights, shape (num_particles, batch); the weights sum to one."""
    collapses: np.ndarray
    """Number of samples so far that would have left fewer than `_COLLAPSED` effective particles
    without tempering, shape (batch,)."""
    sample: int = 0
    """Number of samples processed so far."""


@dataclass(frozen=True)
class ParticleFilter(RecursiveEstimator):
    """The bootstrap particle filter (Gordon, Salmond & Smith 1993), with the kernels of Liu and
    West (2001) for plants with little process noise or none.

    Particles are propagated by the model, with its process noise, and weighted by the likelihood of
    the outputs. Where their effective number falls below half of the particles, they are resampled
    systematically (Kitagawa 1996). The likelihood of a sample that would reduce the effective
    number below a tenth is tempered (Neal 2001).

    Without process noise, or with too little of it, few distinct particles would soon remain. New
    particles are then drawn from Gaussians about the resampled ones, whose centres are shrunk
    towards the mean so that the mean and the covariance of the set are preserved in expectation.
    This is artificial noise. By default, it makes up for what the known noise lacks
    (`pinnobs_gym.estimation.regularisation`); it also follows each tempering step.

    A particle that overflows, that is outside of the states' bounds, or at which the output is not
    defined, has the weight zero. Where this holds for all particles of an episode, they stay where
    they are, or the sample counts as missing, and the log says so once. It also says where outputs
    leave few effective particles too often.

    Particles that differ by whole turns of an angle are the same states: they are taken within half
    a turn of their circular mean, and so are their outputs.

    Random numbers depend only on the seed and the sample, and all episodes of a batch share them.
    Results are therefore reproducible, and the result of an episode does not depend on the others
    in its batch.

    Default tuning is the same rule for all systems: particles are drawn from the Gaussian prior,
    and the likelihood follows from the known output noise.

    When to choose it: where there are few states, about five at most, and what is known of them is
    not one hump: several places are possible, or the prior is very wide. A step costs some thousand
    times that of `ekf`.
    """

    particles: int = 500
    """Number of particles, from 2 to 1000000."""
    discount: float | None = None
    """Liu and West's δ; the Gaussians have 1 − ((3δ − 1)/2δ)² times the variance of the set. If
    None, their variance follows from the process noise."""
    seed: int = 0
    """Seed of the random numbers."""

    name = "particle"
    template: ClassVar[str] = "particles"
    exempt_from = {
        "model_alone": "its mean is that of points that the model has moved apart",
        "blank_rows": "its random numbers are drawn row by row",
    }
    equations = r"""
x_i &:= \varphi(x_i, w_i) \quad \text{with } dx = f\, dt + L\, dw_i \\
w_i &:\propto w_i \exp\bigl( -\tfrac12 e_i^\top R^{-1} e_i \bigr), \qquad
e_i = y_k - h(t_k, x_i, u_k) \\
\hat x_k &= \sum_i w_i x_i, \qquad P_k = \sum_i w_i (x_i - \hat x_k)(x_i - \hat x_k)^\top \\
\text{if } \Bigl( \sum_i w_i^2 \Bigr)^{-1} &< \frac N2: \quad
x_i := a\, x_{j(i)} + (1 - a)\, \hat x_k + \sqrt{1 - a^2} \sqrt{P_k}\, \xi_i, \quad
w_i := \frac1N \\
1 - a^2 &= \max\bigl(0, \kappa(0.95) - q_k\bigr), \qquad
\kappa(\delta) = 1 - \Bigl( \frac{3 \delta - 1}{2 \delta} \Bigr)^2 \\
\xi_i &\sim \mathcal N(0, I), \qquad j(i) \text{ drawn by the weights}
"""
    tunable = {"discount": Range(0.8, 0.999)}

    def __post_init__(self) -> None:
        super().__post_init__()
        check_points("particles", self.particles)
        if self.discount is not None and not 1 / 3 < self.discount <= 1:
            raise ValueError(f"discount={self.discount}; expected a number in (1/3, 1]")

    def reset(self, prior: Prior) -> State:
        prior = checked(prior)
        L = root(prior.cov.transpose(1, 2, 0))
        draws = generator(self.seed, 0).standard_normal((self.particles, self.system.nx))
        particles = prior.mean + spread(L, draws)
        log_weights = np.full(particles.shape[:2], -np.log(self.particles))
        return State(
            prior.mean,
            P=prior.cov,
            memory=ParticleMemory(particles, log_weights, np.zeros(len(prior.mean))),
        )

    def predict(self, state: State, t: float, u: np.ndarray) -> State:
        assert state.t is not None
        memory: ParticleMemory = state.memory
        rng = generator(self.seed, 2, memory.sample)
        x = noisy_model_step(
            self.system,
            self.noise,
            state.t,
            t,
            memory.particles,
            state.u,
            u,
            lambda size: rng.standard_normal((self.particles, 1, size)),
        )
        log_weights = memory.log_weights
        lost: np.ndarray = np.logical_not((abs(x) < _LARGEST).all(axis=-1))
        if lost.any():
            x, log_weights = self._without(lost, x, memory)
        weights = np.exp(log_weights)
        x = gathered(x, self.system.state_period, weights)
        xhat = weighted_mean(weights, x)
        memory = replace(memory, particles=x, log_weights=log_weights)
        return State(xhat, state.t, state.u, memory=memory)

    def _without(
        self, lost: np.ndarray, x: np.ndarray, memory: ParticleMemory
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the particles and the logarithms of their weights, zero for the lost ones (number,
        batch). These take their states before the step, which are finite."""
        x = np.where(lost[..., None], memory.particles, x)
        trial = np.where(lost, _ZERO, memory.log_weights)
        every = trial.max(axis=0) <= _ZERO
        if every.any():
            self._say("all particles overflow in the model; they stay where they are")
        unchanged = every | ~lost.any(axis=0)
        return x, np.where(unchanged, memory.log_weights, _normalised(trial))

    def _say(self, what: str) -> None:
        say_once(f"particle filter on {type(self.system).__name__}: {what}")

    def correct(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        memory: ParticleMemory = state.memory
        x, log_weights = memory.particles, memory.log_weights
        missing = np.isnan(y)
        # The predicted output and its covariance, from the particles before the update.
        outputs = np.where(missing, 0.0, outputs_at(self.system, t, x, u))
        sample, weights = Sample.of(self.noise, state.t, t, y, u), np.exp(log_weights)
        if self.system.output_period is not None:
            _, P = moments(weights, x)
            say_of_outputs(self.label, self.system, (t, y, u), state.xhat, P, sample.R)
        outputs = gathered(outputs, self.system.output_period, weights)
        yhat, S = _predicted_output(weights, outputs)
        S = S + sample.R.transpose(2, 0, 1)
        x, log_weights, effective = self._tempered(x, log_weights, sample, memory.sample)
        collapses = self._counted(memory, effective)
        weights = np.exp(log_weights)
        x = gathered(x, self.system.state_period, weights)
        xhat, P = moments(weights, x)
        # Resample the episodes whose effective number of particles, 1/Σw², is below half.
        rows = np.flatnonzero(total(weights**2) > 2 / self.particles)
        if len(rows):
            stream = memory.sample, _ROUNDS
            part = sample.rows(rows)
            x, log_weights = self._resampled(x, log_weights, rows, stream, part, tempering=False)
        memory = ParticleMemory(x, log_weights, collapses, memory.sample + 1)
        innovation = self.system.output_residual(y, yhat)
        innovation = np.where(missing | np.isnan(yhat), 0.0, innovation)
        return State(xhat, t, u, (P + P.swapaxes(1, 2)) / 2, innovation, S, memory)

    def memory_rows(self, memory: ParticleMemory, rows: np.ndarray) -> ParticleMemory:
        particles, log_weights = memory.particles.take(rows, 1), memory.log_weights.take(rows, 1)
        return ParticleMemory(particles, log_weights, memory.collapses[rows], memory.sample)

    def compiled_with(self, made: PlantLibrary) -> CompiledParticles:
        return CompiledParticles(self, made, _ROUNDS, self.particles / _FEW, _COLLAPSED)

    def shrinkage(self, tempering: bool) -> float:
        """Return by how much centres of kernels are shrunk without process noise, in tempering or
        after a sample; see `pinnobs_gym.estimation.regularisation`."""
        if self.discount is None:
            return usual_shrinkage(tempering=tempering)
        return shrinkage_of(self.discount)

    def most_collapses(self, sample: int) -> float:
        """Return the number of collapses beyond which the log says so at a sample."""
        return max(10, 0.1 * sample)

    def say_that_it_collapses(self) -> None:
        """Say in the log, once, that collapses are too many."""
        self._say(
            f"outputs leave fewer than {_COLLAPSED} effective particles in more than a tenth "
            "of the samples; its covariances may be far too small, take more particles"
        )

    def _counted(self, memory: ParticleMemory, effective: np.ndarray) -> np.ndarray:
        """Return the number of collapses, given the effective number of particles that a sample
        would have left, (batch,) each."""
        collapses = memory.collapses + (effective < _COLLAPSED)
        if (collapses > self.most_collapses(memory.sample)).any():
            self.say_that_it_collapses()
        return collapses

    def _tempered(
        self, x: np.ndarray, log_weights: np.ndarray, sample: Sample, number: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the particles and the logarithms of their weights after the update with a sample,
        and the effective number of particles (batch,) that it would have left without tempering.

        Where the likelihood would leave too few effective particles, it is applied in several
        factors. Each is a power of the likelihood that leaves effectively half of the
        particles, and is followed by resampling.
        """
        remaining = np.ones(len(sample.y))
        log_likelihood = self._log_likelihood(x, sample)
        effective = left = _effective(log_weights + log_likelihood)
        for part_number in range(_ROUNDS):
            rows = np.flatnonzero(left < self.particles / _FEW)
            if not len(rows):
                break
            # Apply a power of the likelihood to these episodes, and resample them.
            old, likelihood = log_weights.take(rows, 1), log_likelihood.take(rows, 1)
            part = _power(old, likelihood, remaining[rows], self.particles)
            log_weights = log_weights.copy()
            log_weights[:, rows] = _normalised(old + part * likelihood)
            remaining[rows] -= part
            stream, seen = (number, part_number), sample.rows(rows)
            x, log_weights = self._resampled(x, log_weights, rows, stream, seen, tempering=True)
            log_likelihood[:, rows] = self._log_likelihood(x.take(rows, 1), seen)
            left = _effective(log_weights + remaining * log_likelihood)
        return x, _normalised(log_weights + remaining * log_likelihood), effective

    def _log_likelihood(self, x: np.ndarray, sample: Sample) -> np.ndarray:
        """Return the log likelihood of the outputs up to a constant, (num_particles, batch)."""
        t, y, u = sample.t, sample.y, sample.u
        errors = self.system.output_residual(y, outputs_at(self.system, t, x, u))
        errors = np.where(np.isnan(y), 0.0, errors)
        log_likelihood = -0.5 * _squared_sizes(errors, sample.R)
        box = self.system.state_box
        if box is not None:
            outside = box.outside(x)
            log_likelihood = np.where(outside, -np.inf, log_likelihood)
            if outside.all(axis=0).any():
                self._say("all particles are outside of the bounds; they stay where they are")
        if math.isfinite(log_likelihood.sum()):
            return log_likelihood
        log_likelihood = np.where(np.isfinite(log_likelihood), log_likelihood, _ZERO)
        impossible = log_likelihood.max(axis=0) <= _ZERO
        if (impossible if box is None else impossible & ~box.outside(x).all(axis=0)).any():
            self._say("an output is not defined, or impossible, at all particles; it is left out")
        return np.where(impossible, 0.0, log_likelihood)

    def _resampled(
        self,
        x: np.ndarray,
        log_weights: np.ndarray,
        rows: np.ndarray,
        stream: tuple[int, int],
        sample: Sample,
        *,
        tempering: bool,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Resample the particles of the given episodes to equal weights, with their mean and
        covariance preserved in expectation. The stream identifies the random numbers of this
        resampling."""
        rng = generator(self.seed, 1, *stream)
        # `take` keeps the order in memory, on which that of sums depends; indexing changes it.
        old, weights, count = x.take(rows, 1), np.exp(log_weights.take(rows, 1)), self.particles
        old = gathered(old, self.system.state_period, weights)
        mean, P = moments(weights, old)
        # Systematic resampling: the number of copies of each particle.
        ends = np.clip(np.ceil(np.cumsum(weights, axis=0) * count - rng.random()), 0, count)
        ends[-1] = count
        copies = np.diff(ends, axis=0, prepend=0).astype(int)
        ancestors = np.repeat(np.tile(np.arange(count), len(rows)), copies.T.ravel())
        drawn = np.take_along_axis(old, ancestors.reshape(len(rows), count).T[..., None], axis=0)
        x, log_weights = x.copy(), log_weights.copy()
        log_weights[:, rows] = -np.log(count)
        x[:, rows] = drawn
        if self.discount is None:
            a = shrinkages(self.system, sample, mean, P, tempering=tempering)
        else:
            a = np.full(len(rows), self.shrinkage(tempering))
        wide = np.flatnonzero(a < 1)
        if not len(wide):
            return x, log_weights
        # Shrink the copies towards the mean, and restore the covariance by Gaussian noise.
        L, _ = factor(P[wide].transpose(1, 2, 0), np.zeros(len(wide)))
        L = np.sqrt(1 - a[wide] ** 2) * L
        noise = spread(L, rng.standard_normal((count, x.shape[-1])))
        a = a[wide, None]
        x[:, rows[wide]] = a * drawn[:, wide] + (1 - a) * mean[wide] + noise
        return x, log_weights


def _squared_sizes(errors: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Return eᵀR⁻¹e, (number, batch), of errors e (number, batch, ny) with the covariance R (ny,
    ny, batch or 1)."""
    L, sizes, whitened = cholesky(R), np.zeros(errors.shape[:2]), []
    for p in range(len(R)):  # forward substitution
        rest = errors[..., p] - sum((L[p, q] * each for q, each in enumerate(whitened)), 0.0)
        whitened.append(rest / L[p, p])
        sizes += whitened[-1] ** 2
    return sizes


def _predicted_output(weights: np.ndarray, outputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the means (batch, ny) and covariances (batch, ny, ny) of the outputs (number, batch,
    ny) over the particles at which they are defined; NaN and zero if there are none."""
    if math.isfinite(outputs.sum()):
        return moments(weights, outputs)
    defined: np.ndarray = np.all(abs(outputs) < _LARGEST, axis=-1)
    weights = np.where(defined, weights, 0.0)
    # Rows in which all are defined do not depend on the others.
    sums = np.where(defined.all(axis=0), 1.0, total(weights))
    mean, S = moments(
        weights / np.where(sums > 0, sums, 1.0), np.where(defined[..., None], outputs, 0.0)
    )
    return np.where(sums[:, None] > 0, mean, np.nan), S


def _normalised(log_weights: np.ndarray) -> np.ndarray:
    """Return the logarithms of the weights, normalised so that the weights sum to one."""
    log_weights = log_weights - log_weights.max(axis=0)
    return log_weights - np.log(total(np.exp(log_weights)))


def _effective(log_weights: np.ndarray) -> np.ndarray:
    """Return the effective number of particles, (Σw)²/Σw², shape (batch,)."""
    weights = np.exp(log_weights - log_weights.max(axis=0))
    return total(weights) ** 2 / total(weights**2)


def _power(
    log_weights: np.ndarray, log_likelihood: np.ndarray, remaining: np.ndarray, count: int
) -> np.ndarray:
    """Return the power of the likelihood, at most ``remaining``, that leaves effectively half
    of the particles, shape (batch,). It is found by bisection."""
    low, high = np.zeros_like(remaining), remaining
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        enough = _effective(log_weights + middle * log_likelihood) > count / 2
        low, high = np.where(enough, middle, low), np.where(enough, high, middle)
    return high
