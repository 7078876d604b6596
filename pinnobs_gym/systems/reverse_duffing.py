"""The reverse Duffing oscillator."""

from __future__ import annotations

from dataclasses import dataclass

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
class ReverseDuffing(System):
    """A conservative oscillator whose position changes at the cube of its second state.

    Equations (Farkane et al., PINN-Obs, "Ablation studies"): ẋ₁ = x₂³, ẋ₂ = −x₁, y = x₁.

    Invariant: H = x₁²/2 + x₂⁴/4; every orbit is periodic, with period 5.2441·H^(−1/4) s.

    Observability: no two states give the same output, but the map from the state to (y, ẏ, ÿ) loses
    rank on x₂ = 0, twice in every period, where x₂ cannot be computed by differentiating the
    output.
    """

    state_names = ("x1", "x2")
    output_names = ("y1",)
    scale = (1.3, 1.0)
    state_bound = (2.3, 1.9)
    reward_threshold = -1.27
    setups = {
        "benchmark": Setup(
            x0_low=(-2.2, -1.8),
            x0_high=(2.2, 1.8),
            xhat0=(0.0, 0.0),
            P0=((1.682, 0.0), (0.0, 1.002)),
            transient=0.8,
            poor_prior=PoorPrior((1.0, 1.0), independent(1.5, 1.2)),
            duration=20.0,
            dt=0.02,
            noise_std=0.02,
            truth_step=0.095,
        ),
        "paper": Setup(
            x0_low=(2.0, -1.0),
            x0_high=(2.0, -1.0),
            xhat0=(1.0, 1.0),
            P0=independent(1.5, 1.2),
            duration=20.0,
            dt=2e-3,
            truth_step=0.095,
        ),
    }

    def f(self, t: Array, x: Array, u: Array) -> Array:
        x1, x2 = x[..., 0], x[..., 1]
        return stack(x, x2 * x2 * x2, -x1)

    def h(self, t: Array, x: Array, u: Array) -> Array:
        return x[..., :1]

    def f_jacobian(self, t: Array, x: Array, u: Array) -> Array:
        x2 = x[..., 1]
        return matrix(x, [[0.0, 3 * x2 * x2], [-1.0, 0.0]])

    def h_jacobian(self, t: Array, x: Array, u: Array) -> Array:
        return matrix(x, [[1.0, 0.0]])

    def admissible(self, x0: Array) -> Array:
        """Energy in the tested range: 0.25 ≤ H ≤ 2.5."""
        energy = self.invariants(x0)[..., 0]
        return (energy >= 0.25) & (energy <= 2.5)

    def invariants(self, x: Array) -> Array:
        return (x[..., :1] ** 2) / 2 + (x[..., 1:] ** 4) / 4
