"""The agent's side of an env: what it observes of the episodes, and what its actions mean."""

from __future__ import annotations

import numpy as np

from pinnobs_gym.envs.actions import AgentMemory, Form, PredictionForm, form_of
from pinnobs_gym.envs.episodes import EpisodeSource


class AgentSide:
    """What stands between an agent and the episodes of an env: the form of its actions and
    observations, and that form's memory of the episodes now playing.

    Args:
        source: where the episodes come from.
        action_mode: the form's name.
        reward: ``error`` or ``improvement``; see `pinnobs_gym.envs.env.EstimationEnv`.
        stack: how many of the last outputs an observation holds.
    """

    def __init__(self, source: EpisodeSource, action_mode: str, reward: str, stack: int) -> None:
        self.form: Form = form_of(action_mode, source.system, source.setup, stack)
        if reward not in ("error", "improvement"):
            raise ValueError(f"reward={reward!r}; expected 'error' or 'improvement'")
        shape = self.form.action_space.shape
        assert shape is not None
        self.action_shape: tuple[int, ...] = shape
        """Shape of an action."""
        self.plain = action_mode == "estimate" and stack == 1 and reward == "error"
        """Whether actions and observations are the env's own."""
        self.improves = reward == "improvement"
        if self.improves and not isinstance(self.form, PredictionForm):
            raise ValueError(f"reward='improvement' needs a prediction; {action_mode!r} has none")
        self._source = source
        self._memory: AgentMemory | None = None

    def begin(
        self, mean: np.ndarray, samples: np.ndarray, k: np.ndarray, rows: np.ndarray | None = None
    ) -> np.ndarray:
        """The observations (batch, features) after a reset of rows, all if None.

        Args:
            mean: prior means, shape (batch, nx).
            samples: the env's own observations, shape (batch, ny + nu + 1).
            k: numbers of the samples, shape (batch,).
            rows: those reset; the others observe what they did.
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
        """Begin the episodes of rows (n,) anew, whose first samples are still to be looked at."""
        self._memory = self._playing.with_rows(rows, self._initial(mean[rows]))

    def observe(self, samples: np.ndarray, k: np.ndarray) -> np.ndarray:
        """The observations (batch, features) of the next samples; arguments as in `begin`."""
        with np.errstate(all="ignore"):  # rows whose action was not finite
            features, self._memory = self.form.observe(self._playing, *self._sample(samples, k))
        self._features = features.astype(np.float32)
        return self._features.copy()

    def act(self, actions: np.ndarray) -> np.ndarray:
        """The estimates (batch, nx) that actions mean."""
        self._before = self._playing
        self._memory = self.form.act(self._before, actions)
        return self._memory.xhat

    def improvement(self, xhat: np.ndarray, x: np.ndarray) -> np.ndarray:
        """The reward of the last actions, (batch,); see `PredictionForm.improvement`."""
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
        return self._source.times[k], y, self._source.inputs[k]
