"""What watches an agent in training: the episodes held out, checkpoints, the bar, and the end."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from pinnobs_gym.estimators.sb3 import Sb3, TrainedAgent
from pinnobs_gym.scoring.metrics import score
from pinnobs_gym.scoring.playing import play
from trainers.rl.agent import Training

HELD_OUT = 500_000
"""From the first seed of the training to that of the episodes held out."""


class Watch(BaseCallback):
    """Looks at the episodes held out from time to time and keeps the best agent.

    The measure is the geometric mean of two medians over these episodes, of the NRMSE over the
    whole and over the last quarter, states that no output tells apart counting as one; episodes
    that left the finite numbers count as infinite.

    Args:
        training: the agent.
        begun: CPU time of the process when training began, in s.
        checkpoint: where its state is kept, if anywhere.
        show: the bar.
        stopped: not empty once Ctrl-C was pressed.
    """

    def __init__(
        self,
        training: Training,
        begun: float,
        checkpoint: Path | None,
        show: Callable[[int, str], None],
        stopped: list[bool],
    ) -> None:
        super().__init__()
        self._training, self._begun, self._checkpoint = training, begun, checkpoint
        self._show, self._stopped = show, stopped
        self._looked = training.model.num_timesteps
        self._loss = math.nan

    @property
    def seconds(self) -> float:
        """CPU time so far, in s."""
        return self._training.earlier + time.process_time() - self._begun

    def _on_step(self) -> bool:
        config = self._training.config
        if self.num_timesteps - self._looked >= config.check_every:
            self.look()
        best = math.nan if self._training.best is None else self._training.best.loss
        self._show(self.num_timesteps, f"held out {self._loss:.4g}, best {best:.4g}")
        spent = config.budget is not None and self.seconds >= config.budget
        return not (self._stopped or spent)

    def look(self) -> None:
        """Score the agent as it is, keep it if it is the best so far, and write a checkpoint."""
        training = self._training
        self._looked = training.model.num_timesteps
        agent = training.agent(math.nan, self.seconds)
        estimator = Sb3(training.system, agent.setup["noise_std"], trained=agent)
        first = training.seed + HELD_OUT
        played = play(training.game, estimator, range(first, first + training.config.held_out))
        scores = score(played.system, played.record, played.truth, played.estimates)
        parts = ("nrmse_modulo", "nrmse_tail_modulo")
        medians = {p: float(np.median(getattr(scores, p))) for p in parts}
        self._loss = math.sqrt(math.prod(medians.values()))
        for name, value in medians.items():
            self.logger.record(f"held_out/{name}", value)
        self.logger.record("held_out/diverged", float(scores.diverged.mean()))
        if training.best is None or self._loss < training.best.loss:
            training.best = training.agent(self._loss, self.seconds)
        self.logger.record("held_out/best", training.best.loss)
        self.logger.dump(self._looked)
        if self._checkpoint is not None:
            training.save(self._checkpoint, self.seconds)

    def result(self) -> TrainedAgent:
        """The best agent, with what all of the training took."""
        if self._training.best is None or self._looked != self._training.model.num_timesteps:
            self.look()
        best = self._training.best
        assert best is not None
        steps = self._training.model.num_timesteps
        config = asdict(self._training.config)
        return replace(best, iterations=steps, seconds=self.seconds, config=config)
