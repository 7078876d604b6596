"""Everything discovered conforms, and the checks catch what does not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import pytest
from array_api_compat import array_namespace
from kinds import FEW, untrained
from linear import Linear, Modulated

from pinnobs_gym.estimation.adapters import PerEpisode
from pinnobs_gym.estimation.check_records import short_record, tolerated
from pinnobs_gym.estimation.checks import ESTIMATOR_CHECKS, check_estimator
from pinnobs_gym.estimation.estimator import (
    BaseEstimator,
    Estimates,
    Estimator,
    OfflineEstimator,
    State,
)
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.high_gain import HighGain
from pinnobs_gym.estimators.open_loop import OpenLoop
from pinnobs_gym.simulation.checks import SYSTEM_CHECKS, check_system
from pinnobs_gym.simulation.conformance import CheckFailed
from pinnobs_gym.simulation.noise import SampledLevel
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Setup, System, independent, matrix, stack
from pinnobs_gym.systems import SYSTEMS

ON = ("ReverseDuffing", "HarmonicOscillator", "InductionMotor")
"""Two and three states, and five with inputs and two outputs."""


@pytest.mark.parametrize("check", SYSTEM_CHECKS)
@pytest.mark.parametrize("system", SYSTEMS.classes())
def test_system_conforms(system: str, check: str) -> None:
    SYSTEM_CHECKS[check](SYSTEMS.resolve(system))


@pytest.mark.parametrize("check", ESTIMATOR_CHECKS)
@pytest.mark.parametrize("system", ["ReverseDuffing", "InductionMotor"])
@pytest.mark.parametrize("estimator", untrained())
def test_estimator_conforms(estimator: str, system: str, check: str) -> None:
    made = on(system, estimator)
    if check not in made.exempt_from:
        ESTIMATOR_CHECKS[check](made)


@pytest.mark.parametrize(
    ("estimator", "check"),
    [(name, check) for name in untrained() for check in ESTIMATORS.resolve(name).exempt_from],
)
def test_what_an_estimator_is_exempt_from_it_cannot_pass(estimator: str, check: str) -> None:
    with pytest.raises(CheckFailed, match=f"^{check}: "):
        check_on_all(estimator, check)


def check_on_all(estimator: str, check: str) -> None:
    for system in ON:
        ESTIMATOR_CHECKS[check](on(system, estimator))
    ESTIMATOR_CHECKS[check](ESTIMATORS.resolve(estimator)(Modulated()))


def on(system: str, estimator: str) -> BaseEstimator:
    """An estimator of a system with its benchmark's noise."""
    plant = SYSTEMS.resolve(system)
    cls = ESTIMATORS.resolve(estimator)
    return cls.for_setup(plant(), plant.setups["benchmark"], **FEW.get(estimator, {}))


@dataclass(frozen=True)
class Pendulum(System):
    """A sound system, which the broken ones below change in one thing."""

    damping: float = 0.1

    state_names = ("angle", "rate")
    output_names = ("y1",)
    scale = (1.0, 2.0)
    setups: ClassVar = {
        "benchmark": Setup(
            x0_low=(-1.0, -1.0),
            x0_high=(1.0, 1.0),
            xhat0=(0.5, 0.0),
            P0=independent(1.0, 1.0),
            duration=2.0,
            dt=0.02,
            noise_std=0.01,
        )
    }

    def f(self, t: Any, x: Any, u: Any) -> Any:
        angle, rate = x[..., 0], x[..., 1]
        return stack(x, rate, -array_namespace(x).sin(angle) - self.damping * rate)

    def h(self, t: Any, x: Any, u: Any) -> Any:
        return array_namespace(x).sin(x[..., :1])


