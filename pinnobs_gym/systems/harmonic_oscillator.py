"""The harmonic oscillator of unknown frequency."""

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
class HarmonicOscillator(System):
    """A harmonic oscillator whose unknown squared angular frequency is the third state.

    Equations (Farkane et al., PINN-Obs, "Applications"; Praly, Isidori & Marconi 2006): ẋ₁ = x₂, ẋ₂
    = −x₃x₁, ẋ₃ = 0, y = x₁.

    Invariants: x₃ and x₂² + x₃x₁².

    Observability: at rest, x₁ = x₂ = 0, any x₃ gives the same output. The map from the state to (y,
    ẏ, ÿ) loses rank on x₁ = 0.

    The ``paper`` setup starts from x̂₃ = −1, from which an uncorrected copy of the plant diverges.
    """

    state_names = ("x1", "x2", "x3")
    output_names = ("y1",)
    units = {"x3": "rad²/s²"}
    scale = (1.0, 1.8, 3.7)
    state_bound = (2.1, 5.0, 6.3)
    reward_threshold = -1.3
    setups = {
        "benchmark": Setup(
            x0_low=(-2.0, -2.0, 0.5),
            x0_high=(2.0, 2.0, 6.0),
            xhat0=(0.0, 0.0, 3.293),
            P0=((1.420, 0.0, 0.0), (0.0, 1.398, 0.0), (0.0, 0.0, 2.405)),
            transient=2.56,
            poor_prior=PoorPrior((1.0, 1.0, 2.0), independent(1.5, 1.5, 2.0)),
            duration=20.0,
            dt=0.02,
            noise_std=0.02,
            truth_step=0.125,
        ),
        "paper": Setup(
            x0_low=(0.0, 1.0, 3.0),
            x0_high=(0.0, 1.0, 3.0),
            xhat0=(0.0, 1.0, -1.0),
            P0=independent(1.5, 1.5, 2.0),
            duration=20.0,
            dt=2e-3,
            truth_step=0.2,
        ),
    }

    def f(self, t: Array, x: Array, u: Array) -> Array:
        x1, x2, x3 = x[..., 0], x[..., 1], x[..., 2]
        return stack(x, x2, -x3 * x1, 0.0)

    def h(self, t: Array, x: Array, u: Array) -> Array:
        return x[..., :1]

    def f_jacobian(self, t: Array, x: Array, u: Array) -> Array:
        x1, x3 = x[..., 0], x[..., 2]
        return matrix(x, [[0.0, 1.0, 0.0], [-x3, 0.0, -x1], [0.0, 0.0, 0.0]])

    def h_jacobian(self, t: Array, x: Array, u: Array) -> Array:
        return matrix(x, [[1.0, 0.0, 0.0]])

    def admissible(self, x0: Array) -> Array:
        """Squared amplitude between 0.5 and 4: 0.5 ≤ x₁² + x₂²/x₃ ≤ 4, with x₃ > 0."""
        x1, x2, x3 = x0[..., 0], x0[..., 1], x0[..., 2]
        energy = x3 * x1 * x1 + x2 * x2
        return (x3 > 0) & (energy >= 0.5 * x3) & (energy <= 4 * x3)

    def invariants(self, x: Array) -> Array:
        x1, x2, x3 = x[..., 0], x[..., 1], x[..., 2]
        return stack(x, x3, x2 * x2 + x3 * x1 * x1)
