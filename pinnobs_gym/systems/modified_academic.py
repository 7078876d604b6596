"""The academic system with its nonlinearity in the unmeasured state."""

from __future__ import annotations

from dataclasses import dataclass

from pinnobs_gym.simulation.arrays import array_namespace
from pinnobs_gym.simulation.system import (
    Array,
    PoorPrior,
    Setup,
    System,
    independent,
    matrix,
    stack,
)


@dataclass(frozen=True)
class ModifiedAcademic(System):
    """A second-order plant with a nonlinearity in the unmeasured state.

    Equations (Farkane et al., PINN-Obs, "Applications"): ẋ₁ = x₂√(1 + x₂²), ẋ₂ = −x₁x₂²/√(1 + x₂²),
    y = x₁.

    Invariants: ln abs(x₂) + (x₁² + x₂²)/2, and the sign of x₂.

    Observability: no two states give the same output, since ∂ẏ/∂x₂ ≥ 1. As x₂ decays, late relative
    errors would be meaningless; errors are scored relative to the scale.
    """

    state_names = ("x1", "x2")
    output_names = ("y1",)
    scale = (2.0, 0.8)
    state_bound = (4.6, 3.2)
    reward_threshold = -1.22
    setups = {
        "benchmark": Setup(
            x0_low=(-3.0, -1.5),
            x0_high=(3.0, 1.5),
            xhat0=(0.0, 0.0),
            P0=((3.0, 0.0), (0.0, 0.8033)),
            transient=0.8,
            poor_prior=PoorPrior((3.0, 1.0), independent(3.0, 1.5)),
            duration=20.0,
            dt=0.02,
            noise_std=0.02,
            truth_step=0.08,
        ),
        "paper": Setup(
            x0_low=(2.0, -1.0),
            x0_high=(2.0, -1.0),
            xhat0=(3.0, 1.0),
            P0=independent(3.0, 1.5),
            duration=20.0,
            dt=2e-3,
            truth_step=0.05,
        ),
    }

    def f(self, t: Array, x: Array, u: Array) -> Array:
        x1, x2 = x[..., 0], x[..., 1]
        root = array_namespace(x).sqrt(1 + x2 * x2)
        return stack(x, x2 * root, -x1 * x2 * x2 / root)

    def h(self, t: Array, x: Array, u: Array) -> Array:
        return x[..., :1]

    def f_jacobian(self, t: Array, x: Array, u: Array) -> Array:
        x1, x2 = x[..., 0], x[..., 1]
        square = x2 * x2
        root = array_namespace(x).sqrt(1 + square)
        slope = -x1 * x2 * (2 + square) / (root * root * root)
        return matrix(x, [[0.0, root + square / root], [-square / root, slope]])

    def h_jacobian(self, t: Array, x: Array, u: Array) -> Array:
        return matrix(x, [[1.0, 0.0]])

    def admissible(self, x0: Array) -> Array:
        """States away from the equilibria x₂ = 0: abs x₂ ≥ 0.1."""
        return abs(x0[..., 1]) >= 0.1

    def invariants(self, x: Array) -> Array:
        xp = array_namespace(x)
        x1, x2 = x[..., 0], x[..., 1]
        return stack(x, xp.log(abs(x2)) + (x1 * x1 + x2 * x2) / 2, xp.sign(x2))
