"""What speaks against the fit of a model to logs, in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pinnobs_gym.logs.noise_fit import NoiseFit
from pinnobs_gym.logs.precision import Precision, Residuals
from pinnobs_gym.logs.unknown import Parameters
from pinnobs_gym.simulation.system import System

_CLOSE = 0.95
"""Correlation of two estimates, in size, from which on it is told."""
_USUAL = (0.5, 2.0)
"""Range of the residuals over their expected standard deviation."""
_TAIL = 2.0
"""Root mean square of residuals over their robust standard deviation from which on it is told."""
_SERIAL = 0.3
"""Correlation of residuals from one sample to the next, in size, from which on it is told."""


def doubts_of_parameters(parameters: Parameters, d: np.ndarray, known: Precision) -> list[str]:
    """Return which parameters the logs do not tell, a line each.

    Args:
        parameters: the unknown ones.
        d: their values in units of their scale, less the start, shape (p,).
        known: how well they are known, in units of their scale.
    """
    names, values, std = parameters.names, parameters.values(d), known.std[: len(d)]
    lines = []
    lost = [name for name, error in zip(names, std, strict=True) if np.isinf(error)]
    if len(lost) == 1:
        lines.append(f"the outputs do not depend on {lost[0]}: it is not determined")
    elif lost:
        lines.append(
            f"the outputs depend on {', '.join(lost)} in a combination only: they are not "
            "determined apart; fit fewer of them"
        )
    for i, name in enumerate(names):
        error = std[i] * parameters.scale[i]
        if np.isfinite(error) and error >= max(abs(values[i]), parameters.scale[i]):
            lines.append(
                f"{name} is not determined: its standard error, {error:.2g}, is as large as the "
                "value"
            )
        if np.isnan(error):
            lines.append(f"{name} is at its bound, {values[i]:.6g}; the logs want it beyond")
        for j in range(i):
            r = known.correlation[i, j]
            if abs(r) > _CLOSE:
                lines.append(
                    f"{names[j]} and {name} are hardly told apart: their errors have the "
                    f"correlation {r:.3f}"
                )
    return lines


def doubts_of_residuals(
    system: System, residuals: Sequence[Residuals], larger: float | None
) -> list[str]:
    """Return whether the fit does not explain the logs, a line for each way in which it does not.

    Args:
        system: the model.
        residuals: what those of each output say.
        larger: the factor by which standard errors were enlarged; None if they are those of noise
            that was found, or of a filter.
    """
    named = list(zip(system.output_names, residuals, strict=True))
    lines = []
    if large := [f"{name} {own.ratio:.2g}" for name, own in named if own.ratio > _USUAL[1]]:
        grown = "" if larger is None else f"; standard errors are enlarged {larger:.2g} times"
        lines.append(
            f"residuals over the noise that is told: {', '.join(large)}; the model does not "
            f"explain the log, or its noise is told too small{grown}"
        )
    if small := [f"{name} {own.ratio:.2g}" for name, own in named if own.ratio < _USUAL[0]]:
        lines.append(
            f"residuals over the noise that is told: {', '.join(small)}; it is told too large, and "
            "standard errors are those of the told noise"
        )
    if far := [(name, own) for name, own in named if own.far and own.tail > _TAIL]:
        parts = [f"{100 * own.far:.2g} % of {name} ({own.tail:.2g} times)" for name, own in far]
        lines.append(
            f"residuals far beyond the others: {', '.join(parts)} make the root mean square that "
            "many times as large as of the rest; outliers, or a model that fails at times, decide "
            "what was found; leave the cells of outliers empty"
        )
    if serial := [(name, own.serial) for name, own in named if abs(own.serial) > _SERIAL]:
        lines.append(_of_serial(serial, larger is not None))
    return lines


def _of_serial(serial: Sequence[tuple[str, float]], by_trajectory: bool) -> str:
    """Return what correlations of residuals from one sample to the next, by output, say. Errors
    with the correlation r^k over k samples have the effect of white ones that are
    √((1 + r)/(1 − r)) times as large."""
    listed = ", ".join(f"{name} {r:.2f}" for name, r in serial)
    r = min(max(r for _, r in serial), 0.999)
    line = f"residuals are correlated from one sample to the next: {listed}; the model leaves "
    line += "something out"
    if r <= 0:
        return line
    factor = f"{np.sqrt((1 + r) / (1 - r)):.2g}"
    line += f", and standard errors are up to {factor} times too small"
    if by_trajectory:
        return f"{line}; try --noise, which takes what the model leaves out as process noise"
    return f"{line}. Sensor errors that last ask for as much more --noise-std in a filter"


def doubts_of_noise(system: System, made: NoiseFit, std: np.ndarray) -> list[str]:
    """Return what the logs do not tell of the noise, a line each, given the standard errors of the
    logarithms of the noise of outputs and of the process noise, (n,)."""
    outputs, process = std[: len(made.outputs)], std[len(made.outputs) :]
    unsure = [
        f"noise of {system.output_names[j]}"
        for j, error in zip(made.outputs, outputs, strict=True)
        if not error < 1
    ]
    lines = []
    if made.perhaps_none:
        lines.append(
            "the logs do not tell the process noise from zero: without it, the log-likelihood is "
            f"{max(0.0, made.gain_of_process_noise):.2g} less; tell none, --process-noise 0"
        )
    elif made.usual:
        names = zip(system.state_names, process, strict=True)
        unsure += [f"process noise of {name}" for name, error in names if not error < 1]
    elif not process[0] < 1:
        unsure.append("process noise")
    if unsure:
        lines.append(f"not determined, and perhaps zero: {', '.join(unsure)}")
    if made.usual:
        lines.append(
            "the model tells no process noise; noise of each state was found by itself, which "
            "stands for whatever the model leaves out"
        )
    return lines
