"""Self-scaled Broyden minimisation of smooth functions of up to a few thousand variables.

The method of Al-Baali, in the form that Urbán, Stefanou & Pons ("Unveiling the optimization process
of physics informed neural networks", 2025) found best for such networks (their SSBroyden): a member
of Broyden's family chosen anew at each step between BFGS and beyond, its matrix scaled beforehand.
The line search is that of Nocedal & Wright, "Numerical Optimization", algorithms 3.5 and 3.6.
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
_TRIALS = 25
_APART = 16
"""Updates of the inverse Hessian that are added up at a time."""
Weights: TypeAlias = tuple[float, float, float, float]
"""What an update divides H by, and its weights of ssᵀ, swᵀ + wsᵀ and wwᵀ."""
_symv, _syr2k = get_blas_funcs(("symv", "syr2k"), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Point:
    """A place on the line x + a·d."""

    step: float
    """a."""
    f: float
    """The function there."""
    slope: float
    """Its derivative along d."""
    x: np.ndarray
    """The place itself, shape (n,)."""
    gradient: np.ndarray
    """The gradient there, shape (n,)."""


@dataclass(frozen=True)
class Trial:
    """What a line search sees of a place on its line."""

    step: float
    f: float
    slope: float


Search: TypeAlias = Generator[float, tuple[float, float], bool]
"""Yields steps to try, is sent the function and its slope there, and returns whether the last of
them will do."""


def line_search(
    objective: Objective,
    start: Point,
    direction: np.ndarray,
    first: float = 1.0,
    curvature: float = CURVATURE,
) -> Point | None:
    """A step along a direction of descent that satisfies the strong Wolfe conditions, or None if
    rounding hides one; see `trials`.

    Args:
        objective: the function.
        start: where the line begins, with ``step`` 0 and a negative slope.
        direction: d, shape (n,).
        first: the first step tried.
        curvature: c₂; the smaller, the nearer to the minimum along the line.
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
    """A search for a step a that satisfies the strong Wolfe conditions

    f(a) ≤ f(0) + c₁·a·f'(0) and abs f'(a) ≤ c₂·abs f'(0), from f(0) and f'(0) < 0.
    """
    start = Trial(0.0, f, slope)

    def decreases(trial: Trial) -> bool:
        return trial.f <= start.f + SUFFICIENT_DECREASE * trial.step * start.slope

    low, high, step = start, None, first
    for _ in range(_TRIALS):
        f, slope = yield step
        trial = Trial(step, f if math.isfinite(f) else math.inf, slope)
        if not decreases(trial) or trial.f >= low.f:
            high = trial
        elif abs(trial.slope) <= -curvature * start.slope:
            return True
        else:
            end = math.inf if high is None else high.step
            if trial.slope * (end - trial.step if high is None else end - low.step) >= 0:
                high = low
            low = trial
        if high is None:
            step = min(10 * low.step, max(2 * low.step, _minimiser(start, low, math.inf)))
        elif abs(high.step - low.step) <= 1e-14 * max(abs(low.step), abs(high.step)):
            break
        else:
            step = _between(low, high)
    return False


def _between(low: Trial, high: Trial) -> float:
    """The next trial inside an interval: by interpolation, but not too near its ends."""
    width = high.step - low.step
    middle = low.step + width / 2
    guess = _minimiser(low, high, middle) if math.isfinite(high.f) else low.step + 0.1 * width
    inside = sorted((low.step + 0.05 * width, high.step - 0.05 * width))
    return min(max(guess, inside[0]), inside[1])


def _minimiser(one: Trial, other: Trial, otherwise: float) -> float:
    """The minimiser of the cubic through two points with their slopes (Nocedal & Wright, 3.59)."""
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
    """The inverse Hessian's approximation: scale · matrix + vectors · middle · vectorsᵀ.

    The last updates stay apart: to multiply by them is cheap, and to add many at once takes little
    more than to add one, for which the whole matrix goes through memory just the same.
    """

    matrix: np.ndarray = field(repr=False)
    """Shape (n, n), in Fortran's order; its lower triangle counts."""
    scale: float
    vectors: np.ndarray = field(repr=False)
    """Shape (n, 2k), two for each of k updates."""
    middle: np.ndarray = field(repr=False)
    """Shape (2k, 2k)."""

    @staticmethod
    def identity(n: int, scale: float) -> Inverse:
        """A multiple of the identity."""
        matrix = np.asfortranarray(np.eye(n))
        return Inverse(matrix, scale, np.empty((n, 0), order="F"), np.empty((0, 0)))

    def times(self, x: np.ndarray) -> np.ndarray:
        """The product with x (n,)."""
        by_vectors = self.middle @ (self.vectors.T @ x)
        return _symv(self.scale, self.matrix, x, lower=1) + self.vectors @ by_vectors

    def update(self, s: np.ndarray, w: np.ndarray, weights: Weights) -> None:
        """Divide by τ and add ssᵀ, swᵀ + wsᵀ and wwᵀ with their weights; see `update_weights`."""
        tau, ss, sw, ww = weights
        self.scale /= tau
        self.vectors = np.asfortranarray(np.column_stack([self.vectors, s, w]))
        self.middle = np.asarray(block_diag(self.middle / tau, [[ss, sw], [sw, ww]]))
        if self.vectors.shape[1] >= 2 * _APART:
            half = np.asfortranarray(self.vectors @ (self.middle / 2))
            args = self.vectors, half, self.scale, self.matrix
            self.matrix = _syr2k(1.0, *args, lower=1, overwrite_c=1)
            self.scale, self.vectors = 1.0, self.vectors[:, :0]
            self.middle = self.middle[:0, :0]

    @property
    def whole(self) -> bool:
        """Whether no update stands apart."""
        return self.vectors.shape[1] == 0


