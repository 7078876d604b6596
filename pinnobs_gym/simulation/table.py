"""A function given as a table of points, for use in a system's equations."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from typing import Any, Literal

import numpy as np

from pinnobs_gym.simulation.arrays import array_namespace
from pinnobs_gym.simulation.system import Array

METHODS = ("linear", "monotone")
"""How values between the points are found."""


def table(
    x: Array,
    points: Iterable[float],
    values: Iterable[float],
    method: Literal["linear", "monotone"] = "linear",
) -> Array:
    """Return y(x) for each entry of x, from the values of y at some points.

    Between the points, ``linear`` joins them by straight lines, whose slope jumps at the points.
    ``monotone`` joins them by cubics with a continuous slope, which rise and fall only where the
    values do (PCHIP: Fritsch & Carlson 1980, with the slopes of Fritsch & Butland 1984).

    Outside the points, y continues in a straight line with the slope at the end. A constant there
    would have the slope zero, and an estimate that has left the table could not return: no output
    would depend on it. An end slope of the cubics may itself be zero.

    Entries that are not finite give NaN.

    Args:
        x: a number, or an array of any shape: of NumPy, of torch (its derivatives are those of the
            pieces), or of symbols (`pinnobs_gym.simulation.symbolic.trace`), which gives a
            piecewise expression.
        points: at least two numbers in increasing order, in the unit of x.
        values: y at the points.
        method: ``linear`` or ``monotone``.

    Raises:
        ValueError: in one line, if the points do not increase, are fewer than two or not as many as
            the values, if a number is not finite, or if the method is unknown.
    """
    parts: tuple[Any, Any] = _pieces(_numbers(points, "points"), _numbers(values, "values"), method)
    knots, coefficients = parts
    if isinstance(x, np.ndarray) and x.dtype == object:
        symbols: Any = x
        return symbols.pieces(knots, coefficients)
    if isinstance(x, np.ndarray | np.generic | int | float):
        xp, x = np, np.asarray(x)
        piece = np.searchsorted(knots[1:], x, side="right")
    else:
        xp = array_namespace(x)
        if not xp.isdtype(x.dtype, "real floating"):
            x = xp.astype(x, xp.float64)
        knots, coefficients = (
            xp.asarray(part, dtype=x.dtype, device=x.device) for part in (knots, coefficients)
        )
        # Count the points that are not above x. torch's search warns of views such as x[..., 0].
        piece = xp.sum(xp.astype(x[..., None] >= knots[1:], xp.int64), axis=-1)
    return pieces(x, knots, coefficients, piece)


def pieces(x: Any, knots: Any, coefficients: Any, piece: Any) -> Any:
    """Return piecewise polynomials at x.

    Args:
        x: any shape.
        knots: as from `_pieces`, of the array library of x.
        coefficients: as from `_pieces`, of the array library of x.
        piece: the number of points that are not above x, of its shape.
    """
    # An index without axes would be read as a number, which torch.func.vmap does not allow.
    at = piece[None]
    s = x - knots[at][0]
    *lower, y = (part[at][0] for part in coefficients)
    for part in reversed(lower):  # Horner's scheme
        y = part + s * y
    return y


def _numbers(given: Iterable[float], name: str) -> tuple[float, ...]:
    try:
        return tuple(map(float, given))
    except (TypeError, ValueError):
        raise ValueError(f"{name}={given}; expected a sequence of numbers") from None


@lru_cache(maxsize=64)
def _pieces(
    points: tuple[float, ...], values: tuple[float, ...], method: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return the pieces of y: a + bs + cs² + ds³ with s = x − knot.

    Returns:
        The knots, (n + 1,), and the coefficients (2 or 4, n + 1) of n points. Piece 0 is below the
        first point, which is its knot, and piece j begins at the j-th point, its knot.
    """
    p, v = np.array(points), np.array(values)
    if method not in METHODS:
        raise ValueError(f"unknown method {method!r} of a table; it has {', '.join(METHODS)}")
    if len(p) < 2 or len(p) != len(v):
        raise ValueError(
            f"a table of {len(p)} points and {len(v)} values; expected as many of both, and at "
            "least two"
        )
    for name, numbers in (("points", p), ("values", v)):
        if not np.isfinite(numbers).all():
            raise ValueError(f"{name}={numbers.tolist()}; expected finite numbers")
    width = np.diff(p)
    if not (width > 0).all():
        at = int(np.argmin(width > 0))
        raise ValueError(
            f"points of a table: {points[at]:g} is followed by {points[at + 1]:g}; expected "
            "increasing numbers"
        )
    slope = np.diff(v) / width
    coefficients = np.zeros((2 if method == "linear" else 4, len(p) + 1))
    coefficients[0] = v[np.r_[0, : len(p)]]
    inner = coefficients[:, 1:-1]
    if method == "linear":
        first, last, inner[1] = slope[0], slope[-1], slope
    else:
        d = _monotone_slopes(width, slope)
        first, last, inner[1] = d[0], d[-1], d[:-1]
        # Hermite's cubic with these slopes at the ends of a piece
        excess = (d[:-1] + d[1:] - 2 * slope) / width
        inner[2], inner[3] = (slope - d[:-1]) / width - excess, excess / width
    coefficients[1, 0], coefficients[1, -1] = first, last
    return p[np.r_[0, : len(p)]], coefficients


def _monotone_slopes(width: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Return the slope at each of n points from the n − 1 widths and slopes between them."""
    if len(slope) == 1:
        return np.repeat(slope, 2)
    # Inside: the weighted harmonic mean of the slopes on both sides (Fritsch & Butland 1984, eq.
    # 5), and zero at a turning point.
    w1, w2 = 2 * width[1:] + width[:-1], width[1:] + 2 * width[:-1]
    turning = np.sign(slope[1:]) * np.sign(slope[:-1]) <= 0
    left, right = (np.where(turning, 1.0, part) for part in (slope[:-1], slope[1:]))
    inside = np.where(turning, 0.0, (w1 + w2) / (w1 / left + w2 / right))
    ends = (_end_slope(width[:2], slope[:2]), _end_slope(width[:-3:-1], slope[:-3:-1]))
    return np.array([ends[0], *inside, ends[1]])


def _end_slope(width: np.ndarray, slope: np.ndarray) -> float:
    """Return the slope at an end from the two pieces next to it, the outer one first: that of the
    parabola through the three points, limited so that the outer piece stays monotone."""
    (w0, w1), (m0, m1) = width, slope
    end = ((2 * w0 + w1) * m0 - w0 * m1) / (w0 + w1)
    if np.sign(end) != np.sign(m0):
        return 0.0
    if np.sign(m0) != np.sign(m1) and abs(end) > 3 * abs(m0):
        return float(3 * m0)
    return float(end)
