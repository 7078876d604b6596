"""The output noise that filters assume."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pinnobs_gym.estimation.notices import say_once
from pinnobs_gym.simulation.system import NOISE_FLOOR, System, output_noise, output_scale


def assumed_noise(system: System, noise_std: Sequence[float] | float | None) -> np.ndarray:
    """Return the standard deviations (ny,) of the output noise in R, in output units.

    They are those given, or those of the setup ``benchmark`` if None. Filters need a positive
    definite R: where one is exactly zero, `NOISE_FLOOR` of the output's scale takes its place, and
    the log says so once.

    Raises:
        ValueError: in one line, if one is not finite, negative, or their number is not ny.
    """
    std = output_noise(system, noise_std)
    if std.all():
        return std
    raised = np.where(std == 0, NOISE_FLOOR * output_scale(system), std)
    values = zip(system.output_names, std, raised, strict=True)
    parts = ", ".join(f"{name}: {value:g}" for name, own, value in values if own == 0)
    say_once(
        f"{type(system).__name__}: the output noise is zero; filters assume the standard "
        f"deviations {parts}"
    )
    return raised
