"""Columns of a game's charts from its curves: errors over time, and the example episode."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pinnobs_gym.envs.figures import jumps
from pinnobs_gym.leaderboard.site.columns import Columns, extend, medians, numbers, quantiles
from pinnobs_gym.scoring.curves import Curves
from pinnobs_gym.scoring.thinning import kept
from pinnobs_gym.simulation.residual import nearest

POINTS = 120
"""Largest number of times at which a curve is drawn."""


@dataclass(frozen=True)
class States:
    """One episode with the estimators' results."""

    called: str
    """Which episode it is, such as ``seed 3`` or ``log drive.csv``."""
    in_part: bool
    """Whether true states are known in part, such as the reference states of a log."""
    names: tuple[str, ...]
    """Names of the states, with units."""
    limits: tuple[tuple[float, float], ...]
    """Limits of each state's axis."""
    truth: Columns
    """``t``, true states ``x0``, ...; outputs ``y0``, ..., numbered by the state that they
    measure. A gap in a state breaks its line, where an angle jumps by a period."""
    estimates: Columns
    """``estimator``, ``t``, estimates ``m0``, ..., twice their standard deviations ``s0``, ... and
    their errors ``e0``, ..., with gaps if there are none, and where an angle jumps."""
    error_limits: Mapping[str, tuple[float, ...]]
    """For each estimator, the largest absolute value on the axis of each state's error, such that
    the errors after the transient fill it."""


def errors(found: Mapping[str, Curves]) -> Columns:
    """Return the median and 10-90 % band over episodes of each estimator's error over time."""
    table: Columns = {"estimator": [], "t": [], "median": [], "q10": [], "q90": []}
    for name, own in found.items():
        k = kept(len(own.t), POINTS)
        k = k[~np.isnan(own.error[:, k]).all(axis=0)]
        error = own.error[:, k].astype(float)
        band = quantiles(error)
        extend(
            table,
            estimator=[name] * len(k),
            t=numbers(own.t[k]),
            median=numbers(medians(error)),
            q10=numbers(band[0]),
            q90=numbers(band[-1]),
        )
    return table


def reference(found: Iterable[Curves], after: float) -> Columns:
    """Return the median over all episodes of the error at the Cramér-Rao reference, at the samples
    later than ``after``, in s from the first: in the transient window it bounds nothing."""
    episodes: dict[int, np.ndarray] = {}
    t = np.empty(0)
    for own in found:
        if own.reference is None or (len(t) and len(own.t) != len(t)):
            continue
        t = own.t
        for seed, line in zip(own.seeds.tolist(), own.reference, strict=True):
            episodes.setdefault(seed, line)
    if not episodes:
        return {"t": [], "median": []}
    k = kept(len(t), POINTS)
    lines = np.stack(list(episodes.values()))[:, k].astype(float)
    some = ~np.isnan(lines).all(axis=0) & (t[k] - t[0] > after * (1 + 1e-9))
    return {"t": numbers(t[k][some]), "median": numbers(medians(lines[:, some]))}


def states(found: Mapping[str, Curves], logs: Mapping[int, str], after: float) -> States | None:
    """Return the example episode that most estimators share, of the lowest seed in a tie; None
    without curves.

    Args:
        found: each estimator's curves.
        logs: names of the files of those episodes that are logs, by their seeds.
        after: end of the transient window in s from the first sample.
    """
    seeds = [own.example.seed for own in found.values()]
    if not seeds:
        return None
    seed = max(sorted(set(seeds)), key=seeds.count)
    shown = {name: own for name, own in found.items() if own.example.seed == seed}
    first = next(iter(shown.values()))
    return States(
        called=f"log {logs[seed]}" if seed in logs else f"seed {seed}",
        in_part=bool(np.isnan(first.example.x).any()),
        names=first.states,
        limits=tuple(map(_limits, first.example.x.T, first.example.xhat.T)),
        truth=_truth(first),
        estimates=_estimates(shown),
        error_limits={name: _error_limits(own, after) for name, own in shown.items()},
    )


