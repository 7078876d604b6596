"""Which episodes are handed out for estimators elsewhere, and the facts that go with them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pinnobs_gym.envs.game import Game
from pinnobs_gym.scoring.episode_table import Format, parquet_library
from pinnobs_gym.scoring.provenance import canonical, game_hash
from pinnobs_gym.simulation.noise import Noise
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.training.trainer import TRAINING_SEED

FORMAT = 1
"""Version of the format of the folders."""


@dataclass(frozen=True)
class Issue:
    """The episodes that a folder has, and in which form."""

    game: Game
    seeds: range
    format: Format = "csv"
    with_truth: bool = False
    """Whether the true states are there, too: of episodes that are never scored."""

    def __post_init__(self) -> None:
        if self.with_truth and self.seeds.start < TRAINING_SEED:
            raise ValueError(
                f"seed={self.seeds.start} with the truth; expected at least {TRAINING_SEED}, the "
                "seeds of training and tuning, as the truth of scored episodes is not given away"
            )
        if self.format == "parquet":
            parquet_library()

    @property
    def tables(self) -> dict[str, tuple[str, ...]]:
        """The columns of each table of samples, by its file."""
        system = self.game.source.system
        records = ("episode", "t", *system.output_names, *system.input_names)
        tables = {f"records.{self.format}": records}
        if self.with_truth:
            tables[f"truth.{self.format}"] = ("episode", "t", *system.state_names)
        return tables

    def facts(self) -> dict[str, Any]:
        """Return what ``game.json`` of the folder says.

        Raises:
            ValueError: in one line, if the code of the system cannot be read, as then no later
                process could tell whether it still plays these episodes.
        """
        source = self.game.source
        system, setup = source.system, source.setup
        code = game_hash(source)
        if code.startswith("once"):
            raise ValueError(
                f"the code of {type(system).__name__} cannot be read, so that estimates of its "
                "episodes could not be scored later; expected a system in a file"
            )
        prior = Prior.of(system, setup, 1)
        names = (*system.state_names, *system.output_names, *system.input_names)
        return {
            "format": FORMAT,
            **self.game.name._asdict(),
            "first_episode": self.seeds.start,
            "episodes": len(self.seeds),
            "with_truth": self.with_truth,
            "tables": list(self.tables),
            "game_hash": code,
            "num_samples": setup.num_steps,
            "sample_time": float(setup.dt),
            "time_unit": system.time_unit,
            "states": list(system.state_names),
            "outputs": list(system.output_names),
            "inputs": list(system.input_names),
            "units": {name: system.units[name] for name in names if name in system.units},
            "scale": [float(scale) for scale in system.scale],
            "transient_end": float(setup.transient_end),
            "parameters": canonical(system.parameters),
            "prior_mean": prior.mean[0].tolist(),
            "prior_covariance": prior.cov[0].tolist(),
            **noise_facts(self.game),
        }


def noise_facts(game: Game) -> dict[str, Any]:
    """Return the covariances of the noise at t = 0, as estimators are told them: of the outputs
    (ny, ny), and of the process noise after one unit of time (nx, nx)."""
    system, setup = game.source.system, game.source.setup
    noise = system.noise(setup.noise_std, setup.process_noise)
    R = np.asarray(noise.R(0.0))[..., 0]
    L = np.asarray(noise.L(0.0))[..., 0]
    return {
        "output_noise_covariance": R.tolist(),
        "process_noise_covariance": (L @ L.T).tolist(),
        "noise_depends_on_time": not (noise.constant and type(noise).G is Noise.G),
    }
