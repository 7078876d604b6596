"""Right and wrong logs of several plants: a small version of `log_figures.judgement`."""

import numpy as np
import pytest
from benchmarks.plants.battery import Battery
from benchmarks.plants.radar import Radar
from log_figures.changes import (
    late,
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
from log_figures.judged_plants import Cart, DrivenCar, Tank
from log_figures.judgement import DEGREES, judged
from log_figures.recorded import Pendulum

SEEDS = range(2)


@pytest.mark.parametrize("cls", [Cart, DrivenCar, Tank, Radar, Pendulum])
@pytest.mark.parametrize("estimator", ["ekf", "ukf"])
def test_right_logs_raise_no_warning(cls, estimator):
    for judgement in judged(right(cls, SEEDS), estimator):
        assert judgement.warnings == ()
        assert 4 <= len(judgement.facts) <= 6


@pytest.mark.parametrize(
    ("cls", "change", "says"),
    [
        (Pendulum, times(0, DEGREES), "theta"),
        (Radar, times(1, DEGREES), "bearing"),
        (Tank, times(1, 0.01), "level2"),
        (DrivenCar, without_input(0, -1.0), "the model does not explain"),
        (Cart, without_input(0, -1.0), "the inputs and their clock"),
        (Tank, swapped, "the model does not explain"),
        (Cart, output_noise(0.1), "the output is noisier than told"),
        (Radar, output_noise(0.1**0.5), "the output is noisier than told"),
        (Cart, output_noise(10.0), "too small for their standard deviations"),
        (DrivenCar, output_noise(10**0.5), "too small for their standard deviations"),
        (DrivenCar, process_noise(0.1), "--process-noise"),
        (Cart, process_noise(10.0), "--process-noise"),
        (Tank, outliers, "these are outliers"),
        (Pendulum, outliers, "these are outliers"),
        (DrivenCar, late(3), "the inputs and their clock"),
        (Cart, without_input(0), "the inputs and their clock"),
        (Tank, without_input(0), "inputs that never change: inflow = 0"),
        (Pendulum, parameters(w2=67.0), "pinnobs fit"),
        (Cart, parameters(friction=0.9), "--process-noise"),
        (Cart, without(slice(0, 1)), "p: the variance never fell"),
    ],
)
def test_wrong_logs_are_told(cls, change, says):
    told = change(right(cls, SEEDS), np.random.default_rng(0))
    for judgement in judged(told):
        assert judgement.warnings
        assert says in "\n".join([*judgement.warnings, *judgement.facts])


def test_the_battery_with_a_table_and_a_late_voltage():
    assert judged(right(Battery, range(1)))[0].warnings == ()
    (found,) = judged(late(5)(right(Battery, range(1)), np.random.default_rng(0)))
    assert "with the input i before" in found.warnings[0]
