"""The settings of the trainer of agents."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, TypeAlias, get_args

from pinnobs_gym.training.loop import expect

Algorithm: TypeAlias = Literal["ppo", "sac", "td3", "recurrent_ppo"]
Mode: TypeAlias = Literal["gain", "correction", "normalized"]

_ON_POLICY = {
    "rows": 64,
    "learning_rate": 1e-3,
    "rollout": 64,
    "batch": 512,
    "epochs": 10,
    "gamma": 0.0,
    "width": 32,
    "log_std": -1.0,
    "buffer": 0,
    "stack": 1,
}
_OFF_POLICY = {
    **_ON_POLICY,
    "rows": 32,
    "rollout": 4,
    "epochs": 4,
    "log_std": -1.0,
    "buffer": 300_000,
}
_STACK = {"stack": 8}
DEFAULTS: dict[tuple[str, str], dict[str, Any]] = {
    ("ppo", "gain"): _ON_POLICY,
    ("ppo", "correction"): _ON_POLICY,
    ("ppo", "normalized"): {**_ON_POLICY, **_STACK, "width": 64},
    ("sac", "gain"): _OFF_POLICY,
    ("sac", "correction"): _OFF_POLICY,
    ("sac", "normalized"): {**_OFF_POLICY, **_STACK, "width": 64},
    ("td3", "gain"): _OFF_POLICY,
    ("td3", "correction"): _OFF_POLICY,
    ("td3", "normalized"): {**_OFF_POLICY, **_STACK, "width": 64},
    ("recurrent_ppo", "gain"): _ON_POLICY,
    ("recurrent_ppo", "correction"): _ON_POLICY,
    ("recurrent_ppo", "normalized"): {**_ON_POLICY, "width": 64},
}
"""What a setting left at None becomes, by algorithm and action mode; the same for all systems.
Those of PPO with gains were tuned, on episodes that are not scored; the others begin from there."""


@dataclass(frozen=True)
class Config:
    """How an agent is trained. What is left at None is the default of the algorithm and action
    mode, see `DEFAULTS`."""

    algorithm: Algorithm = "ppo"
    """The algorithm; recurrent_ppo needs the extra ``rl``."""
    action_mode: Mode = "gain"
    """What the agent's actions mean; see `pinnobs_gym.envs.actions`."""
    steps: int = 300_000
    """Most steps of training, those of all rows together; only whole rollouts are made."""
    rows: int | None = None
    """Episodes that are played side by side."""
    learning_rate: float | None = None
    """Step of Adam at first; it falls to nearly zero in a straight line over the steps."""
    rollout: int | None = None
    """Steps of each row from one improvement of the agent to the next."""
    batch: int | None = None
    """Samples of a gradient."""
    epochs: int | None = None
    """Passes through a rollout's samples; off-policy, gradients after each rollout."""
    gamma: float | None = None
    """Discount. An estimate never acts on the plant: with 0 each action is judged by what it does
    to the error at its own sample."""
    width: int | None = None
    """Neurons in each of two hidden layers, and in the recurrent one."""
    log_std: float | None = None
    """Logarithm of the exploration's standard deviation, in actions, at first (td3: always)."""
    buffer: int | None = None
    """Samples that off-policy algorithms keep."""
    stack: int | None = None
    """How many of the last outputs the agent sees, with ``normalized``."""
    seed: int = 0
    """What weights, exploration and episodes are drawn from."""
    budget: float | None = None
    """CPU seconds after which training stops, those before a resumption included."""
    held_out: int = 32
    """Episodes that only decide which agent is kept."""
    check_every: int = 30_000
    """Steps from one look at these to the next; a checkpoint is written then, too."""

    episodes: ClassVar[int] = 0
    """It plays its own episodes."""

    def __post_init__(self) -> None:
        for name, kind in (("algorithm", Algorithm), ("action_mode", Mode)):
            known = get_args(kind)
            expect(self, name, " or ".join(known), lambda v, known=known: v in known)
        for name in ("steps", "held_out", "check_every", *_COUNTS):
            self._expect(name, "a whole number of at least 1", lambda v: v == int(v) and v >= 1)
        for name in ("seed", "buffer"):
            self._expect(name, "a whole number of at least 0", lambda v: v == int(v) and v >= 0)
        self._expect("learning_rate", "a positive number", lambda v: 0 < v < math.inf)
        self._expect("gamma", "a number from 0 to 1", lambda v: 0 <= v <= 1)
        self._expect("log_std", "a finite number", math.isfinite)
        self._expect("budget", "None or positive seconds", lambda v: v > 0)
        if self.action_mode != "normalized":
            self._expect("stack", "1, since there is a prediction", lambda v: v == 1)

    def _expect(self, name: str, expected: str, fits: Callable[[Any], bool]) -> None:
        expect(self, name, expected, lambda v: v is None or fits(v))

    def filled(self) -> Config:
        """The same with every None but the budget replaced by its default.

        Raises:
            ValueError: in one line, if settings do not fit each other.
        """
        defaults = DEFAULTS[self.algorithm, self.action_mode]
        left = {n: v for n, v in defaults.items() if getattr(self, n) is None}
        config = replace(self, **left)
        if self.algorithm in ("ppo", "recurrent_ppo"):
            samples: int = config.rows * config.rollout  # pyright: ignore
            expected = f"a divisor of rows·rollout = {samples}"
            expect(config, "batch", expected, lambda v: v > 1 and samples % v == 0)
        return config


_COUNTS = ("rows", "rollout", "batch", "epochs", "width", "stack")
