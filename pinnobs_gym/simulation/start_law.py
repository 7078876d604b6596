"""Laws of the initial state of a setup's episodes: uniform in a box, Gaussian, or one of several
states."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pinnobs_gym.simulation.values import finite_array, real_array, shortly

_INSIDE = 0.95
"""Probability of the ellipsoid that counts as the set of a Gaussian law."""
_DEVIATIONS = 3.0
"""Half sides of the box about a Gaussian law, in standard deviations."""


class StartLaw(ABC):
    """A law of initial states. `System.admissible` restricts it further: states that it does not
    accept are drawn again."""

    @property
    @abstractmethod
    def mean(self) -> np.ndarray:
        """Mean, shape (nx,), in state units."""

    @property
    @abstractmethod
    def cov(self) -> np.ndarray:
        """Covariance, shape (nx, nx), in products of state units."""

    @abstractmethod
    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draw states (count, nx)."""

    @abstractmethod
    def contains(self, x: np.ndarray) -> np.ndarray:
        """Return which states (..., nx) belong to the set of this law: bool (...)."""

    @abstractmethod
    def log_density(self, x: np.ndarray) -> np.ndarray:
        """Return the logarithm of the density at states (..., nx) up to a constant, (...).

        Raises:
            ValueError: in one line, if the law has no density.
        """

    @property
    @abstractmethod
    def corners(self) -> tuple[np.ndarray, np.ndarray]:
        """The lower and the upper corner (nx,) of a box about the states, in state units."""

    @property
    @abstractmethod
    def sentence(self) -> str:
        """The law in a few words."""

    @property
    def fixed(self) -> bool:
        """Whether the law has a single state."""
        return not self.cov.any()


@dataclass(frozen=True)
class Box(StartLaw):
    """States uniform in a box; where a side is zero, its component is known."""

    low: Sequence[float]
    """Lower corner, in state units."""
    high: Sequence[float]
    """Upper corner, in state units."""

    def __post_init__(self) -> None:
        for name, corner in (("x0_low", self.low), ("x0_high", self.high)):
            _check_state(name, corner)
        if len(self.low) != len(self.high):
            raise ValueError(
                f"x0_low has {len(self.low)} number(s), x0_high {len(self.high)}; expected as many"
            )
        if (np.asarray(self.low) > np.asarray(self.high)).any():
            raise ValueError(f"x0_low={self.low} is above x0_high={self.high}")

    @property
    def mean(self) -> np.ndarray:
        low, high = self.corners
        return (low + high) / 2

    @property
    def cov(self) -> np.ndarray:
        low, high = self.corners
        return np.diag((high - low) ** 2 / 12)

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        low, high = self.corners
        return rng.uniform(low, high, (count, len(low)))

    def contains(self, x: np.ndarray) -> np.ndarray:
        low, high = self.corners
        return np.asarray(((x >= low) & (x <= high)).all(axis=-1))

    def log_density(self, x: np.ndarray) -> np.ndarray:
        return np.where(self.contains(x), 0.0, -np.inf)

    @property
    def corners(self) -> tuple[np.ndarray, np.ndarray]:
        return np.array(self.low, dtype=float), np.array(self.high, dtype=float)

    @property
    def sentence(self) -> str:
        low, high = map(_rounded, self.corners)
        return f"x₀ = {low}" if self.fixed else f"x₀ uniform in {low} to {high}"

    @property
    def fixed(self) -> bool:
        low, high = self.corners
        return bool((low == high).all())


