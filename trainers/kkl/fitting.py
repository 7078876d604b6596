"""Fitting of one network to equations that are linear in its outputs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import torch
from torch import Tensor

from pinnobs_gym.estimation.learned.kkl_maps import Mlp
from trainers.adam import Adam

FitMethod: TypeAlias = Literal["gauss_newton", "adam"]
"""How networks are fitted."""

AVERAGE = 0.9
"""Weight of the past in the averaged Gauss-Newton matrix."""
LAST_STEP = 0.01
"""Last step size over the first; the step size decays as a half cosine."""
_TRIALS = 6
"""Largest number of dampings tried per batch."""
_LEAST_DAMPING, _FIRST_DAMPING = 1e-4, 1e-2


@dataclass(frozen=True, eq=False)
class Term:
    """The term M·N(a), or M·(∂N/∂a)·da, of a network N at scaled inputs a."""

    a: Tensor
    """Shape (batch, num_inputs)."""
    matrix: Tensor | None = None
    """M, shape (num_outputs, num_outputs) or one for each row; None for the identity."""
    along: Tensor | None = None
    """da, of the shape of a; None for the term M·N(a)."""


@dataclass(frozen=True, eq=False)
class Equations:
    """The equations weight·(Σ terms − target) = 0, in scaled outputs."""

    terms: Sequence[Term]
    target: Tensor
    """Shape (batch, num_outputs)."""
    weight: Tensor | float = 1.0
    """A number, or one for each row, (batch, 1)."""

    def residual(self, net: Mlp) -> Tensor:
        """Return the residual (batch, num_outputs), differentiable by the parameters."""
        total = -self.target
        for term in self.terms:
            value = net(term.a) if term.along is None else net.tangent(term.a, term.along)[1]
            total = total + (value if term.matrix is None else _times(term.matrix, value))
        return self.weight * total

    def linearised(self, net: Mlp) -> tuple[Tensor, Tensor]:
        """Return the residual and its Jacobian (batch, num_outputs, num_parameters)."""
        total, J = -self.target, None
        for term in self.terms:
            if term.along is None:
                value, slope = net.jacobian(term.a)
            else:
                value, slope = net.tangent_jacobian(term.a, term.along)[1]
            if term.matrix is not None:
                value, slope = _times(term.matrix, value), term.matrix @ slope
            total, J = total + value, slope if J is None else J + slope
        assert J is not None
        weight = self.weight[..., None] if isinstance(self.weight, Tensor) else self.weight
        return self.weight * total, weight * J


def _times(matrix: Tensor, values: Tensor) -> Tensor:
    return (matrix @ values[..., None])[..., 0]


def _squared(J: Tensor) -> Tensor:
    """Return JᵀJ. NumPy computes one half of it, torch both."""
    if J.device.type != "cpu":
        return J.T @ J
    rows = J.numpy()
    return torch.from_numpy(rows.T @ rows)


Objective: TypeAlias = Callable[[torch.Generator], Sequence[Equations]]
"""Draws the equations of one step, a mini-batch."""


class Fit:
    """Training of one network, step by step.

    ``gauss_newton`` solves (H + μI)s = g, with the gradient g of the batch and a moving average H
    of JᵀJ over batches. The damping μ is proportional to the loss and adapted by Marquardt's rule.
    The step size decays as a half cosine, which averages out the differences between batches.
    ``adam`` has the same schedule.

    Args:
        net: the network, trained in place.
        objective: draws the equations of a step.
        method: the optimiser.
        learning_rate: initial step size.
        generator: random generator of the batches.
    """

    def __init__(
        self,
        net: Mlp,
        objective: Objective,
        method: FitMethod,
        learning_rate: float,
        generator: torch.Generator,
    ) -> None:
        self.net, self.objective, self.method = net, objective, method
        self.generator, self.learning_rate = generator, learning_rate
        self.iteration, self.loss = 0, math.nan
        self._H: Tensor | None = None
        self._damping = _FIRST_DAMPING
        self._adam = Adam(net.parameters)

    def step(self, progress: float) -> None:
        """Make one step at a training progress between 0 and 1."""
        shape = LAST_STEP + (1 - LAST_STEP) * 0.5 * (1 + math.cos(math.pi * min(progress, 1.0)))
        length = self.learning_rate * shape
        equations = self.objective(self.generator)
        if self.method == "adam":
            self._adam_step(equations, length)
        else:
            self._newton_step(equations, length)
        self.iteration += 1

    def _adam_step(self, equations: Sequence[Equations], length: float) -> None:
        residuals = [e.residual(self.net) for e in equations]
        loss = torch.stack([r.square().mean() for r in residuals]).sum()
        self.loss = loss.item()
        self._adam.clear()
        if math.isfinite(self.loss):
            loss.backward()
            self._adam.step(length)

    def _newton_step(self, equations: Sequence[Equations], length: float) -> None:
        with torch.no_grad():
            # Normal equations of the batch: JᵀJ and the gradient Jᵀr, averaged over equations.
            H, g, self.loss = 0.0, 0.0, 0.0
            for each in equations:
                residual, J = each.linearised(self.net)
                flat, rows = residual.reshape(-1), J.reshape(-1, J.shape[-1])
                H, g = H + _squared(rows) / len(flat), g + rows.T @ flat / len(flat)
                self.loss += float(flat @ flat) / len(flat)
            assert isinstance(H, Tensor)
            assert isinstance(g, Tensor)
            if not math.isfinite(self.loss):
                return
            if self._H is not None:  # moving average over batches, shorter in the first steps
                past = AVERAGE * min(1.0, self.iteration / (self.iteration + 10.0))
                H = past * self._H + (1 - past) * H
            self._H = H
            # Levenberg-Marquardt: raise the damping until a step lowers the batch's loss.
            before = [p.clone() for p in self.net.parameters]
            for _ in range(_TRIALS):
                damped = H.clone()
                damped.diagonal().add_(self._damping * self.loss)
                factor, failed = torch.linalg.cholesky_ex(damped)
                if not failed:
                    self._move(length * torch.cholesky_solve(g[:, None], factor)[:, 0])
                    tried = [e.residual(self.net) for e in equations]
                    if sum(float(r.square().mean()) for r in tried) < self.loss:
                        self._damping = max(self._damping / 2, _LEAST_DAMPING)
                        return
                self._damping *= 4
                for p, old in zip(self.net.parameters, before, strict=True):
                    p.copy_(old)

    def _move(self, step: Tensor) -> None:
        """Subtract a step (num_parameters,) from the parameters."""
        start = 0
        for p in self.net.parameters:
            p.sub_(step[start : start + p.numel()].view_as(p))
            start += p.numel()

    def state(self) -> dict[str, Any]:
        """Return the state of the training, as arrays and plain values."""
        return {
            "iteration": self.iteration,
            "damping": self._damping,
            "H": None if self._H is None else self._H.cpu().numpy(),
            "parameters": [p.detach().cpu().numpy() for p in self.net.parameters],
            "adam": self._adam.state(),
            "generator": self.generator.get_state().numpy(),
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Restore the result of `state` exactly."""
        self.iteration, self._damping = state["iteration"], state["damping"]
        device = self.net.parameters[0].device
        self._H = None if state["H"] is None else torch.from_numpy(state["H"]).to(device)
        with torch.no_grad():
            for p, kept in zip(self.net.parameters, state["parameters"], strict=True):
                p.copy_(torch.from_numpy(kept))
        self._adam.load_state(state["adam"])
        self.generator.set_state(torch.from_numpy(state["generator"]))
