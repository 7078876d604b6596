"""Errors with and without the numbers that a condition withholds: against the conditional variances
of jointly Gaussian states and outputs, and against the truth solver."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from pinnobs_gym.envs.game import Game
from pinnobs_gym.scoring.identifiability import MOST_FREE, identifiability
from pinnobs_gym.scoring.sensitivity import linearised
from pinnobs_gym.simulation.conditions import parse_condition
from pinnobs_gym.simulation.conditions.plant import OtherRates
from pinnobs_gym.simulation.system import Setup, System, independent, stack
from pinnobs_gym.simulation.truth import truth
from pinnobs_gym.systems.harmonic_oscillator import HarmonicOscillator
from pinnobs_gym.systems.induction_motor import InductionMotor
from pinnobs_gym.systems.satellite import Satellite

RATE, DT, NOISE, STD0 = 1.5, 0.1, 0.2, 0.7


@dataclass(frozen=True)
class Drift(System):
    """A position that increases at a constant rate and is measured."""

    rate: float = RATE
    state_names = ("x1",)
    output_names = ("y1",)
    scale = (2.0,)
    setups = {
        "benchmark": Setup(
            (-1.0,),
            (1.0,),
            duration=4.0,
            dt=DT,
            noise_std=NOISE,
            xhat0=(0.0,),
            P0=independent(STD0),
        )
    }

    def f(self, t, x, u):
        return stack(x, self.rate + 0.0 * x[..., 0])

    def h(self, t, x, u):
        return x

    def f_jacobian(self, t, x, u):
        return np.zeros((*x.shape, 1))

    def h_jacobian(self, t, x, u):
        return np.ones((*x.shape, 1))


def gaussian_rms(by_unknown, late, step_std, missing):
    """Root mean square of the position's standard deviation given all outputs so far, over the
    samples after 1 s and the episodes, by conditioning the joint Gaussian of all positions and
    outputs.

    by_unknown: standard deviation of the relative error of the rate. late: that of the delay in s.
    step_std: that of the process noise. missing: outputs, bool (num_samples, batch).
    """
    t = DT * np.arange(len(missing))
    k = np.arange(len(t))
    x = STD0**2 + (RATE * by_unknown) ** 2 * np.outer(t, t) + step_std**2 * np.minimum.outer(k, k)
    y = x + (RATE * late) ** 2 + NOISE**2 * np.eye(len(t))
    variances = []
    for row in missing.T:
        for i in k[t > 1]:
            seen = k[: i + 1][~row[: i + 1]]
            gain = np.linalg.solve(y[np.ix_(seen, seen)], x[seen, i])
            variances.append(x[i, i] - x[i, seen] @ gain)
    return np.sqrt(np.mean(variances))


def nominal_rms(by_unknown, late, step_std, missing):
    """The same of the Kalman filter that knows of neither error, from the weight of each random
    number in its error."""
    variances = []
    for row in missing.T:
        P, count = STD0**2, len(row)
        # Weights of x₀, the rate's error, the delay, each output's noise and each step's.
        start, rate, delay, noise, steps = 1.0, 0.0, 0.0, np.zeros(count), np.zeros(count)
        for k in range(count):
            if k:
                P += step_std**2
                rate += DT
                steps[k] = 1.0
            K = 0.0 if row[k] else P / (P + NOISE**2)
            P *= 1 - K
            start, rate, noise, steps = (v * (1 - K) for v in (start, rate, noise, steps))
            # A late output is RATE times the delay too small, which moves the estimate down.
            noise[k], delay = -K, delay * (1 - K) + K * RATE
            if DT * k > 1:
                sources = (RATE * by_unknown * rate) ** 2 + (late * delay) ** 2
                sources += (STD0 * start) ** 2 + NOISE**2 * noise @ noise
                variances.append(sources + step_std**2 * steps @ steps)
    return np.sqrt(np.mean(variances))


@pytest.mark.parametrize(
    ("condition", "by_unknown", "late", "step_std"),
    [
        ("mismatch10", 0.1, 0.0, 0.0),
        ("mismatch30", 0.3, 0.0, 0.0),
        ("delay2", 0.0, 2 * DT, 0.0),
        ("mismatch10+delay5", 0.1, 5 * DT, 0.0),
        ("mismatch10+process_noise1e-2", 0.1, 0.0, 0.02),
        ("mismatch30+delay1+dropout30", 0.3, DT, 0.0),
    ],
)
def test_on_a_linear_system_it_is_that_of_conditional_variances(
    condition, by_unknown, late, step_std
):
    missing = np.zeros((40, 1), dtype=bool)
    if "dropout" in condition:
        missing = np.isnan(Game.of(Drift, condition="dropout30").episodes(range(10)).y[:-1, :, 0])
        assert 0.2 < missing.mean() < 0.4
    free = gaussian_rms(by_unknown, late, step_std, missing)
    known = gaussian_rms(0.0, 0.0, step_std, missing)
    found = identifiability(Game.of(Drift, condition=condition))
    assert found.free_over_known == pytest.approx(free / known, rel=1e-8)
    assert found.free_over_known > 1.05
    nominal = nominal_rms(by_unknown, late, step_std, missing)
    assert found.nominal_over_free == pytest.approx(nominal / free, rel=1e-8)


@pytest.mark.parametrize(
    ("system", "condition"),
    [("Satellite", "mismatch10"), ("InductionMotor", "mismatch30+load_step")],
)
def test_it_is_the_inverse_of_the_information_of_all_outputs(system, condition):
    """S(P₀⁻¹ + ΣJᵀR⁻¹J)⁻¹Sᵀ with the sensitivities S of states and J of outputs to the initial
    state and the unknowns, the errors being scaled and those of unobservable states left out."""
    duration = 0.7 if system == "InductionMotor" else 6.0
    game = Game.of(system, condition=condition, duration=duration)
    source, nx = game.source, game.source.system.nx
    unknowns = source.condition.unknowns(source.system, source.setup)
    episodes = game.nominal.episodes(range(10))
    t, x = source.times[:-1], episodes.x[:-1]
    flow = linearised(source.system, source.noise, t, x, unknowns)
    std0 = np.sqrt(np.diag(source.record(episodes).prior.cov[0]))
    std = np.concatenate([std0, *[each.std for each in unknowns]])
    late, counts = t > source.setup.transient_end + 1e-9, source.system.observable(x)
    errors = {}
    for n in (len(std), nx):
        S = np.repeat(np.diag(std[:n])[None], 10, axis=0)  # in the prior's standard deviations
        information, total = np.eye(n), np.zeros(10)
        for k in range(len(t)):
            if k:
                S = np.moveaxis(flow.F[k - 1, :n, :n], -1, 0) @ S
            J = np.moveaxis(flow.H[k, :, :n], -1, 0) @ S
            information = information + J.swapaxes(1, 2) @ J / source.setup.noise_std**2
            if late[k]:
                P = S @ np.linalg.solve(information, S.swapaxes(1, 2))
                scaled = np.einsum("bii->bi", P)[:, :nx] / np.square(source.system.scale)
                total += (scaled * counts[k]).sum(axis=1)
        errors[n] = np.sqrt(np.mean(total / counts[late].sum(axis=(0, 2))))
    found = identifiability(game).free_over_known
    assert found == pytest.approx(errors[len(std)] / errors[nx], rel=1e-8)


def rates(i, d):
    return OtherRates(HarmonicOscillator(), 1 + d[:, None] * np.eye(3)[i])


def satellite(i, d):
    name = ("a1", "a2", "a3")[i]
    return replace(Satellite(), **{name: getattr(Satellite(), name) * (1 + d)})


def motor(i, d):
    """With another parameter or, last, another torque (N·m) from 0.6 s on."""
    step = {"load_step_time": 0.6, "load_step_torque": 10.0}
    if i == 4:
        return InductionMotor(**{**step, "load_step_torque": 10.0 + d})
    name = ("R_s", "R_r", "J", "T_L")[i]
    return InductionMotor(**{name: getattr(InductionMotor(), name) * (1 + d)}, **step)


@pytest.mark.parametrize(
    ("cls", "plant", "condition", "seconds", "tolerance"),
    [
        (HarmonicOscillator, rates, "mismatch10", 8.0, 1e-5),
        (Satellite, satellite, "mismatch30", 8.0, 1e-5),
        # The model's step spreads the step of the torque over a few tenths of a millisecond.
        (InductionMotor, motor, "mismatch10+load_step", 0.65, 5e-3),
    ],
)
def test_outputs_depend_on_unknowns_as_those_of_the_true_plant(
    cls, plant, condition, seconds, tolerance
):
    """Central differences of the truth solver's outputs, with plants made by hand."""
    system, setup = cls(), replace(cls.setups["benchmark"], duration=seconds)
    unknowns = parse_condition(condition).unknowns(system, setup)
    t, x0 = setup.times, np.array([np.add(setup.x0_low, setup.x0_high)]) / 2 + 0.3
    x = truth(system, x0, t, setup.truth_step)
    flow = linearised(system, system.noise(), t, x, unknowns)
    effects = []
    for i, std in enumerate([s for each in unknowns for s in each.std]):
        d = 1e-3 * std * np.array([1.0, -1.0])
        x = truth(plant(i, d), np.repeat(x0, 2, axis=0), t, setup.truth_step)
        y = system.h(t[:, None], x, system.input(t)[:, None])
        expected = (y[:, 0] - y[:, 1]) / (d[0] - d[1])
        # Sensitivity of the state and the unknowns, from sample to sample.
        sensitivity = np.zeros(flow.F.shape[1])
        sensitivity[system.nx + i] = 1.0
        found = [flow.H[0, ..., 0] @ sensitivity]
        for F, H in zip(flow.F, flow.H[1:], strict=True):
            sensitivity = F[..., 0] @ sensitivity
            found.append(H[..., 0] @ sensitivity)
        effects.append(abs(expected).max())
        np.testing.assert_allclose(found, expected, atol=tolerance * effects[-1] + 1e-9)
    assert min(effects[:2]) > 1e-3
    assert effects[-1] > 1e-3 or plant is rates  # ẋ₃ = 0 at any rate