@dataclass(frozen=True)
class Gaussian(StartLaw):
    """Gaussian states N(x̂₀, P₀).

    Where `System.admissible` restricts the states, the prior that estimators are given has the mean
    and the covariance of those that are left (`pinnobs_gym.simulation.initial_set.prior_moments`).
    Its set is the ellipsoid that holds 95 % of the states; the box about it
    extends three standard deviations to each side.
    """

    x0_mean: Sequence[float]
    """Mean, in state units."""
    x0_cov: Sequence[Sequence[float]]
    """Covariance, nx rows of nx numbers, in products of state units; see also `independent`. It may
    be singular."""

    def __post_init__(self) -> None:
        _check_state("x0_mean", self.x0_mean)
        check_covariance(self.x0_cov, "x0_cov")
        if len(self.x0_cov) != len(self.x0_mean):
            raise ValueError(
                f"x0_mean has {len(self.x0_mean)} number(s), x0_cov {len(self.x0_cov)} rows; "
                "expected as many"
            )

    @property
    def mean(self) -> np.ndarray:
        return np.array(self.x0_mean, dtype=float)

    @property
    def cov(self) -> np.ndarray:
        return np.array(self.x0_cov, dtype=float)

    @cached_property
    def _root(self) -> np.ndarray:
        """The lower triangular L, (nx, nx), with LLᵀ the covariance."""
        from pinnobs_gym.simulation.matrices import cholesky

        return cholesky(self.cov[..., None], semidefinite=True)[..., 0]

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        x0 = np.tile(self.mean, (count, 1))
        draws = rng.standard_normal(x0.shape)
        # The terms are added in the same order for any count.
        for column, each in zip(self._root.T, draws.T, strict=True):
            x0 += each[:, None] * column
        return x0

    @cached_property
    def _axes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The axes (nx, nx) of the covariance, as columns, the variances along them (nx,), and
        which of them are zero but for rounding, bool (nx,)."""
        variances, axes = np.linalg.eigh(self.cov)
        return axes, variances, variances <= 1e-14 * len(variances) * variances.max(initial=0.0)

    def _squares(self, x: np.ndarray) -> np.ndarray:
        """Return (x − x̂₀)ᵀP₀⁻¹(x − x̂₀), (...), infinite off the subspace of a singular P₀."""
        axes, variances, zero = self._axes
        along = (x - self.mean) @ axes
        off = abs(along) > 1e-7 * np.sqrt(variances.max(initial=0.0))
        squares = along**2 / np.where(zero, 1.0, variances)
        return np.where(zero, np.where(off, np.inf, 0.0), squares).sum(axis=-1)

    def contains(self, x: np.ndarray) -> np.ndarray:
        from scipy.special import gammaincinv  # takes long to import

        freedom = int((~self._axes[2]).sum())
        limit = 2 * gammaincinv(freedom / 2, _INSIDE) if freedom else 0.0
        return np.asarray(self._squares(x) <= limit)

    def log_density(self, x: np.ndarray) -> np.ndarray:
        return -0.5 * self._squares(x)

    @property
    def corners(self) -> tuple[np.ndarray, np.ndarray]:
        reach = _DEVIATIONS * np.sqrt(np.diag(self.cov))
        return self.mean - reach, self.mean + reach

    @property
    def sentence(self) -> str:
        if self.fixed:
            return f"x₀ = {_rounded(self.mean)}"
        mean, cov = _rounded(self.mean), [_rounded(row) for row in self.cov]
        return f"x₀ Gaussian with mean {mean} and covariance {cov}"


@dataclass(frozen=True)
class Points(StartLaw):
    """States drawn with equal chance from a list, of which the admissible ones are taken."""

    states: Sequence[Sequence[float]]
    """The states, nx numbers each, in state units."""

    def __post_init__(self) -> None:
        try:
            states = finite_array("states", self.states)
            known = states.ndim == 2 and states.size > 0
        except ValueError:
            known = False
        if not known:
            raise ValueError(
                f"states={shortly(self.states)}; expected rows of one finite number per state"
            )

    @cached_property
    def _states(self) -> np.ndarray:
        return np.array(self.states, dtype=float)

    @property
    def mean(self) -> np.ndarray:
        return self._states.mean(axis=0)

    @property
    def cov(self) -> np.ndarray:
        deviations = self._states - self.mean
        return np.einsum("ni,nj->ij", deviations, deviations) / len(deviations)

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        return self._states[rng.integers(len(self._states), size=count)]

    def contains(self, x: np.ndarray) -> np.ndarray:
        return (np.asarray(x)[..., None, :] == self._states).all(axis=-1).any(axis=-1)

    def log_density(self, x: np.ndarray) -> np.ndarray:
        raise ValueError(
            f"the law of initial states is a list of {len(self.states)} states and has no density"
        )

    @property
    def corners(self) -> tuple[np.ndarray, np.ndarray]:
        return self._states.min(axis=0), self._states.max(axis=0)

    @property
    def sentence(self) -> str:
        if self.fixed:
            return f"x₀ = {_rounded(self._states[0])}"
        return f"x₀ drawn with equal chance from {[_rounded(state) for state in self._states]}"

    @property
    def fixed(self) -> bool:
        return bool((self._states == self._states[0]).all())


@dataclass(frozen=True)
class Joint(StartLaw):
    """The law of states of which two parts are independent."""

    first: StartLaw
    """The law of the first components."""
    second: StartLaw
    """The law of the other components."""

    @property
    def mean(self) -> np.ndarray:
        return np.concatenate([self.first.mean, self.second.mean])

    @property
    def cov(self) -> np.ndarray:
        size = len(self.first.mean)
        cov = np.zeros((len(self.mean), len(self.mean)))
        cov[:size, :size], cov[size:, size:] = self.first.cov, self.second.cov
        return cov

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        return np.concatenate([law.draw(rng, count) for law in (self.first, self.second)], axis=1)

    def _parts(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        size = len(self.first.mean)
        return x[..., :size], x[..., size:]

    def contains(self, x: np.ndarray) -> np.ndarray:
        first, second = self._parts(x)
        return self.first.contains(first) & self.second.contains(second)

    def log_density(self, x: np.ndarray) -> np.ndarray:
        first, second = self._parts(x)
        return self.first.log_density(first) + self.second.log_density(second)

    @property
    def corners(self) -> tuple[np.ndarray, np.ndarray]:
        low, high = zip(self.first.corners, self.second.corners, strict=True)
        return np.concatenate(low), np.concatenate(high)

    @property
    def sentence(self) -> str:
        return f"{self.first.sentence}; the further components: {self.second.sentence}"

    @property
    def fixed(self) -> bool:
        return self.first.fixed and self.second.fixed


def _check_state(name: str, values: Sequence[float]) -> None:
    """Raise ValueError, in one line, unless a value is several finite numbers."""
    try:
        known = finite_array(name, values).ndim == 1
    except ValueError:
        known = False
    if not known:
        raise ValueError(f"{name}={shortly(values)}; expected one finite number per state")


def check_covariance(rows: Sequence[Sequence[float]], name: str) -> None:
    """Raise ValueError, in one line, unless the rows are those of a covariance; zero variances are
    allowed."""
    try:
        P = real_array(name, rows)
    except ValueError:
        raise ValueError(
            f"{name}={shortly(rows)}; expected a covariance, rows of numbers"
        ) from None
    if P.ndim != 2 or P.shape[0] != P.shape[1]:
        raise ValueError(f"{name}={rows}; expected a covariance, as many rows as columns")
    size = abs(P).max(initial=0.0)
    if not np.isfinite(P).all() or (abs(P - P.T) > 1e-9 * size).any():
        raise ValueError(f"{name}={rows}; expected a covariance, symmetric and finite")
    if (np.linalg.eigvalsh(P) < -1e-9 * size).any():
        raise ValueError(f"{name}={rows}; expected a covariance, without eigenvalues below 0")


def _rounded(values: np.ndarray) -> list[float]:
    """Return numbers (n,) with six digits, for a sentence."""
    return [float(f"{value:.6g}") for value in values]
