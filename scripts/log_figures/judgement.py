"""Right logs and wrong ones, and whether the judgement of a log tells them apart."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from benchmarks import Figure, at_least, at_most
from benchmarks.plants.battery import Battery
from benchmarks.plants.radar import Radar

from log_figures.changes import (
    SEEDS,
    Change,
    Told,
    late,
    model,
    other_state,
    outliers,
    output_noise,
    parameters,
    process_noise,
    right,
    swapped,
    times,
    without,
    without_input,
)
from log_figures.judged_plants import Cart, DrivenCar, Swing, Tank
from log_figures.recorded import Pendulum
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimation.estimator import Estimates
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.logs.judgement import Judgement, judge
from pinnobs_gym.simulation.system import System
from pinnobs_gym.systems.academic import Academic
from pinnobs_gym.systems.harmonic_oscillator import HarmonicOscillator
from pinnobs_gym.systems.induction_motor import InductionMotor
from pinnobs_gym.systems.modified_academic import ModifiedAcademic
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing
from pinnobs_gym.systems.satellite import Satellite


def judged(told: Told, estimator: str = "ekf") -> list[Judgement]:
    """Return the judgement of each log."""
    made = ESTIMATORS.resolve(estimator).for_setup(told.system, told.setup).run(told.record)
    found = []
    for row in range(told.record.batch):
        rows = slice(row, row + 1)
        arrays = {name: value[rows] for name, value in vars(made).items() if value is not None}
        own = Estimates(**arrays)
        found.append(judge(told.system, told.setup, told.record.rows(rows), own))
    return found


RIGHT = (
    Cart,
    Tank,
    DrivenCar,
    Battery,
    Radar,
    Pendulum,
    ReverseDuffing,
    HarmonicOscillator,
    Academic,
    ModifiedAcademic,
    Satellite,
    InductionMotor,
)
"""Plants of which right logs are judged."""
DEGREES = 180 / np.pi
WRONG: dict[str, tuple[tuple[str, type[System], Change], ...]] = {
    "unit": (
        ("degrees for radians", Pendulum, times(0, DEGREES)),
        ("radians for degrees", Pendulum, times(0, 1 / DEGREES)),
        ("bearing in degrees", Radar, times(1, DEGREES)),
        ("mV for V", Battery, times(0, 1e3)),
        ("V for mV", Battery, times(0, 1e-3)),
        ("mA for A", Battery, without_input(0, 1e3)),
        ("cm for m", Tank, times(1, 100.0)),
        ("km/h for m/s", DrivenCar, times(2, 3.6)),
    ),
    "sign": (
        ("current", Battery, without_input(0, -1.0)),
        ("turn", DrivenCar, without_input(0, -1.0)),
        ("range", Radar, times(0, -1.0)),
        ("force", Cart, without_input(0, -1.0)),
        ("speed", Cart, times(1, -1.0)),
        ("one current of the motor", InductionMotor, times(0, -1.0)),
    ),
    "wrong sensor": (
        ("columns swapped, radar", Radar, swapped),
        ("columns swapped, tanks", Tank, swapped),
        ("columns swapped, cart", Cart, swapped),
        ("north for east", DrivenCar, swapped),
        ("columns swapped, motor", InductionMotor, swapped),
        ("x2 for x1", ReverseDuffing, other_state(1)),
        ("x3 for x1", Satellite, other_state(2)),
        ("x2 for x1, modified", ModifiedAcademic, other_state(1)),
    ),
    "R told too small": tuple(
        (f"{what}, {cls.__name__}", cls, output_noise(factor))
        for cls in (Cart, Battery, Radar, ReverseDuffing, Satellite, Tank)
        for what, factor in (("std / 10", 0.1), ("variance / 10", 0.1**0.5))
    ),
    "R told too large": tuple(
        (f"{what}, {cls.__name__}", cls, output_noise(factor))
        for cls in (Cart, Battery, Radar, ReverseDuffing, Satellite, Tank)
        for what, factor in (("std x 10", 10.0), ("variance x 10", 10.0**0.5))
    ),
    "Q told too small": tuple(
        (f"{what}, {cls.__name__}", cls, process_noise(factor))
        for cls in (Cart, Radar, DrivenCar, Tank)
        for what, factor in (("std / 10", 0.1), ("variance / 10", 0.1**0.5))
    ),
    "Q told too large": tuple(
        (f"{what}, {cls.__name__}", cls, process_noise(factor))
        for cls in (Cart, Radar, DrivenCar, Tank)
        for what, factor in (("std x 10", 10.0), ("variance x 10", 10.0**0.5))
    ),
    "outliers": tuple(
        (cls.__name__, cls, outliers)
        for cls in (Cart, Battery, Radar, ReverseDuffing, Pendulum, InductionMotor, DrivenCar)
    ),
    "late clock": (
        ("voltage, 5 s", Battery, late(5)),
        ("all outputs, 3 samples", DrivenCar, late(3)),
        ("speed, 3 samples", DrivenCar, late(3, slice(2, 3))),
        ("bearing, 3 samples", Radar, late(3, slice(1, 2))),
        ("5 ms, motor", InductionMotor, late(5)),
        ("5 s, tanks", Tank, late(5)),
        ("0.3 s, cart", Cart, late(3)),
    ),
    "missing input": (
        ("current", Battery, without_input(0)),
        ("gyroscope", DrivenCar, without_input(0)),
        ("accelerometer", DrivenCar, without_input(1)),
        ("force", Cart, without_input(0)),
        ("inflow", Tank, without_input(0)),
        ("voltage", InductionMotor, without_input(1)),
    ),
    "wrong plant": (
        ("frequency 3 % off", Pendulum, parameters(w2=66.15)),
        ("linear for a sine", Pendulum, model(Swing)),
        ("R0 three times", Battery, parameters(R0=0.06)),
        ("drain 30 % off", Tank, parameters(drain=0.26)),
        ("friction three times", Cart, parameters(friction=0.9)),
        ("stator resistance 30 % off", InductionMotor, parameters(R_s=0.234)),
        ("modified for academic", Academic, model(ModifiedAcademic)),
        ("oscillator for Duffing", ReverseDuffing, model(HarmonicOscillator)),
    ),
    "state not seen": (
        ("position, from speed", Cart, without(slice(0, 1))),
        ("position, from speed", DrivenCar, without(slice(0, 2))),
    ),
}
"""What is told wrongly, by kind: name, plant and change."""


def wrong(cls: type[System], change: Change) -> Told:
    """Return wrong logs of a plant."""
    told = change(right(cls), np.random.default_rng(1))
    if told.system.nx != right(cls).system.nx:  # another model has another prior
        system, setup = type(told.system).configured()
        source = EpisodeSource(type(told.system))
        empty = source.record(source.play(source.draw(source.streams(SEEDS))))
        record = replace(told.record, prior=empty.prior)
        return replace(told, system=system, setup=setup, record=record)
    return told


def lost(told: Told, estimator: str = "ekf") -> list[bool]:
    """Return of each right log whether the filter is wrong by more than its covariances say: more
    than 1 % of its errors after the first tenth are beyond the 99.99 % ellipsoid. A warning is then
    no false alarm, though the log is right."""
    from scipy.stats import chi2

    made = ESTIMATORS.resolve(estimator).for_setup(told.system, told.setup).run(told.record)
    assert made.P is not None
    error = told.system.state_residual(told.x, made.xhat)[..., None]
    squares = (error * np.linalg.solve(made.P, error)).sum(axis=(2, 3))
    beyond = squares[:, squares.shape[1] // 10 :] > chi2.ppf(0.9999, told.system.nx)
    return (beyond.mean(axis=1) > 0.01).tolist()


def figures(repeats: int) -> Iterator[Figure]:
    """Measure how many right logs are blamed, and how many wrong ones are told, by kind.

    Some logs that are called wrong tell so little that they may stay untold: of a radar's 120
    samples, or where noise that is told too large does not change estimates. These kinds have no
    bound, as their figures depend on the plants.
    """
    for estimator in ("ekf", "ukf"):
        blamed, off = [], []
        for cls in RIGHT:
            blamed += [bool(each.warnings) for each in judged(right(cls), estimator)]
            off += lost(right(cls), estimator)
        false = sum(b and not o for b, o in zip(blamed, off, strict=True))
        true = sum(b and o for b, o in zip(blamed, off, strict=True))
        what = f"right logs of {len(RIGHT)} plants, {estimator}"
        yield at_most(f"{what}: false alarms of {len(off) - sum(off)}", false, "", 0)
        yield Figure(f"{what}: told of {sum(off)} whose filter is lost", true, "", "", None)
        for kind, cases in WRONG.items():
            told = [
                bool(each.warnings)
                for _, cls, change in cases
                for each in judged(wrong(cls, change), estimator)
            ]
            asked = None if kind.startswith("Q told") else 90.0
            label = f"wrong logs, {kind}, {estimator}: told of {len(told)}"
            yield at_least(label, 100 * sum(told) / len(told), "%", asked)