@dataclass(eq=False)
class QuasiNewton:
    """A minimisation in progress: all that changes from one step to the next."""

    x: np.ndarray
    """Where it stands, shape (n,)."""
    f: float
    """The function there."""
    gradient: np.ndarray
    """The gradient there, shape (n,)."""
    H: Inverse | None = field(default=None, repr=False)
    """The inverse Hessian's approximation; the identity if None."""
    direction: np.ndarray | None = field(default=None, repr=False)
    """−H∇f, shape (n,), if it is known."""
    curvature: float = CURVATURE
    """c₂ of the line search."""
    first: float = 1.0
    """The first step tried along a quasi-Newton direction."""

    @staticmethod
    def start(
        objective: Objective, x: np.ndarray, curvature: float = CURVATURE, first: float = 1.0
    ) -> QuasiNewton:
        """A minimisation that begins at x (n,)."""
        x = np.array(x, dtype=float)
        f, gradient = objective(x)
        return QuasiNewton(x, float(f), gradient, curvature=curvature, first=first)

    def step(self, objective: Objective) -> bool:
        """One iteration; False if no lower value can be found, and nothing has changed but H.

        If the search fails along the quasi-Newton direction, the matrix is forgotten and the
        steepest descent tried.
        """
        while True:
            direction = self.direction
            if direction is None:
                direction = -self.gradient if self.H is None else -self.H.times(self.gradient)
            slope = float(self.gradient @ direction)
            here = Point(0.0, self.f, slope, self.x, self.gradient)
            first = self.first if self.H is not None else first_step(slope)
            found = None
            if slope < 0:
                found = line_search(objective, here, direction, first, self.curvature)
            if found is not None or self.H is None:
                break
            self.H = self.direction = None
        if found is None:
            return False
        self._update(found, direction)
        self.x, self.f, self.gradient = found.x, found.f, found.gradient
        return True

    def _update(self, found: Point, direction: np.ndarray) -> None:
        """The new H: (H − wwᵀ/yᵀw + φ·vvᵀ)/τ + ssᵀ/sᵀy with w = Hy and
        v = √(yᵀw)·(s/sᵀy − w/yᵀw), written out in ssᵀ, swᵀ + wsᵀ and wwᵀ.

        With it comes the new direction, from that of the step and w; it is multiplied out anew
        whenever the updates are added up, so that rounding does not gather in it.
        """
        s, y, g = found.x - self.x, found.gradient - self.gradient, found.gradient
        sy = float(s @ y)
        self.direction = None
        if not curved(sy, float(s @ s), float(y @ y)):
            return
        if self.H is None:  # Nocedal & Wright, 6.20
            scale = sy / float(y @ y)
            self.H = Inverse.identity(len(s), scale)
            sBs, along = float(s @ s) / scale, scale * self.gradient
        else:
            sBs, along = -found.step * float(s @ self.gradient), -direction
        w = self.H.times(y)
        weights = update_weights(sBs, float(y @ w), sy, len(s))
        self.H.update(s, w, weights)
        if not self.H.whole:
            tau, ss, sw, ww = weights
            sg, wg = float(s @ g), float(w @ g)
            product = (along + w) / tau + (ss * sg + sw * wg) * s + (sw * sg + ww * wg) * w
            self.direction = -product


def first_step(slope: float) -> float:
    """The first step tried along the steepest descent, of this slope."""
    return min(1.0, 1 / math.sqrt(max(-slope, 1e-300)))


def curved(sy: float, ss: float, yy: float) -> bool:
    """Whether sᵀy, which the curvature condition makes positive, is more than rounding."""
    return sy > 1e-14 * math.sqrt(ss * yy)


def update_weights(sBs: float, yw: float, sy: float, n: int) -> Weights:
    """What the update divides H by, and its weights of ssᵀ, swᵀ + wsᵀ and wwᵀ."""
    phi, tau = _scaled_broyden(sBs / sy, yw / sy, n)
    return tau, phi * yw / (sy * sy) / tau + 1 / sy, -phi / sy / tau, (phi - 1) / yw / tau


def _scaled_broyden(b: float, h: float, n: int) -> tuple[float, float]:
    """φ, the member of the family, and τ, the scale, from b = sᵀBs/sᵀy and h = yᵀHy/sᵀy."""
    a = max(h * b - 1, 1e-12)  # zero where s and Hy are parallel: all members agree
    rho = min(1.0, h * (1 - math.sqrt(a / (a + 1))))
    theta = max((rho - 1) / a, min(1 / rho, (1 - b) / b))
    sigma = 1 + a * theta
    root = abs(sigma) ** (-1 / (n - 1)) if n > 1 and sigma else 1.0
    tau = min(rho * root, sigma) if theta <= 0 else rho * min(root, 1 / theta)
    return (1 - theta) / sigma, tau


def minimise(
    objective: Objective,
    x: np.ndarray,
    *,
    iterations: int = 1000,
    tolerance: float = 1e-8,
    curvature: float = CURVATURE,
    watch: Callable[[QuasiNewton], None] = lambda state: None,
) -> QuasiNewton:
    """Minimise from x (n,) until the largest component of the gradient is within the tolerance.

    Args:
        objective: the function and its gradient.
        x: where to begin.
        iterations: most iterations.
        tolerance: largest component of the gradient that counts as zero.
        curvature: c₂ of the line search.
        watch: called after each iteration.
    """
    state = QuasiNewton.start(objective, x, curvature)
    for _ in range(iterations):
        if abs(state.gradient).max() <= tolerance or not state.step(objective):
            break
        watch(state)
    return state