@dataclass(frozen=True)
class QuickPendulum(Pendulum):
    """The same, with its Jacobians written out."""

    def f_jacobian(self, t: Any, x: Any, u: Any) -> Any:
        return matrix(x, [[0.0, 1.0], [-np.cos(x[..., 0]), -self.damping]])

    def h_jacobian(self, t: Any, x: Any, u: Any) -> Any:
        return matrix(x, [[np.cos(x[..., 0]), 0.0]])


@dataclass(frozen=True)
class Pushed(QuickPendulum):
    """The same with a force, and two outputs."""

    output_names = ("y1", "y2")
    input_names = ("force",)

    def f(self, t: Any, x: Any, u: Any) -> Any:
        angle, rate = x[..., 0], x[..., 1]
        pull = -array_namespace(x).sin(angle) - self.damping * rate
        return stack(x, rate, pull + u[..., 0])

    def h(self, t: Any, x: Any, u: Any) -> Any:
        return stack(x, array_namespace(x).sin(x[..., 0]), x[..., 1])

    def h_jacobian(self, t: Any, x: Any, u: Any) -> Any:
        return matrix(x, [[np.cos(x[..., 0]), 0.0], [0.0, 1.0]])


@dataclass(frozen=True)
class WrongJacobian(Pendulum):
    def f_jacobian(self, t: Any, x: Any, u: Any) -> Any:
        return matrix(x, [[0.0, 1.0], [-np.cos(x[..., 0]), -1.001 * self.damping]])


@dataclass(frozen=True)
class SlightlyWrongJacobian(Pendulum):
    """The error is within that of central differences, whose size is that of the row."""

    def f_jacobian(self, t: Any, x: Any, u: Any) -> Any:
        damping = self.damping * (1 + 2e-6)
        return matrix(x, [[0.0, 1.0], [-np.cos(x[..., 0]), -damping]])


@dataclass(frozen=True)
class WrongOutputJacobian(Pendulum):
    def h_jacobian(self, t: Any, x: Any, u: Any) -> Any:
        return matrix(x, [[1.0, 0.0]])


@dataclass(frozen=True)
class Shaken(Pendulum):
    """A pendulum of which a sensor that is moved with time, and by an input, tells the angle."""

    input_names = ("u1",)

    def h(self, t: Any, x: Any, u: Any) -> Any:
        return self.gain(t, u) * array_namespace(x).sin(x[..., :1]) + u

    def h_jacobian(self, t: Any, x: Any, u: Any) -> Any:
        gain = self.gain(t, u)[..., 0]
        return matrix(x, [[gain * array_namespace(x).cos(x[..., 0]), 0.0]])

    def gain(self, t: Any, u: Any) -> Any:
        return 1.0 + 0.1 * (t + 0.0 * u[..., 0])[..., None] + 0.2 * u


@dataclass(frozen=True)
class DrivenShaken(Shaken):
    """The same with a known input."""

    def input(self, t: Any) -> Any:
        xp = array_namespace(t)
        return xp.cos(xp.stack([t], axis=-1))


@dataclass(frozen=True)
class BlindToTime(Shaken):
    def h_jacobian(self, t: Any, x: Any, u: Any) -> Any:
        return super().h_jacobian(0.0, x, u)


@dataclass(frozen=True)
class BlindToInput(Shaken):
    def h_jacobian(self, t: Any, x: Any, u: Any) -> Any:
        return super().h_jacobian(t, x, 0.0 * u)


@dataclass(frozen=True)
class BlindToKnownInput(DrivenShaken):
    def h_jacobian(self, t: Any, x: Any, u: Any) -> Any:
        return super().h_jacobian(t, x, 0.0 * u)


@dataclass(frozen=True)
class ArraysOfTimeOnly(Shaken):
    def h(self, t: Any, x: Any, u: Any) -> Any:
        return super().h(t.reshape(t.shape), x, u)


@dataclass(frozen=True)
class Impure(Pendulum):
    calls: ClassVar[list[int]] = []

    def f(self, t: Any, x: Any, u: Any) -> Any:
        self.calls.append(1)
        return super().f(t, x, u) + 1e-9 * len(self.calls)


