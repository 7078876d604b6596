"""The equations of a system with unknown constants as further states."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, TypeAlias

import numpy as np

from pinnobs_gym.simulation.arrays import array_namespace
from pinnobs_gym.simulation.derivatives import central_differences
from pinnobs_gym.simulation.residual import Periods
from pinnobs_gym.simulation.system import Array, System, stack
from pinnobs_gym.simulation.values import is_number


@dataclass(frozen=True)
class Unknown:
    """A constant of which only a mean and a standard deviation are known."""

    mean: float
    """Mean, in the unit of the constant."""
    std: float
    """Standard deviation, above 0."""
    low: float | None = None
    """Value below which the constant cannot be; None for no bound."""
    high: float | None = None
    """Value above which the constant cannot be; None for no bound."""

    def __post_init__(self) -> None:
        for name, value in (("mean", self.mean), ("std", self.std)):
            if not (is_number(value) and np.isfinite(value)) or (name == "std" and value <= 0):
                expected = "a number" if name == "mean" else "a number above 0"
                raise ValueError(f"{name}={value!r} of an Unknown; expected {expected}")
        for name, bound, sign in (("low", self.low, -1), ("high", self.high, 1)):
            if bound is not None and not (is_number(bound) and sign * (bound - self.mean) > 0):
                side = "below" if sign < 0 else "above"
                raise ValueError(
                    f"{name}={bound!r} of an Unknown; expected a number {side} mean={self.mean:g}"
                )


Constants: TypeAlias = tuple[tuple[str, Unknown], ...]
"""Unknown constants with the name of the parameter, output or state that each belongs to."""
_PARAMETER, _BIAS, _DISTURBANCE, _RATE = range(4)
"""Kinds of constants, in their order in the state."""


@dataclass(frozen=True)
class Augmented(System):
    """The base class of what `augmented` returns. The fields of its subclasses are the parameters
    that remain known."""

    plant: System = field(kw_only=True)
    """The system without further states."""

    constants: ClassVar[tuple[Constants, Constants, Constants, Constants]]
    """The constants of each kind, in the order of their columns."""

    def _parts(self, x: Array) -> tuple[System, Array]:
        """Return the plant with the parameters of x (..., nx), and its state."""
        own, n = {name: getattr(self, name) for name in self.parameters}, self.plant.nx
        names = (name for name, _ in self.constants[_PARAMETER])
        unknown = {name: x[..., n + i] for i, name in enumerate(names)}
        return replace(self.plant, **own, **unknown), x[..., :n]

    @property
    def _known(self) -> System:
        """The plant at the mean of the unknown parameters."""
        return replace(self.plant, **{name: getattr(self, name) for name in self.parameters})

    @property
    def _other_rates(self) -> bool:
        """Whether a constant acts on the plant's rates of change."""
        return bool(self.constants[_DISTURBANCE] or self.constants[_RATE])

    def _columns(self, kind: int, names: tuple[str, ...]) -> dict[int, int]:
        """Return the column in the state of each constant of a kind other than `_PARAMETER`, by the
        number of the output or state that it acts on."""
        first = self.plant.nx + sum(map(len, self.constants[:kind]))
        return {names.index(name): first + i for i, (name, _) in enumerate(self.constants[kind])}

    def _plus(self, y: Array, x: Array, columns: dict[int, int]) -> Array:
        """Return y (..., m) with the constants of these columns of x (..., nx) added."""
        return y + _spread(x, columns, y.shape[-1]) if columns else y

    def f(self, t: Array, x: Array, u: Array) -> Array:
        plant, state = self._parts(x)
        own = plant.f(t, state, u)
        columns = self._columns(_RATE, plant.state_names)
        if columns:
            change = own - state if self.discrete else own
            own = own + _spread(x, columns, plant.nx) * change
        own = self._plus(own, x, self._columns(_DISTURBANCE, plant.state_names))
        return _followed(own, x) if self.discrete else _joined(x, own, 0.0)

    def flow(self, t0: Array, t1: Array, x: Array, u: Array) -> Array:
        """Return the states (..., nx) at t1 in s by the plant's own flow from x at t0, with the
        constants as they are."""
        plant, state = self._parts(x)
        return _followed(plant.flow(t0, t1, state, u), x)

    def h(self, t: Array, x: Array, u: Array) -> Array:
        plant, state = self._parts(x)
        return self._plus(plant.h(t, state, u), x, self._columns(_BIAS, plant.output_names))

    def input(self, t: Array) -> Array:
        return self._known.input(t)

    def draw_input(self, rng: np.random.Generator, times: np.ndarray) -> np.ndarray:
        return self._known.draw_input(rng, times)

    def f_jacobian(self, t: Array, x: Array, u: Array) -> Array:
        """Return ∂f/∂x, (..., nx, nx), from the plant's own Jacobian and, by
        parameters that are states, central differences."""
        if not isinstance(x, np.ndarray):
            return super().f_jacobian(t, x, u)
        plant, state = self._parts(x)
        above = self._jacobian(self.f, None, plant.f_jacobian(t, state, u), t, x, u)
        _set_ones(above, self._columns(_DISTURBANCE, plant.state_names))
        columns = self._columns(_RATE, plant.state_names)
        if columns:
            rate = plant.f(t, state, u)
            change = rate - state if self.discrete else rate
            for row, column in columns.items():
                r = x[..., column]
                # Differences by the parameters are of the whole rate, with its factor.
                above[..., row, : plant.nx] *= 1.0 + r[..., None]
                if self.discrete:  # (1 + r)A - rI
                    above[..., row, row] -= r
                above[..., row, column] = change[..., row]
        F = np.zeros_like(above, shape=(*x.shape, self.nx))
        F[..., : plant.nx, :] = above
        if self.discrete:  # the constants of a map remain what they are
            for i in range(plant.nx, self.nx):
                F[..., i, i] = 1.0
        return F

    def h_jacobian(self, t: Array, x: Array, u: Array) -> Array:
        """Return ∂h/∂x, (..., ny, nx), from the plant's own Jacobian and, by
        parameters that are states, central differences."""
        if not isinstance(x, np.ndarray):
            return super().h_jacobian(t, x, u)
        plant, state = self._parts(x)
        own = plant.h_jacobian(t, state, u)
        H = self._jacobian(self.h, self.output_period, own, t, x, u)
        _set_ones(H, self._columns(_BIAS, plant.output_names))
        return H

    def _jacobian(
        self,
        function: Callable[[Array, np.ndarray, Array], Any],
        periods: Periods | None,
        own: Array,
        t: Array,
        x: np.ndarray,
        u: Array,
    ) -> np.ndarray:
        """Return the derivatives of the plant's rates or outputs, (..., m, nx): its own Jacobian
        (..., m, n), central differences by each parameter, and zero by the other constants.

        For the error of the differences see `central_differences`.
        """
        size, n = np.shape(own)[-2], self.plant.nx
        result = np.zeros_like(own, shape=(*x.shape[:-1], size, self.nx))
        result[..., :n] = own
        columns = range(n, n + len(self.constants[_PARAMETER]))
        if columns:
            slopes = central_differences(
                lambda x: function(t, x, u)[..., :size], x, self.scale, columns, periods
            )
            result[..., columns] = slopes
        return result

    def admissible(self, x0: Array) -> Array:
        plant, state = self._parts(x0)
        return plant.admissible(state)

    def distances(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the distances of the plant; constants are at distance 0 from every output."""
        own = self.plant.distances()
        if own is None:
            return None
        constants = np.zeros((self.nx - self.plant.nx, self.ny))
        return np.concatenate([np.asarray(own[0], dtype=float), constants]), own[1]

    def observable(self, x: Array) -> Array:
        """Return whether each component is observable, bool of the shape of x: the plant's as the
        plant says, and all constants."""
        plant, state = self._parts(x)
        return _joined(x, plant.observable(state), True)

    def invariants(self, x: Array) -> Array | None:
        """Return the invariants of the plant, if its rates are its own."""
        plant, state = self._parts(x)
        return None if self._other_rates else plant.invariants(state)

    def indistinguishable(self, x: Array) -> tuple[Array, ...]:
        """Return the states that the plant's outputs do not tell from x, with the same constants,
        if its rates are its own."""
        if self._other_rates:
            return ()
        plant, state = self._parts(x)
        xp = array_namespace(x)
        same = x[..., plant.nx :]
        return tuple(xp.concat([other, same], axis=-1) for other in plant.indistinguishable(state))

    def breakpoints(self) -> tuple[float, ...]:
        return self._known.breakpoints()


def _joined(x: Array, first: Array, value: float | bool) -> Array:
    """Return the array (..., nx) of the columns ``first`` and one value in those that are left."""
    if isinstance(first, np.ndarray):
        out = np.empty_like(x, dtype=first.dtype)
        out[..., : first.shape[-1]], out[..., first.shape[-1] :] = first, value
        return out
    xp = array_namespace(first)
    rest = xp.full_like(x[..., first.shape[-1] :], value, dtype=first.dtype)
    return xp.concat([first, rest], axis=-1)


def _followed(first: Array, x: Array) -> Array:
    """Return the array (..., nx) of the columns ``first`` and, in those that are left, of x."""
    if isinstance(first, np.ndarray):
        out = np.array(np.broadcast_to(x, (*first.shape[:-1], x.shape[-1])), dtype=first.dtype)
        out[..., : first.shape[-1]] = first
        return out
    return array_namespace(first).concat([first, x[..., first.shape[-1] :]], axis=-1)


def _spread(x: Array, columns: dict[int, int], size: int) -> Array:
    """Return the array (..., size) of these columns of x at the numbers that they belong to, and of
    zeros."""
    return stack(x, *(x[..., columns[i]] if i in columns else 0.0 for i in range(size)))


def _set_ones(matrix: np.ndarray, columns: dict[int, int]) -> None:
    for row, column in columns.items():
        matrix[..., row, column] = 1.0
