"""The plants, one file each. A file put here is found, registered as an env, checked and ranked."""

from pinnobs_gym.registry import Registry
from pinnobs_gym.system import System

SYSTEMS: Registry[System] = Registry("system", System, __name__)
"""All systems by class name."""
