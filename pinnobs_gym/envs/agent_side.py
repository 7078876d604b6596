"""The agent's interface to an env: its observations and the interpretation of its actions."""

from __future__ import annotations

import numpy as np

from pinnobs_gym.envs.actions import AgentMemory, Form, PredictionForm, form_of
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.simulation.values import is_whole, shortly


class AgentSide:
    """Converts between an agent and the episodes of an env: holds the form of the task, and the
    form's memory of the current episodes.

    Args:
        source: source of the episodes.
        action_mode: name of the form.
        reward: ``error`` or ``improvement``; see `pinnobs_gym.envs.env.EstimationEnv`.
        stack: number of the last outputs in an observation.
    """

    def __init__(self, source: EpisodeSource, action_mode: str, reward: str, stack: int) -> None:
        samples = source.setup.num_steps + 1
        if not is_whole(stack, 1) or stack > samples:
            raise ValueError(
                f"stack_outputs={shortly(stack)}; expected a whole number from 1 to {samples}, the "
                "samples of an episode"
            )
        mask = source.condition.loses_outputs
        self.form: Form = form_of(action_mode, source.system, source.setup, stack, mask)
        if reward not in ("error", "improvement"):
            raise ValueError(f"reward={shortly(reward)}; expected 'error' or 'improvement'")
        shape = self.form.action_space.shape
        assert shape is not None
        self.action_shape: tuple[int, ...] = shape
        """Shape of an action."""
        self.plain = action_mode == "estimate" and stack == 1 and reward == "error" and not mask
        """Whether actions and observations are those of `Episodes`, without a form between."""
        self.improves = reward == "improvement"
        if self.improves and not isinstance(self.form, PredictionForm):
            raise ValueError(f"reward='improvement' needs a prediction; {action_mode!r} has none")
        self._source = source
        self._memory: AgentMemory | None = None

    def begin(
        self, mean: np.ndarray, samples: np.ndarray, k: np.ndarray, rows: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the observations (batch, features) after a reset of rows, all if None.

        Args:
            mean: prior means, shape (batch, nx).
            samples: rows of `Episodes.observations`, shape (batch, ny + nu + 1).
            k: indices of the samples, shape (batch,).
            rows: the rows that are reset; the observations of the others do not change.
        """
        rows = np.arange(len(k)) if rows is None else rows
        if self._memory is None:
            self._features = np.empty((len(k), self.form.num_features), np.float32)
            rows = np.arange(len(k))
            self._memory = self._initial(mean)
        new = self._initial(mean[rows])
        self._features[rows], new = self.form.observe(new, *self._sample(samples[rows], k[rows]))
        self._memory = self._memory.with_rows(rows, new)
        return self._features.copy()

    def forget(self, mean: np.ndarray, rows: np.ndarray) -> None:
        """Start new episodes in rows (n,), whose first samples are observed later."""
        self._memory = self._playing.with_rows(rows, self._initial(mean[rows]))

    def observe(self, samples: np.ndarray, k: np.ndarray) -> np.ndarray:
        """Return the observations (batch, features) of the next samples; arguments as in
        `begin`."""
        with np.errstate(all="ignore"):  # actions may not be finite
            features, self._memory = self.form.observe(self._playing, *self._sample(samples, k))
        self._features = features.astype(np.float32)
        return self._features.copy()

    def act(self, actions: np.ndarray) -> np.ndarray:
        """Return the estimates (batch, nx) that result from actions."""
        self._before = self._playing
        self._memory = self.form.act(self._before, actions)
        return self._memory.xhat

    def improvement(self, xhat: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Return the reward of the last actions, (batch,); see `PredictionForm.improvement`."""
        assert isinstance(self.form, PredictionForm)
        return self.form.improvement(self._before, xhat, x)

    @property
    def _playing(self) -> AgentMemory:
        if self._memory is None:
            raise RuntimeError("no episode has begun; call reset before step")
        return self._memory

    def _initial(self, mean: np.ndarray) -> AgentMemory:
        inputs = np.broadcast_to(self._source.inputs[0], (len(mean), self._source.system.nu))
        return self.form.begin(mean, np.zeros(len(mean)), inputs)

    def _sample(
        self, samples: np.ndarray, k: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        y = samples[:, : self._source.system.ny].astype(float)
        if self._source.system.draws_input:
            u = samples[:, self._source.system.ny : -1].astype(float)
        else:
            u = self._source.inputs[k]
        return self._source.times[k], y, u
