"""The noise of a plant and of its outputs: one object that truth, estimators, trainers and
references read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self, TypeAlias, TypeVar

import numpy as np

from pinnobs_gym.simulation.matrices import outer, product
from pinnobs_gym.simulation.notices import say_once
from pinnobs_gym.simulation.values import LARGEST, real_array, shortly

if TYPE_CHECKING:
    from pinnobs_gym.simulation.system import System

T = TypeVar("T")

Level: TypeAlias = Sequence[Sequence[float]] | Sequence[float] | float
"""Noise of several components: a standard deviation for all, one for each, or the rows of a matrix
M of the noise Mw with w of independent components of unit variance."""

NOISE_FLOOR = 1e-3
"""Standard deviation that filters assume for outputs without noise, relative to their scale."""


def noise_root(level: Level, size: int | None, name: str, plant: str = "") -> np.ndarray:
    """Return the matrix M (size, m) of the noise Mw, where w has independent components of unit
    variance; m is ``size`` unless a matrix is given. If ``size`` is None, any size is right.
    Messages give the name of the level and, if there is one, of the plant.

    Raises:
        ValueError: in one line, if the level is not of the right size, or not of finite numbers,
            standard deviations at least 0.
    """
    of = f" of {plant}" if plant else ""
    try:
        given = real_array(name, level)
    except ValueError:
        given = np.array(np.nan)
    if given.ndim < 2 and not (np.isfinite(given).all() and (given >= 0).all()):
        raise ValueError(f"{name}={shortly(level)}{of}; expected numbers of at least 0")
    if not np.isfinite(given).all():
        raise ValueError(f"{name}={shortly(level)}{of}; expected a matrix of finite numbers")
    if abs(given).max(initial=0.0) > LARGEST:
        raise ValueError(f"{name}={shortly(level)}{of}; expected at most {LARGEST:g}")
    rows = (given.shape or (1,))[0] if size is None else size
    if given.ndim > 2 or (given.ndim and len(given) != rows):
        raise ValueError(
            f"{name}{of} has shape {given.shape}; expected {rows} number(s), or a matrix of "
            f"{rows} row(s)"
        )
    return given if given.ndim == 2 else np.diag(np.broadcast_to(given, rows))


def noise_std(level: Level, size: int, name: str) -> np.ndarray:
    """Return the standard deviation of each component, (size,), of a noise; see `noise_root`."""
    M = noise_root(level, size, name)
    return np.sqrt((M * M).sum(axis=1))


def weighted(M: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Return Mw (..., size) for M (size, m) and w (..., m). The terms of a row are added in the
    same order in batches of any size."""
    if M.shape[0] == M.shape[1] and not M[~np.eye(len(M), dtype=bool)].any():
        scaled = np.empty(w.shape)
        for j, scale in enumerate(np.diagonal(M)):  # long loops, whatever the order in memory
            np.multiply(w[..., j], scale, out=scaled[..., j])
        return scaled
    total = np.zeros((*w.shape[:-1], len(M)))
    for j, column in enumerate(M.T):
        total += w[..., j, None] * column
    return total


def _correlated(R: np.ndarray) -> bool:
    """Return whether R (ny, ny, batch or 1) has an entry beside the diagonal."""
    return bool(R[~np.eye(len(R), dtype=bool)].any())


@dataclass(frozen=True, eq=False)
class Root:
    """L of the process noise at a time, with what is made of it, computed once."""

    L: np.ndarray
    """Shape (nx, m, batch or 1)."""

    @cached_property
    def density(self) -> np.ndarray:
        """LLᵀ, shape (nx, nx, batch or 1)."""
        return outer(self.L, self.L)

    @cached_property
    def _scales(self) -> np.ndarray | None:
        """The diagonal of L, (nx, batch or 1), None if L is not diagonal."""
        L = self.L
        if L.shape[0] != L.shape[1]:
            return None
        scales = np.einsum("iib->ib", L)
        return scales if np.count_nonzero(L) == np.count_nonzero(scales) else None

    @cached_property
    def _rows(self) -> np.ndarray:
        return self.L[..., 0].T

    def mapped(self, M: np.ndarray) -> np.ndarray:
        """Return ML, (n, m, batch), for matrices M (n, nx, batch)."""
        scales = self._scales  # a diagonal L takes no matrix product
        return product(M, self.L) if scales is None else M * scales

    def times(self, w: np.ndarray) -> np.ndarray:
        """Return Lw (..., nx) for w (..., m), with L the same in all rows."""
        scales = self._scales
        return w @ self._rows if scales is None else w * scales[:, 0]


