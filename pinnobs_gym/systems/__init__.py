"""The systems, one file each. A file added here is registered as an env, checked and ranked."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from pinnobs_gym.registry import Registry

if TYPE_CHECKING:
    from pinnobs_gym.simulation.system import System


class Systems(Registry["System"]):
    """The systems by class name. An env id, with or without its namespace, stands for its system
    wherever a name does."""

    def resolve(self, spec: str | type[System], near: type | None = None) -> type[System]:
        found = re.fullmatch(r"(?:pinnobs_gym:)?(?:pinnobs/)?(\w+)-v(\d+)", str(spec))
        if found is None or found[1] not in {*self.sources, *self._known}:
            return super().resolve(spec, near)
        cls = super().resolve(found[1], near)
        if cls.version != int(found[2]):
            known = f"pinnobs/{cls.__name__}-v{cls.version}"
            raise ValueError(f"unknown env id {spec!r}; that of {cls.__name__} is {known}")
        return cls


SYSTEMS: Registry[System] = Systems(
    "system", "pinnobs_gym.simulation.system:System", __name__, "state_names", "setups"
)
"""All systems by class name."""