@dataclass(frozen=True)
class Overwriting(Pendulum):
    def f(self, t: Any, x: Any, u: Any) -> Any:
        rate = super().f(t, x, u)
        x[..., 0] = 0.0
        return rate


@dataclass(frozen=True)
class NumPyOnly(Pendulum):
    def f(self, t: Any, x: Any, u: Any) -> Any:
        return np.stack([x[..., 1], -np.sin(x[..., 0]) - self.damping * x[..., 1]], axis=-1)

    def f_jacobian(self, t: Any, x: Any, u: Any) -> Any:
        return matrix(x, [[0.0, 1.0], [-np.cos(x[..., 0]), -self.damping]])


@dataclass(frozen=True)
class NumPyFunction(Pendulum):
    """np.sin takes a torch tensor without a word, and returns one, unless it needs a gradient."""

    def h(self, t: Any, x: Any, u: Any) -> Any:
        return np.sin(x[..., :1])

    def h_jacobian(self, t: Any, x: Any, u: Any) -> Any:
        return matrix(x, [[np.cos(x[..., 0]), 0.0]])


@dataclass(frozen=True)
class OneRowOnly(Pendulum):
    def f(self, t: Any, x: Any, u: Any) -> Any:
        rate = super().f(t, x, u)
        return rate if x.ndim < 3 else rate[0]

    def f_jacobian(self, t: Any, x: Any, u: Any) -> Any:
        return matrix(x, [[0.0, 1.0], [-np.cos(x[..., 0]), -self.damping]])


@dataclass(frozen=True)
class NoLastAxis(Pendulum):
    def h(self, t: Any, x: Any, u: Any) -> Any:
        return array_namespace(x).sin(x[..., 0])


@dataclass(frozen=True)
class CoupledRows(Pendulum):
    def f(self, t: Any, x: Any, u: Any) -> Any:
        rate = super().f(t, x, u)
        return rate - 1e-9 * x.mean(0) if x.ndim == 2 else rate


@dataclass(frozen=True)
class WrongInvariant(Pendulum):
    def invariants(self, x: Any) -> Any:  # that of the undamped one
        return 1.0 + x[..., 1:] ** 2 / 2 - array_namespace(x).cos(x[..., :1])


@dataclass(frozen=True)
class WrongTwin(Pendulum):
    def indistinguishable(self, x: Any) -> tuple[Any, ...]:
        return (-x,)


@dataclass(frozen=True)
class EmptySet(Pendulum):
    def admissible(self, x0: Any) -> Any:
        return x0[..., 0] > 5.0


@dataclass(frozen=True)
class Explosive(Pendulum):
    def f(self, t: Any, x: Any, u: Any) -> Any:
        return stack(x, 30 * (1 + x[..., 0] ** 2), -x[..., 1])


@dataclass(frozen=True)
class NoScale(Pendulum):
    scale = (1.0, 0.0)


class NotDecorated(Pendulum):
    length: float = 1.0


class WithoutParameters(Pendulum):
    pass


class TwoFaults(WrongJacobian):
    invariants = WrongInvariant.invariants


@pytest.mark.parametrize("cls", [Pendulum, QuickPendulum, Shaken, DrivenShaken, WithoutParameters])
def test_sound_system_passes(cls: type[System]) -> None:
    check_system(cls)


class Distance(Pendulum):
    """Its output has no derivative at zero, which is the mean of its initial set."""

    setups = {"benchmark": replace(Pendulum.setups["benchmark"], xhat0=None, P0=None)}

    def h(self, t: Any, x: Any, u: Any) -> Any:
        xp = array_namespace(x)
        return xp.sqrt(x[..., :1] ** 2 + x[..., 1:] ** 2)


