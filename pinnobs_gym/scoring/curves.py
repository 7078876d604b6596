"""Errors over time: what pictures need and rows do not have, in small files beside the rows."""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pinnobs_gym.envs.figures import measured_states
from pinnobs_gym.files import replacing
from pinnobs_gym.scoring.metrics import by_sample
from pinnobs_gym.scoring.playing import Played
from pinnobs_gym.scoring.rows import Row
from pinnobs_gym.simulation.system import System

POINTS = 200
"""Most sample times at which errors are kept."""
EARLY, EVEN = 50, 250
"""Of the example episode: its first samples are kept, and so many spread evenly."""


@dataclass(frozen=True)
class Example:
    """One episode at times of its own, close enough for oscillations."""

    seed: int
    t: np.ndarray
    """Times in s, shape (points,)."""
    x: np.ndarray
    """True states, shape (points, nx)."""
    xhat: np.ndarray
    """Estimates, shape (points, nx)."""
    y: np.ndarray
    """Outputs, shape (points, ny)."""
    std: np.ndarray | None
    """Standard deviations of the estimates, shape (points, nx), of those that give them."""


@dataclass(frozen=True)
class Curves:
    """The errors of one estimator in some episodes of one env, setup and condition."""

    t: np.ndarray
    """The kept times in s, shape (points,)."""
    seeds: np.ndarray
    """Of the episodes, shape (episodes,)."""
    error: np.ndarray
    """NRMSE of each kept sample, float32 (episodes, points); infinite where the estimate is not
    finite, not a number where no state counts."""
    reference: np.ndarray | None
    """What is expected of it at the Cramér-Rao reference, in the same shape; None without one."""
    example: Example
    states: tuple[str, ...]
    """Names of the states, with their units in brackets."""
    measured: dict[int, int]
    """States that an output measures alone, and which."""

    @property
    def num_episodes(self) -> int:
        """How many episodes."""
        return len(self.seeds)


def kept(num_samples: int, points: int = POINTS) -> np.ndarray:
    """Which samples are kept: all if there are no more than so many points; else half of them
    evenly and half of them by the logarithm, so that the transient is resolved and the rest is not
    lost."""
    if num_samples <= points:
        return np.arange(num_samples)
    half = points // 2
    early = np.geomspace(1, num_samples, half) - 1
    even = np.linspace(0, num_samples - 1, half)
    return np.unique(np.round(np.concatenate([early, even])).astype(int))


def _kept_of_example(num_samples: int) -> np.ndarray:
    even = np.linspace(0, num_samples - 1, min(EVEN, num_samples)).round().astype(int)
    return np.union1d(np.arange(min(EARLY, num_samples)), even)


def labels(system: System) -> tuple[str, ...]:
    """Names of the states, with their units in brackets."""
    units = (system.units.get(name, "") for name in system.state_names)
    pairs = zip(system.state_names, units, strict=True)
    return tuple(f"{name} ({unit})" if unit else name for name, unit in pairs)


def curves_of(played: Played) -> Curves:
    """The curves of a batch of whole episodes, at the kept times; the first is the example."""
    system, t, xhat = played.system, played.record.t, played.estimates.xhat
    error = by_sample(xhat - played.truth, system.scale, system.observable(played.truth))
    reference, std = played.reference, played.std
    k, m = kept(len(t)), _kept_of_example(len(t))
    return Curves(
        t=t[k],
        seeds=np.asarray(played.seeds),
        error=_short(error[:, k]),
        reference=None if reference is None else _short(reference.by_sample[:, k]),
        example=Example(
            played.seeds[0],
            t[m],
            _short(played.truth[0, m]),
            _short(xhat[0, m]),
            _short(played.record.y[0, m]),
            None if std is None else _short(std[0, m]),
        ),
        states=labels(system),
        measured=measured_states(system),
    )


def _short(values: np.ndarray) -> np.ndarray:
    """The values in float32, rounded to 12 binary digits, so that they compress well."""
    with np.errstate(over="ignore"):  # what is too large is infinite
        bits = np.ascontiguousarray(values, dtype=np.float32).view(np.uint32)
    return ((bits + np.uint32(0x800)) & np.uint32(0xFFFFF000)).view(np.float32)


