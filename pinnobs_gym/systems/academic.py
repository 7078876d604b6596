"""The academic system of Sanfelice & Praly."""

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
class Academic(System):
    """A double integrator in nonlinear coordinates.

    Equations (Farkane et al., PINN-Obs, "Applications"; Sanfelice & Praly 2012): ẋ₁ = x₂√(1 + x₁²),
    ẋ₂ = −x₁x₂²/√(1 + x₁²), y = x₁.

    Invariant: c = x₂√(1 + x₁²), hence x₁(t) = x₁(0) + c·t, which is unbounded.

    Observability: no two states give the same output. As x₁ grows, x₂ decays like c/x₁. Its errors
    are therefore scored relative to its initial spread, not to its value.
    """

    state_names = ("x1", "x2")
    output_names = ("y1",)
    scale = (1.2, 0.9)
    state_bound = (28.0, 2.6)
    reward_threshold = -1.08
    setups = {
        "benchmark": Setup(
            x0_low=(-2.0, -1.5),
            x0_high=(2.0, 1.5),
            xhat0=(0.0, 0.0),
            P0=((1.281, 0.0), (0.0, 0.8165)),
            transient=0.88,
            poor_prior=PoorPrior((1.0, 2.0), independent(1.5, 2.0)),
            duration=10.0,
            dt=0.02,
            noise_std=0.02,
            truth_step=0.08,
        ),
        "paper": Setup(
            x0_low=(2.0, -1.0),
            x0_high=(2.0, -1.0),
            xhat0=(1.0, 2.0),
            P0=independent(1.5, 2.0),
            duration=20.0,
            dt=2e-3,
            truth_step=0.05,
        ),
    }

    def f(self, t: Array, x: Array, u: Array) -> Array:
        x1, x2 = x[..., 0], x[..., 1]
        root = array_namespace(x).sqrt(1 + x1 * x1)
        return stack(x, x2 * root, -x1 * x2 * x2 / root)

    def h(self, t: Array, x: Array, u: Array) -> Array:
        return x[..., :1]

    def f_jacobian(self, t: Array, x: Array, u: Array) -> Array:
        x1, x2 = x[..., 0], x[..., 1]
        root = array_namespace(x).sqrt(1 + x1 * x1)
        slope = x1 * x2 / root
        return matrix(x, [[slope, root], [-x2 * x2 / (root * root * root), -2 * slope]])

    def h_jacobian(self, t: Array, x: Array, u: Array) -> Array:
        return matrix(x, [[1.0, 0.0]])

    def admissible(self, x0: Array) -> Array:
        """States neither nearly at rest nor faster than tested: 0.3 ≤ abs c ≤ 2.5."""
        speed = abs(self.invariants(x0)[..., 0])
        return (speed >= 0.3) & (speed <= 2.5)

    def invariants(self, x: Array) -> Array:
        return x[..., 1:] * array_namespace(x).sqrt(1 + x[..., :1] ** 2)
