"""The fit of a model to logs: its parameters, its noise, or both, with standard errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pinnobs_gym.logs.fit_words import doubts_of_noise, doubts_of_parameters, doubts_of_residuals
from pinnobs_gym.logs.noise_fit import NoiseFit, fit_noise
from pinnobs_gym.logs.parameter_fit import fit_parameters
from pinnobs_gym.logs.precision import (
    Precision,
    Residuals,
    precision,
    residuals_of,
    whitened_innovations,
)
from pinnobs_gym.logs.reading import Log
from pinnobs_gym.logs.unknown import Parameters
from pinnobs_gym.simulation.system import Setup, System

_AT_BOUND = 1e-9
"""Distance from a bound, in units of the scale, that counts as none."""

Progress = Callable[[str], object]


@dataclass(frozen=True)
class Found:
    """A value that logs tell."""

    name: str
    """What it is."""
    unit: str
    """Its unit; empty if it has none."""
    value: float
    """The value."""
    std: float
    """Its standard error: infinite if the logs do not tell it, and NaN if it is at a bound."""


@dataclass(frozen=True)
class Fit:
    """A model that was fitted to logs."""

    method: str
    """How, in a few words."""
    system: System
    """The model with the parameters found."""
    found: tuple[Found, ...]
    """The parameters, then the noise if it was to be found."""
    correlation: np.ndarray
    """Correlations of the unknowns: the parameters, then the logarithms of the noise of each output
    and of the process noise, shape (n, n)."""
    residuals: tuple[Residuals, ...]
    """What the residuals of each output say."""
    warnings: tuple[str, ...]
    """What speaks against the fit, a line each."""
    noise: NoiseFit | None
    """The noise, if it was to be found."""
    yhat: tuple[np.ndarray, ...]
    """Outputs of the model for each log, shape (num_samples, ny): along its trajectory or, with
    process noise, as predicted from the samples before."""
    std: tuple[np.ndarray, ...]
    """Standard deviations of the residuals that are expected, of the same shape."""


def fit(
    logs: Sequence[Log],
    setup: Setup,
    parameters: Parameters,
    noise: bool = False,
    progress: Progress = lambda text: None,
) -> Fit:
    """Fit a model to logs.

    Without process noise, the parameters are those of least squares over the trajectories
    (`pinnobs_gym.logs.parameter_fit`). With process noise, told or to be found, no trajectory
    explains a log, and least squares would take its noise for slow changes of the outputs; the
    parameters are then those of largest likelihood of the innovations
    (`pinnobs_gym.logs.noise_fit`), together with the noise if that is to be found.

    Args:
        logs: the logs, each with the prior of its initial state.
        setup: the told noise.
        parameters: the unknown ones.
        noise: whether the noise is to be found.
        progress: is told in a few words what is being done.

    Raises:
        ValueError: in one line, if nothing is to be found, if the logs are not of one system, or as
            these two do.
    """
    if not parameters.names and not noise:
        raise ValueError("nothing is to be found; name parameters, or ask for the noise")
    system = logs[0].system
    other = next((log for log in logs if type(log.system) is not type(system)), None)
    if other is not None:
        raise ValueError(
            f"log {other.path} is one of {type(other.system).__name__}; expected "
            f"{type(system).__name__}, as of {logs[0].path}"
        )
    told = system.noise(setup.noise_std, setup.process_noise)
    if not noise and not told.stochastic:
        return _by_trajectories(logs, setup, parameters, progress)
    return _by_likelihood(logs, setup, parameters, noise, progress)


def _by_trajectories(
    logs: Sequence[Log], setup: Setup, parameters: Parameters, progress: Progress
) -> Fit:
    made = fit_parameters(logs, setup, parameters, progress)
    held, y = _held(parameters, made.d), [log.record.y[0] for log in logs]
    known = precision(made.information, held)
    # Residuals larger than the told noise have other causes, which also move the parameters.
    larger = float(np.sqrt(max(1.0, made.excess)))
    known = Precision(larger * known.std, known.correlation)
    residuals = residuals_of([path.whitened for path in made.trajectories], y)
    system, found = _values(logs[0].system, parameters, made.d, known)
    warnings = [
        *doubts_of_parameters(parameters, made.d, known),
        *doubts_of_residuals(system, residuals, larger),
    ]
    return Fit(
        "least squares over the trajectory",
        system,
        found,
        known.correlation,
        tuple(residuals),
        tuple(warnings),
        None,
        tuple(path.yhat for path in made.trajectories),
        tuple(path.std for path in made.trajectories),
    )


def _by_likelihood(
    logs: Sequence[Log], setup: Setup, parameters: Parameters, noise: bool, progress: Progress
) -> Fit:
    starts = []
    if parameters.names:
        try:
            starts = [fit_parameters(logs, setup, parameters, progress, again=False).d]
        except ValueError:  # no trajectory is finite; the filter's estimates may still be
            starts = []
    made = fit_noise(logs, setup, parameters, noise=noise, starts=starts, progress=progress)
    p, y = len(parameters.names), [log.record.y[0] for log in logs]
    d = made.unknowns[:p]
    held = np.r_[_held(parameters, d), np.zeros(len(made.unknowns) - p, dtype=bool)]
    known = precision(made.information, held)
    system, found = _values(logs[0].system, parameters, d, known)
    warnings = doubts_of_parameters(parameters, d, known)
    if noise:
        found += _noise_values(system, made, known.std[p:])
        warnings += doubts_of_noise(system, made, known.std[p:])
    whitened = [
        whitened_innovations(outputs, e, S)
        for outputs, e, S in zip(y, made.innovation, made.S, strict=True)
    ]
    residuals = residuals_of(whitened, y)
    warnings += doubts_of_residuals(system, residuals, None)
    return Fit(
        "maximum likelihood of an extended Kalman filter's innovations",
        system,
        found,
        known.correlation,
        tuple(residuals),
        tuple(warnings),
        made if noise else None,
        tuple(a - b for a, b in zip(y, made.innovation, strict=True)),
        tuple(np.sqrt(np.einsum("kii->ki", S)) for S in made.S),
    )


def _held(parameters: Parameters, d: np.ndarray) -> np.ndarray:
    """Return which parameters are at a bound, bool (p,)."""
    values, near = parameters.values(d), _AT_BOUND * parameters.scale
    return (values <= parameters.low + near) | (values >= parameters.high - near)


def _values(
    system: System, parameters: Parameters, d: np.ndarray, known: Precision
) -> tuple[System, tuple[Found, ...]]:
    """Return the system with the parameters found, and these."""
    values = parameters.values(d)
    std = parameters.scale * known.std[: len(values)]
    found = tuple(
        Found(name, system.units.get(name, ""), float(value), float(error))
        for name, value, error in zip(parameters.names, values, std, strict=True)
    )
    return parameters.of(system, np.array([each.value for each in found])), found


def _noise_values(system: System, made: NoiseFit, std: np.ndarray) -> tuple[Found, ...]:
    """Return the noise found, given the standard errors (n,) of its logarithms."""
    outputs, process = std[: len(made.outputs)], std[len(made.outputs) :]
    found = []
    for j, error in zip(made.outputs, outputs, strict=True):
        name, value = system.output_names[j], float(made.noise_std[j])
        unit = system.units.get(name, "")
        found.append(Found(f"noise of {name}", unit, value, value * float(error)))
    sizes = np.sqrt((made.process_noise**2).sum(axis=1))
    for name, size, error in zip(
        system.state_names, sizes, np.broadcast_to(process, sizes.shape), strict=True
    ):
        if size:
            unit = system.units.get(name, "")
            unit = unit if system.discrete else f"{unit or 1}/√s"
            value = float(size)
            found.append(Found(f"process noise of {name}", unit, value, value * float(error)))
    return tuple(found)
