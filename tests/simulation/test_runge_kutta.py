"""The step of model-based estimators, against the error of the method in closed form."""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import pytest
from array_api_compat import array_namespace

from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.simulation.checks import SYSTEM_CHECKS
from pinnobs_gym.simulation.model import model_step
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.runge_kutta import STEP_TOLERANCE, longest_step
from pinnobs_gym.simulation.system import Setup, System, independent, stack
from pinnobs_gym.systems import SYSTEMS

DT = 0.1


@dataclass(frozen=True)
class Oscillator(System):
    """An oscillator from amplitude one, in units in which it moves on a circle."""

    omega: float = 1.0

    state_names = ("x1", "x2")
    output_names = ("y1",)
    scale = (1.0, 1.0)
    setups: ClassVar = {
        "benchmark": Setup(
            (1.0, 0.0),
            (1.0, 0.0),
            duration=30.0,
            dt=DT,
            noise_std=0.05,
            xhat0=(1.0, 0.0),
            P0=independent(0.3, 0.3),
        )
    }

    def f(self, t: Any, x: Any, u: Any) -> Any:
        return stack(x, self.omega * x[..., 1], -self.omega * x[..., 0])

    def h(self, t: Any, x: Any, u: Any) -> Any:
        return x[..., :1]

    def f_jacobian(self, t: Any, x: Any, u: Any) -> Any:
        return np.broadcast_to([[0.0, self.omega], [-self.omega, 0.0]], (*x.shape, 2))

    def h_jacobian(self, t: Any, x: Any, u: Any) -> Any:
        return np.broadcast_to([[1.0, 0.0]], (*x.shape[:-1], 1, 2))


def error_of_a_step(z: complex) -> float:
    """What the method of order 4 makes of exp(z), less exp(z)."""
    return abs(1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24 - np.exp(z))


@pytest.mark.parametrize("angle", [0.05, 0.2, 0.55, 1.1, 2.2, 7.0])
def test_the_longest_step_has_the_error_that_is_allowed(angle: float) -> None:
    """An oscillator that turns by an angle (rad) in a sample; its states are on the unit circle."""
    step = longest_step(Oscillator(angle / DT))
    assert error_of_a_step(1j * angle * step / DT) < 1.02 * STEP_TOLERANCE
    halvings = np.log2(DT / step)
    assert halvings == round(halvings)
    if halvings:
        assert error_of_a_step(2j * angle * step / DT) > 0.95 * STEP_TOLERANCE


@pytest.mark.parametrize("name", list(SYSTEMS.classes()))
def test_the_systems_of_the_package_take_one_step_per_sample_or_their_own(name: str) -> None:
    cls = SYSTEMS.classes()[name]
    for setup in cls.setups:
        system, _ = cls.configured(setup)
        assert longest_step(system) == {"InductionMotor": 5e-4}.get(name, 0.02)


@pytest.mark.parametrize("samples", [12, 6, 3])
def test_an_oscillator_of_few_samples_a_period(samples: int) -> None:
    """The filter's errors are of the size that it claims, as on the exact model."""
    omega = 2 * np.pi / samples / DT
    system, setup = Oscillator(omega), Oscillator.setups["benchmark"]
    t = np.arange(300) * DT
    x = np.stack([np.cos(omega * t), -np.sin(omega * t)], axis=-1)
    batch = 40
    noise = 0.05 * np.random.default_rng(0).standard_normal((batch, len(t), 1))
    record = Record(
        t, x[:, :1] + noise, np.zeros((batch, len(t), 0)), Prior.of(system, setup, batch)
    )
    found = EKF.for_setup(system, setup, assumed_noise=0.0).run(record)
    assert found.P is not None
    variances = np.diagonal(found.P, axis1=-2, axis2=-1)[:, 150:]
    assert np.mean((found.xhat - x)[:, 150:] ** 2 / variances) == pytest.approx(1.0, abs=0.25)


class Coarse(Oscillator):
    model_step = 0.05


class Friction(Oscillator):
    """A block that Coulomb friction brings to rest."""

    def f(self, t: Any, x: Any, u: Any) -> Any:
        return stack(x, x[..., 1], -array_namespace(x).sign(x[..., 1]))


class Undefined(Oscillator):
    def f(self, t: Any, x: Any, u: Any) -> Any:
        return array_namespace(x).sqrt(-1 - x**2)


class Kicked(Oscillator):
    """Its rate jumps at a known time, which no step should be shortened for."""

    def f(self, t: Any, x: Any, u: Any) -> Any:
        return x * 0 + 5.0 * (t > 1.03)[..., None]

    def breakpoints(self) -> tuple[float, ...]:
        return (1.03,)


@dataclass(frozen=True)
class Fast(Oscillator):
    """It cannot be simulated: x₂ is infinite after a hundredth of a second."""

    def f(self, t: Any, x: Any, u: Any) -> Any:
        return stack(x, self.omega * x[..., 1], 100 * x[..., 0] * (1 + x[..., 1]) ** 2)


@pytest.mark.parametrize(
    ("system", "step"),
    [
        (Coarse(30.0), 0.05),  # its own step is taken as it is
        (Undefined(), DT),
        (Kicked(), DT),
    ],
)
def test_where_there_is_nothing_to_find(system: System, step: float) -> None:
    assert longest_step(system) == step


def test_friction_does_not_ask_for_ever_shorter_steps() -> None:
    assert longest_step(Friction()) >= DT / 16


def test_a_plant_that_cannot_be_simulated_has_a_step() -> None:
    assert 1e-5 < longest_step(Fast()) < DT / 8


def test_parameters_by_row_do_not_change_the_step() -> None:
    """A batch of plants takes one mesh, that of the benchmark's plant."""
    rows = Oscillator(omega=np.array([1.0, 2.0]))  # pyright: ignore[reportArgumentType]
    assert longest_step(rows) == longest_step(Oscillator())
    ends = model_step(rows, 0.0, DT, np.array([[1.0, 0.0]] * 2))
    assert ends == pytest.approx(
        np.array([[np.cos(w * DT), -np.sin(w * DT)] for w in (1.0, 2.0)]), abs=1e-5
    )


def test_check_system_says_how_many_steps_a_sample_takes() -> None:
    check = SYSTEM_CHECKS["model_step"]
    check(Oscillator)  # nothing to say

    @dataclass(frozen=True)
    class Quick(Oscillator):
        omega: float = 10.0

    with pytest.warns(
        UserWarning, match=r"Quick, setup 'benchmark': a sample of 0\.1 s takes .* of"
    ):
        check(Quick)


def test_check_system_compares_the_model_with_the_truth() -> None:
    """In a step of 1 rad the method is off by 0.0084 of the amplitude, shared by both states."""

    @dataclass(frozen=True)
    class OneStep(Oscillator):
        omega: float = 10.0
        model_step = DT

    with pytest.warns(UserWarning, match=r"\(1 Runge-Kutta step per sample\) is off by") as found:
        SYSTEM_CHECKS["model_step"](OneStep)
    (warning,) = found
    off = float(str(warning.message).split("off by ")[1].split()[0])
    assert off == pytest.approx(error_of_a_step(1j), rel=0.03)


def test_the_duration_does_not_change_the_step() -> None:
    setup = replace(Oscillator.setups["benchmark"], duration=5.0)
    shorter = type("Shorter", (Oscillator,), {"setups": {"benchmark": setup}})
    assert longest_step(shorter(9.0)) == longest_step(Oscillator(9.0))
