"""The linear dynamics of a KKL observer: design of (A, B) and exact integration of z."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, TypeAlias

import numpy as np
from scipy.linalg import expm
from scipy.signal import besselap

Design: TypeAlias = Literal["bessel", "niazi", "poles", "learned"]
"""How the poles of z are chosen."""
Mode: TypeAlias = Literal["continuous", "discrete"]
"""Whether z follows a differential equation or a recursion from sample to sample."""
Start: TypeAlias = Literal["output", "zero", "prior"]
"""Initial value of z: the steady state for the constant output y₀, zero, or T(x̂₀)."""

_REACH = 1e-6
"""Smallest singular value in Hautus's test, over the eigenvalue, of a controllable mode."""


@dataclass(frozen=True, eq=False)
class Dynamics:
    """The system ż = Az + By; in discrete time its Euler step z⁺ = z + h(Az + By).

    Raises:
        ValueError: in one line, if A is not Hurwitz or (A, B) is not controllable.
    """

    A: np.ndarray
    """Shape (nz, nz), in 1/s."""
    B: np.ndarray
    """Shape (nz, ny), in 1/s per output unit; measured inputs count as further outputs."""
    mode: Mode = "continuous"

    def __post_init__(self) -> None:
        slowest = float(np.linalg.eigvals(self.A).real.max())
        if not slowest < 0:
            raise ValueError(
                f"A_z is not Hurwitz: it has an eigenvalue of real part {slowest:.4g}; expected "
                "all below 0"
            )
        lost = [value for value in np.linalg.eigvals(self.A) if self._loses(value)]
        if lost:
            raise ValueError(
                f"(A_z, B_z) is not controllable at the pole {lost[0]:.4g}: a pole that is "
                "repeated adds nothing to z"
            )

    def _loses(self, value: complex) -> bool:
        """Return whether the mode of an eigenvalue is uncontrollable (Hautus's test)."""
        size = abs(value)
        test = np.concatenate([value * np.eye(self.size) - self.A, self.B], axis=1) / size
        return float(np.linalg.svd(test, compute_uv=False)[-1]) < _REACH

    @property
    def size(self) -> int:
        """Number of components of z."""
        return len(self.A)

    @property
    def slowest(self) -> float:
        """Smallest abs Re λ of the eigenvalues λ of A, in 1/s."""
        return float(abs(np.linalg.eigvals(self.A).real).min())

    def step(self, h: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the matrices of a step of length h (s).

        In continuous time the step is exact for an output that is linear in between.

        Returns:
            Φ (nz, nz), Γ₀ and Γ₁ (nz, ny) of z(t + h) = Φz(t) + Γ₀y(t) + Γ₁y(t + h).

        Raises:
            ValueError: in one line, in discrete time, if I + hA is not Schur.
        """
        # Intervals that differ by the rounding of times share a step in the cache. To round to ten
        # significant digits at least leaves short intervals what they are.
        h = round(h, max(12, 10 - math.floor(math.log10(h))))
        return _step(self.A.tobytes(), self.B.tobytes(), self.size, self.mode, h)

    def filtered(
        self,
        t: np.ndarray,
        y: np.ndarray,
        z0: np.ndarray | float = 0.0,
        ends: np.ndarray | None = None,
    ) -> np.ndarray:
        """Integrate z from z0 at the first of the times t (s), driven by outputs y
        (num_samples, batch, ny); shape (num_samples, batch, nz). At the end of an interval they are
        those of ``ends``, of the same shape, if they jump at samples."""
        z = np.empty((*y.shape[:2], self.size))
        z[0] = z0
        ends = y if ends is None else ends
        for k, h in enumerate(np.diff(t)):
            flow, before, after = self.step(float(h))
            z[k + 1] = z[k] @ flow.T + y[k] @ before.T + ends[k + 1] @ after.T
        return z

    def flows(self, t: np.ndarray) -> np.ndarray:
        """Return Φ from the first of the times t (num_samples,) in s to each of them,
        (num_samples, nz, nz)."""
        nothing = np.zeros((len(t), self.size, self.B.shape[1]))
        return self.filtered(t, nothing, np.eye(self.size)).swapaxes(1, 2)


@lru_cache(maxsize=512)
def _step(
    A_bytes: bytes, B_bytes: bytes, size: int, mode: Mode, h: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the result of `Dynamics.step`; matrices are bytes, as cache keys have to be hashed."""
    A = np.frombuffer(A_bytes).reshape(size, size)
    B = np.frombuffer(B_bytes).reshape(size, -1)
    ny = B.shape[1]
    if mode == "discrete":
        flow = np.eye(size) + h * A
        largest = float(abs(np.linalg.eigvals(flow)).max())
        if not largest < 1:
            raise ValueError(
                f"A_z is not Schur in discrete time: I + {h:g} s·A_z has an eigenvalue of size "
                f"{largest:.4g}; expected all below 1"
            )
        return flow, h * B, np.zeros_like(B)
    # Matrix exponential that also integrates a constant input and a ramp (Van Loan 1978).
    block = np.zeros((size + 2 * ny,) * 2)
    block[:size, :size], block[:size, size : size + ny] = h * A, h * B
    block[size : size + ny, size + ny :] = np.eye(ny)
    whole = expm(block)
    held, ramp = whole[:size, size : size + ny], whole[:size, size + ny :]
    return whole[:size, :size], held - ramp, ramp


def realised(poles: Sequence[complex], ny: int, mode: Mode = "continuous") -> Dynamics:
    """Realise one filter with the given poles per output, in real modal form.

    The static gain of each mode has norm 1.

    Args:
        poles: poles in 1/s, complex ones in conjugate pairs.
        ny: number of outputs.
        mode: continuous or discrete time.

    Raises:
        ValueError: in one line, if the poles are not finite, not stable, not in conjugate pairs, or
            repeated.
    """
    values: Any = np.asarray(poles, dtype=complex)
    if not np.isfinite(values).all():
        raise ValueError(f"poles={list(poles)}; expected finite numbers")
    upper = np.sort_complex(values[values.imag > 0])
    lower = np.sort_complex(values[values.imag < 0].conj())
    if len(upper) != len(lower) or not np.allclose(upper, lower):
        raise ValueError(f"poles={list(poles)}; expected complex ones in conjugate pairs")
    blocks: list[tuple[np.ndarray, np.ndarray]] = []
    for pole in np.sort(values[values.imag == 0].real)[::-1]:  # a 1x1 block per real pole
        blocks.append((np.array([[pole]]), np.array([abs(pole)])))
    for pole in upper:  # a 2x2 block per conjugate pair
        a, b = pole.real, pole.imag
        turn = np.array([[a, b], [-b, a]])
        blocks.append((turn, np.array([abs(pole), 0.0])))
    # Block diagonal for one output, repeated for each output.
    size = len(values)
    A, B = np.zeros((size, size)), np.zeros((size, 1))
    row = 0
    for block, gain in blocks:
        part = slice(row, row + len(block))
        A[part, part], B[part, 0] = block, gain
        row += len(block)
    eye = np.eye(ny)
    return Dynamics(np.kron(eye, A), np.kron(eye, B), mode)


def bessel(order: int, cutoff: float) -> tuple[complex, ...]:
    """Return the poles of a Bessel filter with a cut-off in Hz (Ramos et al. 2020)."""
    _, poles, _ = besselap(order, norm="mag")
    return tuple(2 * np.pi * cutoff * np.asarray(poles))


def niazi(nx: int) -> tuple[complex, ...]:
    """Return the 2nx + 1 poles −1, −2, ... of Niazi et al. (2023)."""
    return tuple(complex(-k) for k in range(1, 2 * nx + 2))


def enough(order: int, nx: int, ny: int) -> None:
    """Check that filters of an order, one per output, suffice for nx states.

    Raises:
        ValueError: in one line, if z has fewer than nx + 1 components.
    """
    if order * ny < nx + 1:
        raise ValueError(
            f"n_z={order * ny} ({order} for each of {ny} outputs); expected at least nx + 1 = "
            f"{nx + 1}"
        )


def at_rest(dynamics: Dynamics, start: Start) -> np.ndarray:
    """Return the initial z per unit of y₀, (nz, ny); zero unless z starts in the steady state."""
    if start == "output":
        return -np.linalg.solve(dynamics.A, dynamics.B)
    return np.zeros_like(dynamics.B)