def _errors(own: Curves) -> np.ndarray:
    """Return the errors of an example (num_samples, nx), those of angles within half a turn."""
    x = own.example.x.astype(float)
    return nearest(own.example.xhat.astype(float), x, own.state_period) - x


def _error_limits(own: Curves, after: float) -> tuple[float, ...]:
    """Return `States.error_limits` of an example."""
    error = np.abs(_errors(own))
    late = own.example.t - own.example.t[0] > after * (1 + 1e-9)
    error = np.where(np.isfinite(error), error, 0.0)[late if late.any() else slice(None)]
    scale = np.nanmax(np.abs(own.example.x), axis=0, initial=1e-9)
    return tuple(float(f"{limit:.3g}") for limit in 1.25 * error.max(axis=0) + 1e-9 * scale)


def _truth(own: Curves) -> Columns:
    """Return `States.truth` of an example."""
    t, x, y = own.example.t, own.example.x, own.example.y
    breaks = [jumps(each, period) for each, period in zip(x.T, _periods(own), strict=True)]
    if np.isnan(x).any():  # dots, which have no line to break
        breaks = [np.empty(0, dtype=int)] * len(breaks)
    t, x = _broken(breaks, t, x)
    new = np.unique(np.concatenate(breaks)).astype(int)
    y = np.insert(y.astype(float), new, np.nan, axis=0)  # no dot is drawn twice
    table: Columns = {"t": numbers(t)}
    table |= {f"x{i}": numbers(x[:, i]) for i in range(x.shape[1])}
    return table | {f"y{i}": numbers(y[:, output]) for i, output in own.measured.items()}


def _periods(own: Curves) -> Sequence[float | None]:
    """Return the period of each state, None if it does not repeat."""
    return own.state_period or [None] * own.example.x.shape[1]


def _broken(
    breaks: Sequence[np.ndarray], t: np.ndarray, x: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return times and states (points, nx) with a further point before each sample at which the
    line of some state breaks: a copy of that sample, with NaN in place of such states."""
    at = np.unique(np.concatenate(breaks)).astype(int)
    gap = np.stack([np.isin(at, own) for own in breaks], axis=-1)
    return np.insert(t, at, t[at]), np.insert(x, at, np.where(gap, np.nan, x[at]), axis=0)


def _estimates(shown: Mapping[str, Curves]) -> Columns:
    """Return `States.estimates` of all examples."""
    nx = next(iter(shown.values())).example.x.shape[1]
    table: Columns = {"estimator": [], "t": []}
    table |= {f"{part}{i}": [] for i in range(nx) for part in ("m", "s", "e")}
    for name, own in shown.items():
        example, std = own.example, own.example.std
        curves = zip(example.xhat.T, _periods(own), example.x.T, strict=True)
        breaks = [
            jumps(xhat, period, None if np.isnan(x).any() else x) for xhat, period, x in curves
        ]
        t, mean = _broken(breaks, example.t, example.xhat)
        std = np.full(example.xhat.shape, np.nan) if std is None else std
        parts = {"m": mean, "s": 2 * _broken(breaks, example.t, std)[1]}
        parts["e"] = _broken(breaks, example.t, _errors(own))[1]
        new = {f"{part}{i}": numbers(v[:, i]) for part, v in parts.items() for i in range(nx)}
        extend(table, estimator=[name] * len(t), t=numbers(t), **new)
    return table


def _limits(x: np.ndarray, xhat: np.ndarray) -> tuple[float, float]:
    """Return the range of a state with a margin: that of its true values and, if some are unknown,
    of the estimates."""
    if np.isnan(x).any():
        seen = np.concatenate([x, xhat]).astype(float)
        x = seen[np.isfinite(seen)] if np.isfinite(seen).any() else np.zeros(1)
    low, high = float(x.min()), float(x.max())
    margin = 0.15 * (high - low) + 1e-9 * max(abs(low), abs(high), 1.0)
    return low - margin, high + margin