def test_late_outputs_are_those_of_earlier_states():
    """Central differences of the truth solver's outputs at earlier and later times."""
    system = InductionMotor()
    setup = replace(system.setups["benchmark"], duration=0.2)
    (unknown,) = parse_condition("delay3").unknowns(system, setup)
    assert unknown.std == (3e-3,)
    t, x0, late = setup.times, np.array([[1.0, 2.0, 0.3, -0.2, 90.0]]), 1e-6
    flow = linearised(system, system.noise(), t, truth(system, x0, t), (unknown,))
    earlier, later = (
        truth(system, x0, np.append(0.0, t[1:] + sign * late))[1:, 0, :2] for sign in (-1, 1)
    )
    found = flow.H[1:, :, -1, 0]
    expected = (earlier - later) / (2 * late)
    np.testing.assert_allclose(found, expected, atol=1e-5 * abs(expected).max())
    assert not flow.F[:, : system.nx, -1].any()


@pytest.mark.parametrize(
    ("system", "condition", "seconds", "growth"),
    [
        # Outputs depend on products of x₂ and the rates, which may be off, alone.
        ("HarmonicOscillator", "mismatch10", 20.0, 10.0),
        # Of an autonomous system's output, nobody can tell how late it is.
        ("Satellite", "delay3", 20.0, 10.0),
        # Two outputs determine all states and parameters.
        ("InductionMotor", "mismatch10", 0.7, 1.0),
    ],
)
def test_with_less_noise_only_what_outputs_determine_is_known_better(
    system, condition, seconds, growth
):
    ratio, quiet = (
        identifiability(
            Game.of(system, condition=condition, noise_std=noise, duration=seconds)
        ).free_over_known
        for noise in (
            np.asarray(Game.of(system).source.setup.noise_std) * part for part in (1, 0.1)
        )
    )
    assert quiet / ratio == pytest.approx(growth, rel=0.3)  # the priors tell a little, too
    assert (ratio > MOST_FREE) == (growth > 1)


