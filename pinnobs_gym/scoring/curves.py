"""Curves of the error over time, which figures need and rows lack, in small files beside the
rows."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pinnobs_gym.envs.figures import drawn_outputs, measured_states
from pinnobs_gym.envs.game import GameName
from pinnobs_gym.files import file_name, replacing
from pinnobs_gym.files.archive import Damaged, arrays_of, json_in, read_parts
from pinnobs_gym.scoring.metrics import by_sample
from pinnobs_gym.scoring.playing import Played
from pinnobs_gym.scoring.rows import Row, game_of
from pinnobs_gym.scoring.thinning import kept, kept_of_example, rounded
from pinnobs_gym.simulation.residual import Periods, nearest
from pinnobs_gym.simulation.system import System


@dataclass(frozen=True)
class Example:
    """One example episode, sampled densely enough for oscillations."""

    seed: int
    t: np.ndarray
    """Times in s from the first sample, shape (points,)."""
    x: np.ndarray
    """True states, shape (points, nx); NaN where they are unknown."""
    xhat: np.ndarray
    """Estimates, shape (points, nx); of an angle, the value nearest to the true state. Where true
    states are known in part, it is they that are nearest to the estimates."""
    y: np.ndarray
    """Outputs, shape (points, ny); of an angle that is a state, the value nearest to it."""
    std: np.ndarray | None
    """Standard deviations of the estimates, shape (points, nx); None if the estimator has none."""


@dataclass(frozen=True)
class Curves:
    """The errors of one estimator over time in some episodes of one game."""

    t: np.ndarray
    """The kept times in s from the first sample, shape (points,)."""
    seeds: np.ndarray
    """Seeds of the episodes, shape (episodes,)."""
    error: np.ndarray
    """NRMSE of each kept sample, float32 (episodes, points); infinite where the estimate is not
    finite, NaN where no state is scored."""
    reference: np.ndarray | None
    """NRMSE expected at the Cramér-Rao reference, in the same shape; None without a reference."""
    example: Example
    states: tuple[str, ...]
    """Names of the states, with units in brackets."""
    measured: dict[int, int]
    """Index of each directly measured state, with the index of its output."""
    state_period: Periods | None = None
    """Period of each state, as `System.state_period`."""


def labels(system: System) -> tuple[str, ...]:
    """Return the names of the states, with units in brackets."""
    units = (system.units.get(name, "") for name in system.state_names)
    pairs = zip(system.state_names, units, strict=True)
    return tuple(f"{name} ({unit})" if unit else name for name, unit in pairs)


def curves_of(played: Played) -> Curves:
    """Return the curves of a batch of whole episodes at the kept times; the first is the
    example."""
    system, xhat = played.system, played.estimates.xhat
    t = played.record.t - played.record.t[0]  # a log's clock may begin at any time
    shown, truth = nearest(xhat, played.truth, system.state_period), played.truth
    if np.isnan(truth).any():  # the estimates are known at all samples, so that these stay
        shown, truth = xhat, nearest(truth, xhat, system.state_period)
    dots = drawn_outputs(system, shown if np.isnan(truth).any() else truth, played.record.y)
    error = system.state_residual(xhat, played.truth)
    error = by_sample(error, system.scale, played.scored)
    reference, std = played.reference, played.std
    known = np.flatnonzero(~np.isnan(played.truth).all(axis=(0, 2)))
    k = known[kept(len(known))]
    m = np.union1d(kept_of_example(len(t)), known[kept_of_example(len(known))])
    return Curves(
        t=t[k],
        seeds=np.asarray(played.seeds),
        error=rounded(error[:, k]),
        reference=None if reference is None else rounded(reference.by_sample[:, k]),
        example=Example(
            played.seeds[0],
            t[m],
            rounded(truth[0, m]),
            rounded(shown[0, m]),
            rounded(dots[0, m]),
            None if std is None else rounded(std[0, m]),
        ),
        states=labels(system),
        measured=measured_states(system),
        state_period=system.state_period,
    )


def folder_of(rows: Path) -> Path:
    """Return the folder of the curves of a rows file."""
    return rows.parent / "curves"


def save(folder: Path, row: Row, curves: Curves) -> None:
    """Write curves to a separate file, named after the game, the estimator and the first episode.
    The row is of one of these episodes.

    Raises:
        ValueError: in one line, if the file cannot be written.
    """
    about = {
        "estimator": row["estimator"],
        "hashes": [row["game_hash"], row["estimator_hash"]],
        "states": curves.states,
        "measured": list(curves.measured.items()),
        "example_seed": int(curves.example.seed),
        "state_period": curves.state_period,
    }
    example, optional = curves.example, {"reference": curves.reference, "std": curves.example.std}
    arrays: dict[str, Any] = {"t": curves.t, "seeds": curves.seeds, "error": curves.error}
    arrays |= {"x": example.x, "xhat": example.xhat, "y": example.y, "example_t": example.t}
    arrays |= {name: array for name, array in optional.items() if array is not None}
    hashes = f"{row['game_hash']}-{row['estimator_hash']}"
    name = f"{file_name(row['estimator'])}-{hashes}-{curves.seeds[0]}.npz"
    path = _folder_of_game(folder, game_of(row)) / name
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, about=np.array(json.dumps(about)), **arrays)


def read(folder: Path, game: GameName) -> dict[tuple[str, str], list[Curves]]:
    """Read the curves of a game: a list per game hash and estimator hash, in the order of first
    episodes. The result is empty if there is no such folder.

    Raises:
        ValueError: in one line, if a file is damaged.
    """
    by_estimator: dict[tuple[str, str], list[Curves]] = {}
    for path in sorted(_folder_of_game(folder, game).glob("*.npz")):
        hashes, curves = _read(path)
        by_estimator.setdefault(hashes, []).append(curves)
    return {name: sorted(parts, key=lambda c: c.seeds[0]) for name, parts in by_estimator.items()}


def _read(path: Path) -> tuple[tuple[str, str], Curves]:
    """Read a file: the hashes of game and estimator, and the curves."""
    try:
        arrays = arrays_of(read_parts(path, compressed=True))
        about = json_in(str(arrays["about"]))
        game_hash, estimator_hash = map(str, about["hashes"])
        curves = _from_arrays(about, arrays)
        if curves.error.shape != (len(curves.seeds), len(curves.t)):
            raise Damaged(f"errors of shape {curves.error.shape}")
    except (Damaged, LookupError, TypeError, ValueError, AttributeError) as error:
        reason = str(error).removeprefix(f"cannot read {path}: ")
        raise ValueError(f"cannot read curves from {path}: {reason}; delete it") from None
    return (game_hash, estimator_hash), curves


def merged(parts: Iterable[Curves], seeds: Iterable[int]) -> Curves | None:
    """Merge one estimator's curves, restricted to these episodes, each once; None if there are
    none. Parts on other times than the first are left out."""
    wanted = set(seeds)
    chosen: list[tuple[Curves, np.ndarray]] = []
    for part in parts:
        keep = np.array([int(seed) in wanted for seed in part.seeds])
        if keep.any() and (not chosen or np.array_equal(part.t, chosen[0][0].t)):
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
        state_period=first.state_period,
    )


def _from_arrays(about: dict[str, Any], arrays: dict[str, np.ndarray]) -> Curves:
    """Return the curves stored in a file."""
    example = Example(
        seed=about["example_seed"],
        t=arrays["example_t"],
        x=arrays["x"],
        xhat=arrays["xhat"],
        y=arrays["y"],
        std=arrays.get("std"),
    )
    return Curves(
        t=arrays["t"],
        seeds=arrays["seeds"],
        error=arrays["error"],
        reference=arrays.get("reference"),
        example=example,
        states=tuple(about["states"]),
        measured=dict(about["measured"]),
        state_period=about.get("state_period"),
    )


def _folder_of_game(folder: Path, game: GameName) -> Path:
    return folder.joinpath(*map(file_name, (game.system, game.setup, game.condition)))
