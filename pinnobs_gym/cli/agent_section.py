"""What the page of a system says to those who train agents: action modes and returns."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from pinnobs_gym.envs.actions import FORMS, LARGEST_CORRECTION, PredictionForm
from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimators.sb3 import Sb3
from pinnobs_gym.leaderboard.grid import markdown_table
from pinnobs_gym.leaderboard.published import manifest
from pinnobs_gym.leaderboard.published.manifest import Manifest
from pinnobs_gym.leaderboard.published.reading import rows_in
from pinnobs_gym.scoring.provenance import game_hash
from pinnobs_gym.scoring.rows import Row
from pinnobs_gym.simulation.system import System

COMPARED = ("open_loop", "ekf", "ukf")
"""Estimators whose returns are shown beside those of the best published agent."""
ADVICE = (
    '`action_mode="gain"` with `reward="improvement"` is advised: the model predicts, and the '
    "agent learns how much of each innovation to believe. The default, `estimate`, is for "
    "estimators: an agent would have to learn the plant itself, and a memory of it, from single "
    "outputs in physical units, which PPO with the default settings of Stable-Baselines3 does not "
    "(`python scripts/default_ppo.py`). `pinnobs train rl` has settings that learn."
)


def for_agents(cls: type[System], env_id: str) -> str:
    """Return the section as text in Markdown."""
    system = cls()
    nx, ny, own = system.nx, system.ny, system.ny + system.nu + 1
    lines = []
    for name, form in FORMS.items():
        what = " ".join((form.__doc__ or "").partition("\n\n")[0].split()).rstrip(".")
        what = what.replace("`LARGEST_CORRECTION`", f"{LARGEST_CORRECTION:g}")
        actions = nx * ny if name == "gain" else nx
        features = own + (nx if issubclass(form, PredictionForm) else 0)
        lines.append((f"`{name}`", what, str(actions), str(features)))
    header = ("action_mode", "action", "numbers of an action", "of an observation")
    return f"{ADVICE}\n\n{markdown_table(header, lines)}\n\n{_returns(cls, env_id)}"


def _returns(cls: type[System], env_id: str) -> str:
    """Return the returns of published episodes as text."""
    threshold = cls.reward_threshold
    parts = []
    if threshold is not None:
        parts.append(
            f"`reward_threshold` is {threshold:.4g}, the mean return of the UKF in the episodes of "
            "seeds 0 to 99.\n"
        )
    rows = _published(env_id)
    if not rows:
        return "\n".join([*parts, "No returns are published; `pinnobs evaluate` scores episodes."])
    steps = cls.configured()[1].num_steps
    by_name: dict[tuple[str, int | None], list[float]] = defaultdict(list)
    for row in rows:
        by_name[row["estimator"], row["training_seed"]].append(-steps * row["nrmse"] ** 2)
    agents = {key: found for key, found in by_name.items() if key[0].split(",")[0] == Sb3.name}
    shown: list[tuple[str, int | None]] = [(name, None) for name in COMPARED]
    shown = [key for key in shown if key in by_name]
    if agents:
        shown.append(max(agents, key=lambda key: float(np.mean(agents[key]))))
    lines = []
    for key in shown:
        name = (
            key[0] if key[1] is None else f"{key[0]}, the best of {len(agents)} in these episodes"
        )
        found = np.array(by_name[key])
        values = (found.mean(), np.median(found), found.min())
        lines.append((name, *(f"{value:.3g}" for value in values), str(len(found))))
    old = {row["game_hash"] for row in rows} != {game_hash(Game.of(cls).source)}
    note = " They are of other code than the present." if old else ""
    return "\n".join(
        [
            *parts,
            f"Returns of published episodes, −{steps}·NRMSE² each, without discount.{note}\n",
            markdown_table(("estimator", "mean", "median", "least", "episodes"), lines),
        ]
    )


def _published(env_id: str) -> list[Row]:
    """Return the published rows of the benchmark setup, without a condition."""
    published = Manifest.read(manifest.FOLDER)
    if published is None:
        return []
    game = (env_id, "benchmark", "nominal")
    return rows_in(
        published, [each for each in published.rows if each.game == game and not each.floor]
    )