@pytest.mark.parametrize(
    ("condition", "changes"),
    [
        ("nominal", {}),
        ("noise5+dropout10", {}),
        ("outliers+process_noise1e-3", {}),
        ("noise0+mismatch10", {}),
        ("mismatch10", {"noise_std": 0.0}),
    ],
)
def test_where_it_does_not_apply(condition, changes):
    assert identifiability(Game.of(Drift, condition=condition, **changes)) is None


def test_a_fixed_initial_state_has_none():
    assert identifiability(Game.of("Satellite", "paper", "mismatch10", noise_std=0.1)) is None


def test_games_that_differ_in_a_change_alone_have_ratios_of_their_own():
    games = [
        Game.of("ReverseDuffing", condition="mismatch10", duration=2.0, noise_std=noise)
        for noise in (0.02, 0.04, 0.02)
    ]
    first, other, again = map(identifiability, games)
    assert first == again
    assert first != other


@pytest.mark.parametrize(
    ("system", "condition", "holds"),
    [
        ("Satellite", "mismatch10", False),
        ("HarmonicOscillator", "mismatch30", False),
        ("HarmonicOscillator", "delay1", False),
        ("ReverseDuffing", "delay2", False),
        ("ReverseDuffing", "mismatch10", True),
        ("InductionMotor", "delay5", True),
        ("InductionMotor", "load_step", True),
    ],
)
def test_nothing_is_ranked_where_a_filter_that_ignores_the_change_is_as_good_as_any(
    system, condition, holds
):
    """On ReverseDuffing, filters differ manifold under mismatch; the motor's outputs tell all."""
    assert identifiability(Game.of(system, condition=condition)).holds == holds