@dataclass(frozen=True)
class SampledLevel:
    """Output noise that differs from sample to sample, as a log may tell it."""

    t: np.ndarray
    """Times of the samples in s, ascending, shape (num_samples,)."""
    std: np.ndarray
    """Standard deviations in output units, shape (batch, num_samples, ny); NaN where that of the
    other samples holds."""
    base: Level | None = None
    """The noise of the other samples; that of the setup ``benchmark`` if None."""

    def at(self, t: float) -> np.ndarray | None:
        """Return the standard deviations (batch, ny) at a time, None if it is that of no sample."""
        k = int(np.searchsorted(self.t, t))
        return self.std[:, k] if k < len(self.t) and self.t[k] == t else None

    def rows(self, rows: np.ndarray | slice) -> SampledLevel:
        """Return the noise of some rows of the batch."""
        return SampledLevel(self.t, self.std[rows], self.base)


@dataclass(frozen=True, eq=False)
class Noise:
    """The noise in dx = f dt + L(t) dw and y = h + G(t) v, where w is a Wiener process with
    independent components, and v is standard normal.

    A subclass that `System.noise` returns may make L or G depend on time; it overrides these
    methods, and everything else follows from them. A method that returns the same array at all
    times should return the same object, for which derived arrays are kept.
    """

    process: np.ndarray
    """L, shape (nx, m), in state units per √s; for a map, per step."""
    output: np.ndarray
    """G, shape (ny, m), in output units."""
    samples: SampledLevel | None = None
    """Standard deviations of the output noise by sample, if they are known; they scale the rows of
    G, so that correlations stay."""

    @cached_property
    def _L(self) -> np.ndarray:
        used = abs(self.process).any(axis=0)
        return self.process[:, used, None]

    @cached_property
    def _G(self) -> np.ndarray:
        return self.output[..., None]

    def L(self, t: float | np.ndarray) -> np.ndarray:
        """Return L at time t (s), a number or one for each row (batch,): shape (nx, m, batch or 1).
        Without process noise, m is zero."""
        return self._L

    def root(self, t: float | np.ndarray) -> Root:
        """Return L at time t (s) with what is made of it; the same object as before if L is."""
        if (fixed := self._fixed) is not None:
            return fixed
        return self._derived("root", self.L(t), Root)

    @cached_property
    def _fixed(self) -> Root | None:
        return Root(self.L(0.0)) if self.constant else None

    @cached_property
    def constant(self) -> bool:
        """Whether L is the same at all times."""
        return type(self).L is Noise.L

    def G(self, t: float) -> np.ndarray:
        """Return G at time t (s), shape (ny, m, batch or 1)."""
        std = None if self.samples is None else self.samples.at(t)
        if std is None:
            return self._G
        common = np.sqrt((self._G**2).sum(axis=1))
        std = np.where(np.isnan(std.T), common, std.T)
        # Rows of G are scaled, which keeps correlations; those of outputs without noise have none.
        silent = common == 0
        scaled = self._G * (std / np.where(silent, 1.0, common))[:, None]
        own = np.eye(len(std))[..., None] * np.where(silent, std, 0.0)
        return np.concatenate([scaled, own], axis=1) if silent.any() else scaled

    def R(self, t: float, y: np.ndarray | None = None) -> np.ndarray:
        """Return the covariance R = GGᵀ of the output noise at time t (s), shape (ny, ny, batch or
        1). Given outputs y (batch, ny), their covariances with missing ones, which are NaN, are
        zero, so that these do not count in an update."""
        R = self._derived("R", self.G(t), lambda G: outer(G, G))
        if y is None or len(R) == 1 or not self._derived("correlated", R, _correlated):
            return R
        if not np.isnan(y).any():
            return R
        present = ~np.isnan(y.T)
        kept = (present[:, None] & present) | np.eye(len(R), dtype=bool)[..., None]
        return np.where(kept, R, 0.0)

    def _derived(self, name: str, source: np.ndarray, make: Callable[[np.ndarray], T]) -> T:
        """Return what is made of an array, from memory if it is the same object as before."""
        kept = self._memory
        before = kept.get(name)
        if before is None or before[0] is not source:
            before = kept[name] = source, make(source)
        return before[1]

    @cached_property
    def _memory(self) -> dict[str, tuple[np.ndarray, Any]]:
        return {}

    def outputs(self, t: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the noise Gv (num_samples, batch, ny) of outputs at times t (num_samples,) in s,
        given standard normal numbers v (num_samples, batch, m)."""
        if type(self).G is Noise.G and self.samples is None:
            return weighted(self._G[..., 0], v)
        G = [self.G(float(now))[..., 0] for now in t]
        return np.stack([weighted(M, each) for M, each in zip(G, v, strict=True)])

    def and_process(self, L: np.ndarray) -> Noise:
        """Return the noise with a further, independent process noise, L of shape (nx, m)."""
        own = self.process, self.output, self.samples
        return _Sum(*own, own=self, further=L[..., None])

    def rows(self, rows: np.ndarray | slice) -> Self:
        """Return the noise of some rows of the batch, which differ only in noise by sample."""
        return self if self.samples is None else replace(self, samples=self.samples.rows(rows))

    @property
    def stochastic(self) -> bool:
        """Whether the plant has process noise."""
        return self.L(0.0).shape[1] > 0


@dataclass(frozen=True, eq=False, kw_only=True)
class _Sum(Noise):
    """The noise of a plant and further process noise."""

    own: Noise
    further: np.ndarray
    """Its L, shape (nx, m, 1)."""

    @cached_property
    def constant(self) -> bool:
        return self.own.constant

    def L(self, t: float | np.ndarray) -> np.ndarray:
        return self._derived("L", self.own.L(t), self._both)

    def _both(self, L: np.ndarray) -> np.ndarray:
        further = np.broadcast_to(self.further, (*self.further.shape[:2], L.shape[2]))
        return np.concatenate([L, further], axis=1)

    def G(self, t: float) -> np.ndarray:
        return self.own.G(t)

    def rows(self, rows: np.ndarray | slice) -> Self:
        if self.samples is None:
            return self
        return replace(super().rows(rows), own=self.own.rows(rows))

    def outputs(self, t: np.ndarray, v: np.ndarray) -> np.ndarray:
        return self.own.outputs(t, v)


@dataclass(frozen=True, eq=False, kw_only=True)
class AssumedNoise(Noise):
    """The noise that a filter assumes: more process noise than it is told, and output noise even
    where there is none, because filters need a positive definite R."""

    told: Noise
    """The noise of the model."""
    extra: np.ndarray
    """Standard deviation (nx,) of the additional process noise of each state, in state units per
    √s."""
    floor: np.ndarray
    """Standard deviation (ny,) of the noise of outputs without noise, in output units."""

    @staticmethod
    def of(system: System, told: Noise, share: float = 0.0) -> AssumedNoise:
        """Return the noise with `NOISE_FLOOR` of their scale for outputs that have none, which the
        log says once, and with additional process noise.

        Args:
            system: the model.
            told: the noise of the model.
            share: standard deviation, over each state's scale, of the additional process noise over
                the benchmark's duration.
        """
        from pinnobs_gym.simulation.system import output_scale, vector

        duration = system.setups["benchmark"].duration
        extra = share / np.sqrt(duration) * vector(system.scale, system.nx, "scale")
        without: np.ndarray = np.logical_not(told.G(0.0).any(axis=(1, 2)))
        floor = np.zeros(system.ny)
        if without.any() or told.samples is not None:
            floor = NOISE_FLOOR * output_scale(system)
        if without.any():
            names = zip(system.output_names, floor, without, strict=True)
            parts = ", ".join(f"{name}: {value:g}" for name, value, raised in names if raised)
            say_once(
                f"{type(system).__name__}: the output noise is zero; filters assume the standard "
                f"deviations {parts}"
            )
        own = told.process, told.output, told.samples
        return AssumedNoise(*own, told=told, extra=extra, floor=floor)

    @cached_property
    def constant(self) -> bool:
        return self.told.constant

    def L(self, t: float | np.ndarray) -> np.ndarray:
        return self._derived("L", self.told.L(t), self._enlarged)

    def _enlarged(self, L: np.ndarray) -> np.ndarray:
        """Return the root of LLᵀ + diag(extra²), with the least number of columns."""
        used = self.extra > 0
        if not used.any():
            return L
        if L.shape[1] == 0:
            return np.diag(self.extra)[:, used, None]
        density = outer(L, L)
        if L.shape[2] == 1 and not density[~np.eye(len(L), dtype=bool)].any():
            std = np.sqrt(np.einsum("iib->i", density) + self.extra**2)
            return np.diag(std)[:, std > 0, None]
        extra = np.diag(self.extra)[:, used, None]
        extra = np.broadcast_to(extra, (*extra.shape[:2], L.shape[2]))
        return np.concatenate([L, extra], axis=1)

    def G(self, t: float) -> np.ndarray:
        return self._derived("G", self.told.G(t), self._raised)

    def rows(self, rows: np.ndarray | slice) -> Self:
        if self.samples is None:
            return self
        return replace(super().rows(rows), told=self.told.rows(rows))

    def _raised(self, G: np.ndarray) -> np.ndarray:
        """Return G with the floor in rows that are zero."""
        zero = ~G.any(axis=1)
        if not zero.any():
            return G
        floor = np.eye(len(G))[..., None] * np.where(zero, self.floor[:, None], 0.0)
        return np.concatenate([G, floor], axis=1)
