"""Envs as tests make them."""

from __future__ import annotations

from typing import Any

import gymnasium

from pinnobs_gym.envs.registration import env_id
from pinnobs_gym.systems import SYSTEMS

IDS = {name: env_id(cls) for name, cls in SYSTEMS.classes().items()}


DUFFING, MOTOR = IDS["ReverseDuffing"], IDS["InductionMotor"]


ALLOWED_WARNINGS = (
    # outputs are noisy, and so have no bounds
    "A Box observation space minimum value is -infinity",
    "A Box observation space maximum value is infinity",
    # actions are estimates in physical units
    "For Box action spaces, we recommend using a symmetric and normalized space",
    "We recommend you to use a symmetric and normalized Box action space",
)


def make(name: str, **kwargs: Any) -> Any:
    return gymnasium.make(name, disable_env_checker=True, **kwargs)


def make_vec(name: str, num_envs: int, **kwargs: Any) -> Any:
    return gymnasium.make_vec(name, num_envs=num_envs, **kwargs)


def short(name: str, steps: int = 12) -> dict[str, float]:
    """Arguments that make episodes of that many steps."""
    dt = SYSTEMS.resolve(name).setups["benchmark"].dt
    return {"duration": steps * dt}
