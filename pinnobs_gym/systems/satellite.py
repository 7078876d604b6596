"""The free rotation of a satellite."""

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
class Satellite(System):
    """Euler's equations of a torque-free rigid body with one measured angular velocity.

    Equations (Farkane et al., PINN-Obs, "Applications"): ẋ₁ = a₁x₂x₃, ẋ₂ = a₂x₁x₃, ẋ₃ = a₃x₁x₂, y =
    x₁, where for principal moments of inertia I: a₁ = (I₂ − I₃)/I₁, a₂ = (I₃ − I₁)/I₂, a₃ = (I₁ −
    I₂)/I₃. The defaults are those of I = (1, 0.8, 0.3) kg·m²; see `from_inertia`.

    Invariants: a₂x₁² − a₁x₂² and a₃x₁² − a₁x₃².

    Observability: (x₂, x₃) and −(x₂, x₃) give the same output at all times. The benchmark samples
    only x₃ > 0, on polhodes about the minor axis where x₃ keeps its sign, so that the prior
    determines it; scores are also reported modulo that sign. With x₁ = 0 and x₂x₃ = 0 the output
    stays zero.

    The ``paper`` setup uses a = (1, −1, 1) from the authors' public code, which no rigid body has.
    ``measure_x3=True`` adds the second output of that code, which the paper does not mention.
    """

    a1: float = 0.5
    """(I₂ − I₃)/I₁."""
    a2: float = -0.875
    """(I₃ − I₁)/I₂."""
    a3: float = 2 / 3
    """(I₁ − I₂)/I₃."""
    measure_x3: bool = False
    """Whether x₃ is measured as well."""

    state_names = ("x1", "x2", "x3")
    units = {"x1": "rad/s", "x2": "rad/s", "x3": "rad/s", "y1": "rad/s", "y3": "rad/s"}
    scale = (0.9, 1.3, 2.2)
    state_bound = (2.5, 3.3, 3.5)
    reward_threshold = -1.75
    setups = {
        "benchmark": Setup(
            x0_low=(-2.0, -2.0, 1.0),
            x0_high=(2.0, 2.0, 3.0),
            xhat0=(0.0, 0.0, 2.158),
            P0=((0.9609, 0.0, 0.0), (0.0, 1.389, 0.0), (0.0, 0.0, 0.2988)),
            transient=3.08,
            poor_prior=PoorPrior((1.0, 1.0, 2.0), independent(1.5, 1.5, 1.0)),
            duration=20.0,
            dt=0.02,
            noise_std=0.02,
            truth_step=0.08,
        ),
        "paper": Setup(
            x0_low=(2.0, -1.0, 3.0),
            x0_high=(2.0, -1.0, 3.0),
            xhat0=(1.0, 1.0, 2.0),
            P0=independent(1.5, 1.5, 1.0),
            duration=20.0,
            dt=2e-3,
            truth_step=0.05,
            parameters={"a1": 1.0, "a2": -1.0, "a3": 1.0},
        ),
    }

    @property
    def output_names(self) -> tuple[str, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """y₁ = x₁, and y₃ = x₃ if that is measured."""
        return ("y1", "y3") if self.measure_x3 else ("y1",)

    @classmethod
    def from_inertia(cls, I1: float, I2: float, I3: float) -> Satellite:
        """Return the body with principal moments of inertia I1, I2, I3 in kg·m²."""
        return cls(a1=(I2 - I3) / I1, a2=(I3 - I1) / I2, a3=(I1 - I2) / I3)

    def f(self, t: Array, x: Array, u: Array) -> Array:
        x1, x2, x3 = x[..., 0], x[..., 1], x[..., 2]
        return stack(x, self.a1 * x2 * x3, self.a2 * x1 * x3, self.a3 * x1 * x2)

    def h(self, t: Array, x: Array, u: Array) -> Array:
        return x[..., ::2] if self.measure_x3 else x[..., :1]

    def f_jacobian(self, t: Array, x: Array, u: Array) -> Array:
        x1, x2, x3 = x[..., 0], x[..., 1], x[..., 2]
        a1, a2, a3 = self.a1, self.a2, self.a3
        rows = [[0.0, a1 * x3, a1 * x2], [a2 * x3, 0.0, a2 * x1], [a3 * x2, a3 * x1, 0.0]]
        return matrix(x, rows)

    def h_jacobian(self, t: Array, x: Array, u: Array) -> Array:
        rows = [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
        return matrix(x, rows if self.measure_x3 else rows[:1])

    def admissible(self, x0: Array) -> Array:
        """Polhodes about the minor axis, away from it: a₃x₁² < 0.8·a₁x₃² (for a body,
        I₁(I₁ − I₂)x₁² < 0.8·I₃(I₂ − I₃)x₃²) and abs x₁ + abs x₂ > 0.5."""
        x1, x2, x3 = x0[..., 0], x0[..., 1], x0[..., 2]
        inside = self.a3 * x1 * x1 < 0.8 * self.a1 * x3 * x3
        return inside & (abs(x1) + abs(x2) > 0.5)

    def invariants(self, x: Array) -> Array:
        squares = x * x
        s1, s2, s3 = squares[..., 0], squares[..., 1], squares[..., 2]
        return stack(x, self.a2 * s1 - self.a1 * s2, self.a3 * s1 - self.a1 * s3)

    def indistinguishable(self, x: Array) -> tuple[Array, ...]:
        if self.measure_x3:
            return ()
        return (stack(x, x[..., 0], -x[..., 1], -x[..., 2]),)
