"""Many line searches at once, in operations on tensors with masks: no number is read back, so that
a GPU does not wait for Python."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from trainers.pinn_obs.quasi_newton import CURVATURE, SUFFICIENT_DECREASE, TRIALS


@dataclass(eq=False)
class Trials:
    """A trial of each search: a step, and the function and its slope at that step; (batch,) each.
    See `trainers.pinn_obs.quasi_newton.Trial`."""

    step: Tensor
    f: Tensor
    slope: Tensor

    def where(self, mask: Tensor, other: Trials) -> Trials:
        """Return these trials where the mask (batch,) is true, and others elsewhere."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return Trials(*(torch.where(mask, mine, its) for mine, its in pairs))


class Searches:
    """Line searches of a batch, each as `trainers.pinn_obs.quasi_newton.trials` searches.

    Args:
        batch: number of searches.
        like: tensor of their precision and device.
    """

    def __init__(self, batch: int, like: Tensor) -> None:
        zero = torch.zeros(batch, dtype=like.dtype, device=like.device)
        self.step = zero
        """The trial steps, shape (batch,); zero where no search is active."""
        self.active = zero > 0
        """Where a search is in progress, bool (batch,)."""
        self.start, self.low, self.high = (Trials(zero, zero, zero) for _ in range(3))
        """The start of each search, and the ends of its bracket."""
        self._bracketed, self._count = zero > 0, zero

    def begin(self, mask: Tensor, f: Tensor, slope: Tensor, first: Tensor) -> None:
        """Begin a search where the mask (batch,) is true, from the function, its slope and the
        first trial step, (batch,) each."""
        start = Trials(torch.zeros_like(f), f, slope)
        self.start = start.where(mask, self.start)
        self.low = start.where(mask, self.low)
        self._bracketed = self._bracketed & ~mask
        self._count = torch.where(mask, 0.0, self._count)
        self.step = torch.where(mask, first, self.step)
        self.active = self.active | mask

    def advance(self, f: Tensor, slope: Tensor) -> tuple[Tensor, Tensor]:
        """Take the function and its slope at the trial steps, (batch,) each, and set the next.

        Returns:
            Where the step is accepted, and where a search failed, bool (batch,) each; these are no
            longer active.
        """
        start, low, high = self.start, self.low, self.high
        trial = Trials(self.step, torch.where(f.isfinite(), f, torch.inf), slope)
        least = start.f + SUFFICIENT_DECREASE * trial.step * start.slope
        above = ~(trial.f <= least) | (trial.f >= low.f)
        accepted = self.active & ~above & (slope.abs() <= -CURVATURE * start.slope)
        # Shrink the bracket; see `trials`.
        width = torch.where(self._bracketed, high.step - low.step, 1.0)
        turned = ~above & (slope * width >= 0)
        self.high = high = trial.where(above, low.where(turned, high))
        self.low = low = low.where(above, trial)
        self._bracketed = self._bracketed | above | turned
        size = torch.maximum(low.step.abs(), high.step.abs())
        closed = self._bracketed & ((high.step - low.step).abs() <= 1e-14 * size)
        self._count = self._count + 1
        failed = self.active & ~accepted & (closed | (self._count >= TRIALS))
        beyond = torch.maximum(2 * low.step, _minimiser(start, low, torch.inf))
        beyond = torch.minimum(10 * low.step, beyond)
        step = torch.where(self._bracketed, _between(low, high), beyond)
        self.active = self.active & ~accepted & ~failed
        self.step = torch.where(self.active, step, 0.0)
        return accepted, failed


def _between(low: Trials, high: Trials) -> Tensor:
    """Return the next trial steps inside brackets; see `trainers.pinn_obs.quasi_newton`."""
    width = high.step - low.step
    middle = low.step + width / 2
    guess = torch.where(high.f.isfinite(), _minimiser(low, high, middle), low.step + 0.1 * width)
    ends = low.step + 0.05 * width, high.step - 0.05 * width
    return torch.minimum(torch.maximum(guess, torch.minimum(*ends)), torch.maximum(*ends))


def _minimiser(one: Trials, other: Trials, otherwise: Tensor | float) -> Tensor:
    """Return the minimisers of the cubics through two trials and their slopes, or ``otherwise``
    where there is none."""
    width = other.step - one.step
    d1 = one.slope + other.slope - 3 * (other.f - one.f) / width
    root = d1 * d1 - one.slope * other.slope
    d2 = torch.copysign(root.clamp(min=0).sqrt(), width)
    below = other.slope - one.slope + 2 * d2
    step = other.step - width * (other.slope + d2 - d1) / below
    return torch.where((root >= 0) & (below != 0) & step.isfinite(), step, otherwise)


def update_weights(
    sBs: Tensor, yw: Tensor, sy: Tensor, n: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return what `trainers.pinn_obs.quasi_newton.update_weights` does, of shape (batch,) each."""
    b, h = sBs / sy, yw / sy
    a = (h * b - 1).clamp(min=1e-12)
    rho = (h * (1 - (a / (a + 1)).sqrt())).clamp(max=1.0)
    theta = torch.maximum((rho - 1) / a, torch.minimum(1 / rho, (1 - b) / b))
    sigma = 1 + a * theta
    root = torch.ones_like(a)
    if n > 1:
        root = torch.where(sigma != 0, sigma.abs() ** (-1 / (n - 1)), root)
    shrunk, grown = torch.minimum(rho * root, sigma), rho * torch.minimum(root, 1 / theta)
    tau = torch.where(theta <= 0, shrunk, grown)
    phi = (1 - theta) / sigma
    ss = phi * yw / (sy * sy) / tau + 1 / sy
    return tau, ss, -phi / sy / tau, (phi - 1) / yw / tau
