"""Self-scaled Broyden minimisation of smooth functions of up to a few thousand variables.

The method is Al-Baali's, in the form that Urbán, Stefanou & Pons ("Unveiling the optimization
process of physics informed neural networks", 2025) found best for such networks (their SSBroyden).
Each step chooses a member of Broyden's family, and scales the matrix before the update. The line
search is that of Nocedal & Wright, "Numerical Optimization", algorithms 3.5 and 3.6.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from scipy.linalg import block_diag, get_blas_funcs

Objective: TypeAlias = Callable[[np.ndarray], tuple[float, np.ndarray]]
"""A function and its gradient: f and ∇f (n,) at x (n,)."""

SUFFICIENT_DECREASE = 1e-4
"""c₁ of the strong Wolfe conditions."""
CURVATURE = 0.9
"""c₂ of the strong Wolfe conditions."""
TRIALS = 25
"""Largest number of trials of a line search."""
_APART = 16
"""Number of updates of the inverse Hessian that are added to the matrix at a time."""
Weights: TypeAlias = tuple[float, float, float, float]
"""Coefficients of an update: the divisor of H, and the weights of ssᵀ, swᵀ + wsᵀ and wwᵀ."""
_symv, _syr2k = get_blas_funcs(("symv", "syr2k"), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Point:
    """A point on the line x + a·d."""

    step: float
    """The step a."""
    f: float
    """The function at the point."""
    slope: float
    """Its derivative along d."""
    x: np.ndarray
    """The point, shape (n,)."""
    gradient: np.ndarray
    """The gradient at the point, shape (n,)."""


@dataclass(frozen=True)
class Trial:
    """A trial of a line search: a step, and the function and its slope at that step."""

    step: float
    f: float
    slope: float


Search: TypeAlias = Generator[float, tuple[float, float], bool]
"""Yields trial steps, receives the function and its slope at each, and returns whether the last
step is accepted."""


def line_search(
    objective: Objective,
    start: Point,
    direction: np.ndarray,
    first: float = 1.0,
    curvature: float = CURVATURE,
) -> Point | None:
    """Find a point along a descent direction that satisfies the strong Wolfe conditions.

    Args:
        objective: the function and its gradient.
        start: first point of the line, with ``step`` 0 and a negative slope.
        direction: d, shape (n,).
        first: first trial step.
        curvature: c₂; smaller values give points nearer to the minimum along the line.

    Returns:
        The point, or None if the search fails, as it does where rounding dominates; see `trials`.
    """
    search, point = trials(start.f, start.slope, first, curvature), start
    step = next(search)
    while True:
        x = start.x + step * direction
        f, gradient = objective(x)
        point = Point(step, f, float(gradient @ direction), x, gradient)
        try:
            step = search.send((point.f, point.slope))
        except StopIteration as stop:
            return point if stop.value else None


def trials(f: float, slope: float, first: float, curvature: float) -> Search:
    """Search for a step a that satisfies the strong Wolfe conditions.

    They are f(a) ≤ f(0) + c₁·a·f'(0) and abs f'(a) ≤ c₂·abs f'(0).

    Args:
        f: f(0).
        slope: f'(0), negative.
        first: first trial step.
        curvature: c₂.
    """
    start = Trial(0.0, f, slope)

    def decreases(trial: Trial) -> bool:
        return trial.f <= start.f + SUFFICIENT_DECREASE * trial.step * start.slope

    low, high, step = start, None, first
    for _ in range(TRIALS):
        f, slope = yield step
        trial = Trial(step, f if math.isfinite(f) else math.inf, slope)
        # Shrink the bracket; low has the least f so far that satisfies the first condition.
        if not decreases(trial) or trial.f >= low.f:
            high = trial
        elif abs(trial.slope) <= -curvature * start.slope:
            return True
        else:
            end = math.inf if high is None else high.step
            if trial.slope * (end - trial.step if high is None else end - low.step) >= 0:
                high = low
            low = trial
        # Without a bracket extrapolate; else interpolate, until rounding dominates.
        if high is None:
            step = min(10 * low.step, max(2 * low.step, _minimiser(start, low, math.inf)))
        elif abs(high.step - low.step) <= 1e-14 * max(abs(low.step), abs(high.step)):
            break
        else:
            step = _between(low, high)
    return False


def _between(low: Trial, high: Trial) -> float:
    """Return the next trial step inside a bracket, by interpolation, but not too near its ends."""
    width = high.step - low.step
    middle = low.step + width / 2
    guess = _minimiser(low, high, middle) if math.isfinite(high.f) else low.step + 0.1 * width
    inside = sorted((low.step + 0.05 * width, high.step - 0.05 * width))
    return min(max(guess, inside[0]), inside[1])


def _minimiser(one: Trial, other: Trial, otherwise: float) -> float:
    """Return the minimiser of the cubic through two trials and their slopes (Nocedal & Wright,
    3.59), or ``otherwise`` if it has none."""
    width = other.step - one.step
    d1 = one.slope + other.slope - 3 * (other.f - one.f) / width
    root = d1 * d1 - one.slope * other.slope
    if not root >= 0:
        return otherwise
    d2 = math.copysign(math.sqrt(root), width)
    below = other.slope - one.slope + 2 * d2
    step = other.step - width * (other.slope + d2 - d1) / below if below else otherwise
    return step if math.isfinite(step) else otherwise


@dataclass(eq=False)
class Inverse:
    """Approximate inverse Hessian scale · matrix + vectors · middle · vectorsᵀ.

    The latest updates are kept as low-rank factors, whose products are cheap. Adding many of them
    to the matrix at once takes little longer than adding one, because the cost is that of passing
    the matrix through memory.
    """

    matrix: np.ndarray = field(repr=False)
    """Shape (n, n), in Fortran order; only its lower triangle is used."""
    scale: float
    vectors: np.ndarray = field(repr=False)
    """Shape (n, 2k), two columns for each of k updates."""
    middle: np.ndarray = field(repr=False)
    """Shape (2k, 2k)."""

    @staticmethod
    def identity(n: int, scale: float) -> Inverse:
        """Return a multiple of the identity."""
        matrix = np.asfortranarray(np.eye(n))
        return Inverse(matrix, scale, np.empty((n, 0), order="F"), np.empty((0, 0)))

    def times(self, x: np.ndarray) -> np.ndarray:
        """Return the product with x (n,)."""
        by_vectors = self.middle @ (self.vectors.T @ x)
        return _symv(self.scale, self.matrix, x, lower=1) + self.vectors @ by_vectors

    def update(self, s: np.ndarray, w: np.ndarray, weights: Weights) -> None:
        """Divide by τ and add ssᵀ, swᵀ + wsᵀ and wwᵀ with their weights; see `update_weights`."""
        tau, ss, sw, ww = weights
        self.scale /= tau
        self.vectors = np.asfortranarray(np.column_stack([self.vectors, s, w]))
        self.middle = np.asarray(block_diag(self.middle / tau, [[ss, sw], [sw, ww]]))
        if self.vectors.shape[1] >= 2 * _APART:  # add the low-rank part to the matrix
            half = np.asfortranarray(self.vectors @ (self.middle / 2))
            args = self.vectors, half, self.scale, self.matrix
            self.matrix = _syr2k(1.0, *args, lower=1, overwrite_c=1)
            self.scale, self.vectors = 1.0, self.vectors[:, :0]
            self.middle = self.middle[:0, :0]

    @property
    def whole(self) -> bool:
        """Whether all updates are added to the matrix."""
        return self.vectors.shape[1] == 0


@dataclass(eq=False)
class QuasiNewton:
    """A minimisation in progress."""

    x: np.ndarray
    """Current point, shape (n,)."""
    f: float
    """The function at x."""
    gradient: np.ndarray
    """The gradient at x, shape (n,)."""
    H: Inverse | None = field(default=None, repr=False)
    """Approximate inverse Hessian; the identity if None."""
    direction: np.ndarray | None = field(default=None, repr=False)
    """−H∇f, shape (n,), if already computed."""
    curvature: float = CURVATURE
    """c₂ of the line search."""
    first: float = 1.0
    """First trial step along a quasi-Newton direction."""

    @staticmethod
    def start(
        objective: Objective, x: np.ndarray, curvature: float = CURVATURE, first: float = 1.0
    ) -> QuasiNewton:
        """Begin a minimisation at x (n,)."""
        x = np.array(x, dtype=float)
        f, gradient = objective(x)
        return QuasiNewton(x, float(f), gradient, curvature=curvature, first=first)

    def step(self, objective: Objective) -> bool:
        """Make one iteration; return False, and leave x unchanged, if no lower value is found.

        If the line search along the quasi-Newton direction fails, H is reset to the identity, and
        steepest descent is tried.
        """
        while True:
            direction = self.direction
            if direction is None:
                direction = -self.gradient if self.H is None else -self.H.times(self.gradient)
            slope = float(self.gradient @ direction)
            here = Point(0.0, self.f, slope, self.x, self.gradient)
            first = self.first if self.H is not None else first_step(slope)
            point = None
            if slope < 0:
                point = line_search(objective, here, direction, first, self.curvature)
            if point is not None or self.H is None:
                break
            self.H = self.direction = None
        if point is None:
            return False
        self._update(point, direction)
        self.x, self.f, self.gradient = point.x, point.f, point.gradient
        return True

    def _update(self, point: Point, direction: np.ndarray) -> None:
        """Update H after a step, and compute the next direction.

        H becomes (H − wwᵀ/yᵀw + φ·vvᵀ)/τ + ssᵀ/sᵀy with w = Hy and v = √(yᵀw)·(s/sᵀy − w/yᵀw),
        expanded in ssᵀ, swᵀ + wsᵀ and wwᵀ. The next direction follows from the last one and w. It
        is computed afresh whenever updates are added to the matrix, so that rounding errors do not
        accumulate.
        """
        s, y, g = point.x - self.x, point.gradient - self.gradient, point.gradient
        sy = float(s @ y)
        self.direction = None
        if not curved(sy, float(s @ s), float(y @ y)):  # skip the update
            return
        if self.H is None:  # initial scale, Nocedal & Wright, 6.20
            scale = sy / float(y @ y)
            self.H = Inverse.identity(len(s), scale)
            sBs, along = float(s @ s) / scale, scale * self.gradient
        else:
            sBs, along = -point.step * float(s @ self.gradient), -direction
        w = self.H.times(y)
        weights = update_weights(sBs, float(y @ w), sy, len(s))
        self.H.update(s, w, weights)
        if not self.H.whole:  # −H∇f from products that are already known
            tau, ss, sw, ww = weights
            sg, wg = float(s @ g), float(w @ g)
            product = (along + w) / tau + (ss * sg + sw * wg) * s + (sw * sg + ww * wg) * w
            self.direction = -product


def first_step(slope: float) -> float:
    """Return the first trial step along the steepest descent, for its slope."""
    return min(1.0, 1 / math.sqrt(max(-slope, 1e-300)))


def curved(sy: float, ss: float, yy: float) -> bool:
    """Return whether sᵀy, which the curvature condition makes positive, exceeds rounding errors."""
    return sy > 1e-14 * math.sqrt(ss * yy)


def update_weights(sBs: float, yw: float, sy: float, n: int) -> Weights:
    """Return the coefficients of an update of H.

    Args:
        sBs: sᵀBs, where B is the inverse of H.
        yw: yᵀw = yᵀHy.
        sy: sᵀy.
        n: number of variables.
    """
    phi, tau = _scaled_broyden(sBs / sy, yw / sy, n)
    return tau, phi * yw / (sy * sy) / tau + 1 / sy, -phi / sy / tau, (phi - 1) / yw / tau


def _scaled_broyden(b: float, h: float, n: int) -> tuple[float, float]:
    """Return φ, the member of Broyden's family, and τ, the scale.

    The arguments are b = sᵀBs/sᵀy, h = yᵀHy/sᵀy and the number of variables n.
    """
    a = max(h * b - 1, 1e-12)  # zero if s and Hy are parallel, where all members agree
    rho = min(1.0, h * (1 - math.sqrt(a / (a + 1))))
    theta = max((rho - 1) / a, min(1 / rho, (1 - b) / b))
    sigma = 1 + a * theta
    root = abs(sigma) ** (-1 / (n - 1)) if n > 1 and sigma else 1.0
    tau = min(rho * root, sigma) if theta <= 0 else rho * min(root, 1 / theta)
    return (1 - theta) / sigma, tau