def folder_of(rows: Path) -> Path:
    """Where the curves of a rows file lie."""
    return rows.parent / "curves"


def save(folder: Path, row: Row, curves: Curves) -> None:
    """Write curves to a file of their own, named after what is played, the estimator and the first
    episode; the row is one of these episodes'.

    Raises:
        ValueError: in one line, if it cannot be written.
    """
    about = {
        "estimator": row["estimator"],
        "config_hash": row["config_hash"],
        "states": curves.states,
        "measured": list(curves.measured.items()),
        "example_seed": int(curves.example.seed),
    }
    arrays: dict[str, Any] = {"t": curves.t, "seeds": curves.seeds, "error": curves.error}
    optional = {"reference": curves.reference, "std": curves.example.std}
    arrays |= {name: getattr(curves.example, name) for name in ("x", "xhat", "y")}
    arrays["example_t"] = curves.example.t
    arrays |= {name: array for name, array in optional.items() if array is not None}
    name = f"{_plain(row['estimator'])}-{row['config_hash']}-{curves.seeds[0]}.npz"
    path = _place(folder, row["env_id"], row["setup"], row["condition"]) / name
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, about=np.array(json.dumps(about)), **arrays)


def read(
    folder: Path, env_id: str, setup: str, condition: str
) -> dict[tuple[str, str], list[Curves]]:
    """The curves of an env, setup and condition, a list per estimator and config hash, each list in
    the order of first episodes; none if there is no such folder.

    Raises:
        ValueError: in one line, if a file is damaged.
    """
    found: dict[tuple[str, str], list[Curves]] = {}
    for path in sorted(_place(folder, env_id, setup, condition).glob("*.npz")):
        try:
            with path.open("rb") as file, np.load(file) as data:
                about = json.loads(str(data["about"]))
                curves = _of(about, {name: data[name] for name in data.files})
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(f"cannot read curves from {path}: {error}; delete it") from None
        found.setdefault((about["estimator"], about["config_hash"]), []).append(curves)
    return {name: sorted(parts, key=lambda c: c.seeds[0]) for name, parts in found.items()}


def merged(parts: Iterable[Curves], seeds: Iterable[int]) -> Curves | None:
    """One estimator's curves of these episodes alone, each once; None if there are none."""
    wanted = set(seeds)
    chosen: list[tuple[Curves, np.ndarray]] = []
    for part in parts:
        keep = np.array([int(seed) in wanted for seed in part.seeds])
        if keep.any() and (not chosen or len(part.t) == len(chosen[0][0].t)):
            wanted -= set(part.seeds[keep].tolist())
            chosen.append((part, keep))
    if not chosen:
        return None
    first = chosen[0][0]
    references = [part.reference[keep] for part, keep in chosen if part.reference is not None]
    return Curves(
        t=first.t,
        seeds=np.concatenate([part.seeds[keep] for part, keep in chosen]),
        error=np.concatenate([part.error[keep] for part, keep in chosen]),
        reference=np.concatenate(references) if len(references) == len(chosen) else None,
        example=min((part.example for part, _ in chosen), key=lambda example: example.seed),
        states=first.states,
        measured=first.measured,
    )


def _of(about: dict[str, Any], arrays: dict[str, np.ndarray]) -> Curves:
    example = Example(
        about["example_seed"],
        arrays["example_t"],
        arrays["x"],
        arrays["xhat"],
        arrays["y"],
        arrays.get("std"),
    )
    return Curves(
        arrays["t"],
        arrays["seeds"],
        arrays["error"],
        arrays.get("reference"),
        example,
        tuple(about["states"]),
        dict(about["measured"]),
    )


def _place(folder: Path, env_id: str, setup: str, condition: str) -> Path:
    return folder / _plain(env_id.removeprefix("pinnobs/")) / _plain(setup) / _plain(condition)


def _plain(name: str) -> str:
    """A name that is safe for a file."""
    return re.sub(r"[^\w.+-]", "_", name)