def test_a_prior_mean_without_derivative_is_warned_of() -> None:
    says = r"Distance, setup 'benchmark': h_jacobian is not finite at x̂₀=\[0.0, 0.0\]"
    with pytest.warns(UserWarning, match=says):
        check_system(Distance)  # it fails nothing


@pytest.mark.parametrize(
    ("cls", "check", "says"),
    [
        (WrongJacobian, "f_jacobian", r"entry \[1, 1\] .* central differences"),
        (SlightlyWrongJacobian, "f_jacobian", r"entry \[1, 1\] .* the traced equations"),
        (WrongOutputJacobian, "h_jacobian", r"entry \[0, 0\]"),
        (BlindToTime, "h_jacobian", r"entry \[0, 0\]"),
        (BlindToInput, "h_jacobian", r"entry \[0, 0\]"),
        (BlindToKnownInput, "h_jacobian", r"entry \[0, 0\]"),
        (ArraysOfTimeOnly, "shapes", "AttributeError: 'float' object has no attribute 'reshape'"),
        (Impure, "purity", "f gives another result when called again"),
        (Overwriting, "purity", "f modifies its argument x"),
        (NumPyOnly, "array_api", "f of torch tensors .*array_namespace"),
        (NumPyFunction, "array_api", "h of torch tensors .*array_namespace"),
        (OneRowOnly, "shapes", r"f .* has shape \(3, 2\); expected \(2, 3, 2\)"),
        (NoLastAxis, "shapes", r"h at t .* has shape \(\); expected \(1,\)"),
        (CoupledRows, "rows_independent", "f: a row of a batch and alone differ"),
        (WrongInvariant, "invariants", "invariants .* 'benchmark' differ by"),
        (WrongTwin, "indistinguishable", "outputs of indistinguishable states"),
        (EmptySet, "initial_states", "0 of .* states of the setup's law are admissible"),
        (Explosive, "initial_states", "leaves the finite numbers"),
        (NoScale, "attributes", r"scale=\(1.0, 0.0\); expected a positive"),
        (NotDecorated, "attributes", "expected @dataclass"),
    ],
)
def test_broken_system_fails(cls: type[System], check: str, says: str) -> None:
    with pytest.raises(CheckFailed, match=f"^{check}: .*{says}") as failure:
        SYSTEM_CHECKS[check](cls)
    assert "\n" not in str(failure.value)


def test_failures_are_collected() -> None:
    with pytest.raises(CheckFailed) as failure:
        check_system(TwoFaults)
    names = [line.split(":")[0] for line in str(failure.value).splitlines()]
    assert names == ["f_jacobian", "invariants"]


def test_a_function_that_fails_on_a_batch_is_one_failure() -> None:
    says = (
        r"equations: NoLastAxis\.h \(test_checks\.py, line \d+\) returns shape \(2,\) .* \(2, 1\)"
    )
    with pytest.raises(CheckFailed, match=f"^{says}$"):
        check_system(NoLastAxis)


@dataclass(frozen=True)
class LooksAhead(EKF):
    def run(self, record: Record) -> Estimates:
        ahead = np.concatenate([record.y[:, 1:], record.y[:, -1:]], axis=1)
        return super().run(replace(record, y=ahead))


@dataclass(frozen=True)
class WholeRecordMean(EKF):
    def run(self, record: Record) -> Estimates:
        found = super().run(record)
        return replace(found, xhat=found.xhat + 1e-9 * record.y.mean())


