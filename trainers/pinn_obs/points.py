"""The points of the loss in a record, and the output scales of the fast recipe."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System
from trainers.pinn_obs.objective import Points

_FIRST = 30
"""Number of samples at the beginning, all of which are taken."""
_APART = 100
"""Number of samples at geometrically increasing distances."""
_LAYER = (0.02, 2.0, 24)
"""First and last of the points right after t₀, over the first interval, and their number."""
_LOOKS = 9
"""Number of samples at which the outputs' Jacobian is evaluated."""
_PERIODS = 20
"""Number of periods in a record above which a frequency becomes an input of the network."""


def continuous(system: System, record: Record) -> Record:
    """Return a record of one episode with outputs that repeat moved by whole periods, so that they
    do not jump from sample to sample and can be interpolated. Missing outputs stay missing."""
    if system.output_period is None:
        return record
    y = record.y.copy()
    for i, period in enumerate(system.output_period):
        present = ~np.isnan(y[0, :, i])
        if period is not None:
            y[0, present, i] = np.unwrap(y[0, present, i], period=period)
    return replace(record, y=y)


def points_of(system: System, record: Record, most: int) -> tuple[Points, Record]:
    """Choose the points of the loss in a record of one episode.

    The samples are the first thirty, a hundred at geometrically increasing distances, and at most
    ``most`` at equal distances. The points are these, and others within the first two intervals.

    Returns:
        The points, and the chosen samples as a record.
    """
    t, number = record.t, record.num_samples
    apart = np.geomspace(1, number - 1, min(number, _APART))
    even = np.linspace(0, number - 1, min(most, number))
    first = np.arange(min(number, _FIRST))
    chosen = np.unique(np.concatenate([first, apart.round(), even.round()]).astype(int))
    layer = t[0] + (t[1] - t[0]) * np.geomspace(*_LAYER)
    times = np.unique(np.concatenate([t[chosen], layer]))
    y = on_lines(times, t, record.y[0])
    present = ~np.isnan(y)
    # Weights of the trapezoidal rule.
    halves = np.diff(times) / (t[-1] - t[0]) / 2
    weights = np.append(halves, 0.0) + np.append(0.0, halves)
    output = weights[:, None] * present
    u = inputs_at(system, times, record)
    points = Points(
        times,
        u,
        np.where(present, y, 0.0),
        present.astype(float),
        weights,
        output / np.maximum(output.sum(0), 1e-9),
        record.prior.mean[0],
    )
    return points, record.samples(chosen)


def samples_of(system: System, record: Record, chosen: np.ndarray) -> Points:
    """Return the samples with these indices (num_samples,) of a record of one episode as points.

    All samples have the same weight. The first sample is included, with zero weight if it is not
    chosen. The weights of the outputs that are present sum to ny.
    """
    indices = np.union1d([0], chosen)
    t, y = record.t[indices], record.y[0, indices]
    u = record.u[0, indices] if system.measured_input else np.asarray(system.input(t))
    among = np.isin(indices, chosen)
    present = ~np.isnan(y)
    output = (present & among[:, None]).astype(float)
    return Points(
        t,
        u,
        np.where(present, y, 0.0),
        present.astype(float),
        among / len(chosen),
        output * (system.ny / max(output.sum(), 1.0)),
        record.prior.mean[0],
    )


def inputs_at(system: System, times: np.ndarray, record: Record) -> np.ndarray:
    """Return the inputs (num_times, nu) at times within a record of one episode; measured ones are
    between samples as `System.input_hold` says."""
    if not system.measured_input:
        return np.asarray(system.input(times))
    if system.input_hold == "linear":
        return on_lines(times, record.t, record.u[0])
    last = np.searchsorted(record.t, times, side="right") - 1
    return record.u[0, np.clip(last, 0, record.num_samples - 1)]


def on_lines(times: np.ndarray, t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Interpolate values (num_samples, ...) at t linearly at given times within; NaN between two
    samples if either is NaN."""
    after = np.clip(np.searchsorted(t, times, side="left"), 1, len(t) - 1)
    part = (times - t[after - 1]) / (t[after] - t[after - 1])
    part = part.reshape(-1, *[1] * (values.ndim - 1))
    between = (1 - part) * values[after - 1] + part * values[after]
    return np.where(part == 0, values[after - 1], np.where(part == 1, values[after], between))


def output_scale(system: System, record: Record) -> np.ndarray:
    """Return the scale of each output (ny,).

    It is the largest change of the output by a state's scale, at some of the samples, or a
    thousandth of the output's range if that is larger; 1 if both are zero.
    """
    scale, mean = np.asarray(system.scale, float), record.prior.mean[0]
    x = mean + scale * np.array([[-1.0], [0.0], [1.0]])
    some = np.linspace(0, record.num_samples - 1, min(record.num_samples, _LOOKS)).astype(int)
    x = np.repeat(x[:, None], len(some), axis=1)
    H = np.asarray(system.h_jacobian(record.t[some], x, record.u[0, some]))
    by_model = abs(H * scale).max(axis=(0, 1, 3))
    y = np.where(np.isnan(record.y[0]), 0.0, record.y[0])
    size = np.maximum(by_model, np.ptp(y, axis=0) * 1e-3)
    return np.where(size > 0, size, 1.0)


def fast_frequencies(record: Record) -> tuple[float, ...]:
    """Return the angular frequency (rad/s) of the highest peak in the outputs' spectrum.

    The result is empty unless more than twenty of its periods lie in the record. A small network
    cannot fit so fast an oscillation without this input.
    """
    t = record.t
    even = np.linspace(t[0], t[-1], len(t))
    power = np.zeros(len(t) // 2 + 1)
    for y in record.y[0].T:
        present = ~np.isnan(y)
        if present.any() and np.ptp(y[present]) > 0:
            wave = np.interp(even, t[present], (y[present] - y[present].mean()) / y[present].std())
            power += abs(np.fft.rfft(wave * np.hanning(len(t)))) ** 2
    peak = int(np.argmax(power))
    if not _PERIODS < peak < len(power) - 1:
        return ()
    # Refine the peak by a parabola through the logarithms of three bins.
    below, here, above = np.log(power[peak - 1 : peak + 2] + 1e-300)
    place = peak + 0.5 * (below - above) / (below - 2 * here + above)
    cycle = (t[-1] - t[0]) * len(t) / (len(t) - 1)
    return (float(2 * np.pi * place / cycle),)
