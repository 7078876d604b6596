"""The systems, one file each. A file added here is registered as an env, checked and ranked."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pinnobs_gym.registry import Registry

if TYPE_CHECKING:
    from pinnobs_gym.simulation.system import System

SYSTEMS: Registry[System] = Registry(
    "system", "pinnobs_gym.simulation.system:System", __name__, "state_names", "setups"
)
"""All systems by class name."""