@dataclass(frozen=True)
class Sticky(EKF):
    """Takes a missing sample into its estimate."""

    def correct(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        new = super().correct(state, t, y, u)
        return replace(new, xhat=new.xhat + 0.0 * y.sum(axis=-1, keepdims=True))


@dataclass(frozen=True)
class Coupled(EKF):
    def correct(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        new = super().correct(state, t, y, u)
        return replace(new, xhat=new.xhat + 1e-6 * new.xhat.mean(axis=0))


@dataclass(frozen=True)
class ResetsAll(EKF):
    """One row that diverges takes all others with it."""

    def correct(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        new = super().correct(state, t, y, u)
        far = abs(y).max(initial=0.0, where=np.isfinite(y)) > 1e100 or np.isinf(y).any()
        return replace(new, xhat=np.zeros_like(new.xhat)) if far else new


@dataclass(frozen=True)
class Raises(EKF):
    def correct(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        new = super().correct(state, t, y, u)
        if not (abs(new.xhat) < 1e200).all():
            raise FloatingPointError("diverged")
        return new


@dataclass(frozen=True)
class Random(EKF):
    def reset(self, prior: Prior) -> State:
        state = super().reset(prior)
        return replace(state, xhat=state.xhat + 1e-9 * np.random.default_rng().random())


@dataclass(frozen=True)
class OverwritesOutputs(EKF):
    def correct(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        y[np.isnan(y)] = 0.0
        return super().correct(state, t, y, u)


@dataclass(frozen=True)
class OverwritesPrior(OpenLoop):
    def predict(self, state: State, t: float, u: np.ndarray) -> State:
        new = super().predict(state, t, u)
        state.xhat[...] = new.xhat
        return replace(new, xhat=state.xhat)


@dataclass(frozen=True)
class OverwritesState(OpenLoop):
    def reset(self, prior: Prior) -> State:
        return State(prior.mean.copy())

    def predict(self, state: State, t: float, u: np.ndarray) -> State:
        new = super().predict(state, t, u)
        state.xhat[...] = new.xhat
        return replace(new, xhat=state.xhat)


@dataclass(frozen=True)
class WrongShape(EKF):
    def correct(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        new = super().correct(state, t, y, u)
        return replace(new, S=np.zeros((len(y), 2 * y.shape[-1])))


@dataclass(frozen=True)
class RegularOnly(EKF):
    def correct(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        dt = self.system.setups["benchmark"].dt
        if state.t is not None and abs(t - state.t - dt) > 1e-9:
            raise ValueError("irregular")
        return super().correct(state, t, y, u)


@dataclass(frozen=True)
class AnotherRun(EKF):
    def run(self, record: Record) -> Estimates:
        found = super().run(record)
        return replace(found, xhat=found.xhat * (1 + 1e-6))


@dataclass(frozen=True)
class Forgetful(EKF):
    def save(self, path: Any) -> None:
        path.write_text("")

    @classmethod
    def load(cls, path: Any, system: System) -> Forgetful:
        return cls(system)


@dataclass(frozen=True)
class LosesCovariance(EKF):
    def run(self, record: Record) -> Estimates:
        found = super().run(record)
        return replace(found, P=found.P + 0.0 * record.y.sum(axis=-1)[..., None, None])


@dataclass(frozen=True)
class Standing(OpenLoop):
    """Stays where the prior is, whatever the model says."""

    def predict(self, state: State, t: float, u: np.ndarray) -> State:
        return state


@dataclass(frozen=True)
class Exempt(Standing):
    exempt_from: ClassVar = {"model_alone": "it has no model"}


@dataclass(frozen=True)
class ExemptFromNothing(EKF):
    exempt_from: ClassVar = {"modell_alone": "it has no model"}


@dataclass(frozen=True)
class ExemptWithoutReason(EKF):
    exempt_from: ClassVar = {"model_alone": " "}


@dataclass(frozen=True)
class ExemptFromSayingSo(EKF):
    exempt_from: ClassVar = {"exemptions": "it is free"}


@dataclass(frozen=True)
class ExemptByNone(EKF):
    exempt_from: Any = None


@dataclass(frozen=True)
class ExemptByList(EKF):
    exempt_from: ClassVar[Any] = ["model_alone"]


@dataclass(frozen=True)
class ExemptByWord(EKF):
    exempt_from: ClassVar[Any] = "model_alone"


@dataclass(frozen=True)
class SavesOnly(EKF):
    def save(self, path: Any) -> None:
        path.write_text("")


@dataclass(frozen=True)
class LoadsOnly(EKF):
    @classmethod
    def load(cls, path: Any, system: System) -> LoadsOnly:
        return cls(system)


@dataclass(frozen=True)
class TrainedUnsaved(EKF):
    needs_training = "pinn_gain"


@dataclass(frozen=True)
class CountsRows(EKF):
    """Its covariance grows with each row."""

    def predict(self, state: State, t: float, u: np.ndarray) -> State:
        new = super().predict(state, t, u)
        return replace(new, P=1.001 * np.asarray(new.P))


@dataclass(frozen=True)
class HiddenConstant(EKF):
    """A little is added to variances, in one unit."""

    def predict(self, state: State, t: float, u: np.ndarray) -> State:
        new = super().predict(state, t, u)
        return replace(new, P=np.asarray(new.P) + 1e-14 * np.eye(self.system.nx))


@dataclass(frozen=True)
class DiagonalNoise(EKF):
    """It uses the standard deviations alone."""

    def run(self, record: Record) -> Estimates:
        std = np.sqrt(np.diag(self.noise.R(0.0)[..., 0]))
        return EKF(self.system, std.tolist()).run(record)


@dataclass(frozen=True)
class CommonNoise(EKF):
    """It takes the usual noise for that of each sample."""

    def run(self, record: Record) -> Estimates:
        level: Any = self.noise_std
        if isinstance(level, SampledLevel):
            level = np.median(level.std, axis=(0, 1)).tolist()
        return EKF(self.system, level).run(replace(record, noise_std=None))


@dataclass(frozen=True)
class LaterInput(EKF):
    """It holds the input of the second of two samples between them."""

    def predict(self, state: State, t: float, u: np.ndarray) -> State:
        return super().predict(replace(state, u=u), t, u)


@dataclass(frozen=True)
class AlwaysHolds(EKF):
    """It holds inputs whatever the plant says."""

    def predict(self, state: State, t: float, u: np.ndarray) -> State:
        assert state.u is not None
        return super().predict(state, t, state.u)


class Mutable(EKF):
    pass


@dataclass(frozen=True)
class Offline(OfflineEstimator):
    """A sound one: the first output as the estimate of all states."""

    exempt_from: ClassVar = {
        **OfflineEstimator.exempt_from,
        "units": "it takes an output for a state",
    }

    def run(self, record: Record) -> Estimates:
        nx = self.system.nx
        return Estimates(np.repeat(np.nan_to_num(record.y[..., :1]), nx, axis=-1))


@dataclass(frozen=True)
class TimeInSeconds(Offline):
    """It settles within a second, whatever the plant."""

    exempt_from: ClassVar = OfflineEstimator.exempt_from

    def run(self, record: Record) -> Estimates:
        scale = np.asarray(self.system.scale)
        return Estimates(
            scale * (1 - np.exp(-record.t))[:, None] + 0 * np.nan_to_num(record.y[..., :1])
        )


@dataclass(frozen=True)
class OfflineCoupled(Offline):
    def run(self, record: Record) -> Estimates:
        return Estimates(super().run(record).xhat - record.y.mean())


class CopiesOutput:
    """A sound single-episode object."""

    def __init__(self) -> None:
        self._xhat = np.zeros(2)

    def reset(self, xhat0: np.ndarray, P0: np.ndarray) -> None:
        self._xhat = xhat0

    def update(self, t: float, y: np.ndarray, u: np.ndarray) -> np.ndarray:
        if np.isfinite(y[0]):
            self._xhat = np.array([y[0], self._xhat[1]])
        return self._xhat


class Remembers(CopiesOutput):
    """One whose episodes share what should be its own."""

    shared = np.zeros(2)

    def update(self, t: float, y: np.ndarray, u: np.ndarray) -> np.ndarray:
        self.shared[:] += np.nan_to_num(y[0])
        return super().update(t, y, u) + 1e-6 * self.shared


@pytest.mark.parametrize(
    "make",
    [EKF, OpenLoop, Offline, Exempt, lambda system: PerEpisode(system, make=CopiesOutput)],
    ids=["ekf", "open_loop", "offline", "exempt", "per_episode"],
)
def test_sound_estimator_passes(make: Callable[[System], Estimator]) -> None:
    check_estimator(make(QuickPendulum()))


@pytest.mark.parametrize(
    ("make", "check", "says"),
    [
        (LooksAhead, "causality", "the estimate at sample 0 changes with outputs from sample 1 on"),
        (WholeRecordMean, "causality", "the estimate at sample 0 changes"),
        (Sticky, "missing_samples", "at sample 0 of row 0 not finite"),
        (LosesCovariance, "missing_samples", "make the covariance at sample .* not finite"),
        (
            Standing,
            "model_alone",
            "the estimate at sample 1 and the model's state from x̂₀ differ",
        ),
        (ExemptFromNothing, "exemptions", "exempt_from names 'modell_alone'; known are immutable,"),
        (ExemptWithoutReason, "exemptions", r"exempt_from\['model_alone'\]=' '; expected a reason"),
        (
            ExemptFromSayingSo,
            "exemptions",
            "exempt_from names 'exemptions'; known are immutable, s",
        ),
        (ExemptByNone, "exemptions", "exempt_from=None; expected a mapping from names of checks"),
        (ExemptByList, "exemptions", r"exempt_from=\['model_alone'\]; expected a mapping"),
        (ExemptByWord, "exemptions", "exempt_from='model_alone'; expected a mapping"),
        (SavesOnly, "save_load", "SavesOnly has no load; expected save and load, or neither"),
        (LoadsOnly, "save_load", "LoadsOnly has no save; expected save and load, or neither"),
        (
            TrainedUnsaved,
            "save_load",
            "TrainedUnsaved has no save and no load; expected save and load, since it needs",
        ),
        (Coupled, "rows_independent", "row 0 in a batch and alone differ"),
        (ResetsAll, "diverging_row", "other rows with and without outputs of 1e\\+300"),
        (Raises, "diverging_row", "FloatingPointError: diverged"),
        (Random, "purity", "a second run and the first differ"),
        (OverwritesOutputs, "purity", "update modifies its argument y"),
        (OverwritesPrior, "purity", "run modifies mean of the record"),
        (OverwritesState, "purity", "xhat of state 0 is modified"),
        (WrongShape, "shapes", r"returned S of shape \(3, 2\); expected \(batch, ny, ny\)=\(3,"),
        (RegularOnly, "irregular_times", "ValueError: irregular"),
        (AnotherRun, "run_equals_updates", "xhat of run and of looped updates differ"),
        (
            lambda system: Forgetful(system, noise_std=3.0),
            "save_load",
            "a loaded estimator and the one saved",
        ),
        (Mutable, "immutable", "expected @dataclass"),
        (OfflineCoupled, "rows_independent", "row 0 in a batch and alone"),
        (lambda system: PerEpisode(system, make=Remembers), "purity", "a second run and the first"),
    ],
)
def test_broken_estimator_fails(make: Callable[[System], Estimator], check: str, says: str) -> None:
    estimator = make(QuickPendulum())
    with pytest.raises(CheckFailed, match=f"^{check}: .*{says}") as failure:
        ESTIMATOR_CHECKS[check](estimator)
    assert "\n" not in str(failure.value)


@pytest.mark.parametrize(
    ("cls", "check"),
    [(Sticky, "missing_samples"), (Raises, "diverging_row"), (WrongShape, "shapes")],
)
def test_one_that_fails_several_checks_is_told_of_each(cls: type[EKF], check: str) -> None:
    with pytest.raises(CheckFailed, match=rf"(?m)^{check}: "):
        check_estimator(cls(QuickPendulum()))


@pytest.mark.parametrize(
    ("make", "check", "says"),
    [
        (CountsRows, "blank_rows", "estimates with 3 rows without outputs between any two samp"),
        (HiddenConstant, "units", "estimates in units that make states 9e-10, outputs 1e\\+09 and"),
        (TimeInSeconds, "units", "estimates in units that make states 1e\\+09, outputs 9e-10 and"),
        (DiagonalNoise, "noise_matrix", "estimates are the same for output noise with a correla"),
        (CommonNoise, "sampled_noise", "estimates with y1 at sample 5 told to have 1e\\+06 times"),
        (LaterInput, "held_input", "depends on the input at the second of the two samples, by"),
        (AlwaysHolds, "held_input", "does not depend on the input at the second of the two sam"),
    ],
)
def test_what_takes_a_plant_for_another_is_found(
    make: Callable[[System], BaseEstimator], check: str, says: str
) -> None:
    estimator = make(Pushed())
    with pytest.raises(CheckFailed, match=f"^{check}: .*{says}") as failure:
        check_estimator(estimator)
    assert "\n" not in str(failure.value)  # no other check fails


@pytest.mark.parametrize("name", untrained())
def test_estimators_of_a_plant_with_an_input_and_two_outputs_conform(name: str) -> None:
    check_estimator(ESTIMATORS.resolve(name)(Pushed(), **FEW.get(name, {})))


def test_a_check_by_name_knows_of_no_exemption() -> None:
    with pytest.raises(CheckFailed, match=r"^model_alone: "):
        ESTIMATOR_CHECKS["model_alone"](Exempt(QuickPendulum()))


def test_checking_registers_nothing() -> None:
    check_system(QuickPendulum)
    check_estimator(EKF(QuickPendulum()))
    assert not {"Pendulum", "QuickPendulum"} & set(SYSTEMS.classes())


@dataclass(frozen=True)
class NoState(Estimator):
    """Returns an array where a state is expected."""

    def reset(self, prior: Prior) -> Any:
        return prior.mean

    def update(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        return state


def test_what_is_no_state_is_told_of_the_method_that_returned_it() -> None:
    system = QuickPendulum()
    prior = Prior.of(system, system.setups["benchmark"], 1)
    record = Record(np.zeros(1), np.zeros((1, 1, system.ny)), np.zeros((1, 1, system.nu)), prior)
    with pytest.raises(TypeError, match=r"NoState\.reset returned ndarray; expected a State"):
        NoState(system).run(record)
    with pytest.raises(TypeError, match="is not an instance of an Estimator"):
        check_estimator(NoState)  # pyright: ignore


@dataclass(frozen=True)
class Saddle(Linear):
    """An unstable plant, on which errors grow by e¹² in a record."""

    def f(self, t, x, u):
        return 3.0 * x

    def f_jacobian(self, t, x, u):
        return 3.0 * np.eye(2) + np.zeros((*x.shape, 1))


def test_observers_that_amplify_rounding_are_given_more_room():
    """Where nothing corrects the model, a change of 1e-9 of scale grows by e^(3·3.9)."""
    estimator = OpenLoop(Saddle())
    record = short_record(estimator)
    grown = 10 * 1e-9 * np.exp(3 * 3.9)
    assert tolerated(estimator.run, Saddle(), record, 1e-6) == pytest.approx(grown, rel=1e-2)
    assert tolerated(EKF(Linear()).run, Linear(), short_record(EKF(Linear())), 1e-6) == 1e-6


@pytest.mark.parametrize("process_noise", [None, 0.3, ((0.0, 0.0), (0.2, 0.5))])
def test_high_gain_forgets_the_same_with_blank_rows_and_without(process_noise):
    ESTIMATOR_CHECKS["blank_rows"](HighGain(Linear(), process_noise=process_noise))
