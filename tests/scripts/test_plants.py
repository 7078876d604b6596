"""Estimates of plants as people have them, against references that no estimator sees."""

from itertools import islice

import numpy as np
import pytest
from benchmarks.plants import battery
from log_figures import recorded as logs

from pinnobs_gym.simulation.augmented import augmented

needs_logs = pytest.mark.skipif(not logs.LOGS.exists(), reason="the sensor logs are not here")


@needs_logs
def test_the_frequency_of_the_pendulum_is_that_of_the_datas_authors():
    (off,) = islice(logs.pendulum(), 1)
    assert off.unit == "%"
    assert off.value <= 0.5


@needs_logs
def test_the_car_is_near_the_fixes_that_were_held_out():
    error = logs.off_fixes(*logs.car_run("ekf", until=60.0))
    assert len(error) > 5
    assert np.sqrt(np.mean(error**2)) <= 3.4


@needs_logs
def test_the_attitude_is_that_of_motion_capture():
    error = np.degrees(logs.attitude_error("ekf", np.radians(6)))
    assert np.sqrt(np.nanmean(error**2)) <= 2.0


def test_the_charge_of_a_battery_is_found_with_a_noisy_current():
    """SoC begins at 0.9 and is told as 0.7 ± 0.2; resistance and capacity are unknown."""
    x, record = battery.drives(2)
    system = augmented(battery.Battery(measured_input=True), parameters=battery.UNKNOWN)
    found = battery.found("ukf", system, record)
    error, std = found.xhat[..., 0] - x[..., 0], np.sqrt(found.P[..., 0, 0])
    assert (abs(error) <= 3 * std).mean() >= 0.99
    assert np.sqrt((error[:, battery.SETTLED :] ** 2).mean(axis=1)).max() <= 0.01
    true = np.array([battery.RESISTANCE, battery.CAPACITY])
    off = abs(found.xhat[:, -1, 2:] - true)
    assert (off <= 3 * np.sqrt(np.diagonal(found.P[:, -1, 2:, 2:], axis1=1, axis2=2))).all()
    assert (off <= 0.01 * true).all()


def test_a_drive_takes_the_charge_from_nine_tenths_to_two():
    x, record = battery.drives(3)
    np.testing.assert_allclose(x[:, -1, 0], 0.2, atol=0.02)
    # The sum of the currents, whose errors average out, is the charge that was taken.
    taken = record.u[:, :-1, 0].sum(axis=1) / 3600 / battery.CAPACITY
    noise = battery.CURRENT_NOISE * np.sqrt(record.num_samples) / 3600 / battery.CAPACITY
    np.testing.assert_allclose(0.9 - x[:, -1, 0], taken, atol=5 * noise)
