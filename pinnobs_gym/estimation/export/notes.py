"""What the user of exported code should know."""

from __future__ import annotations

from pinnobs_gym.simulation.kernels.plant_code import PlantCode


def notes_of(code: PlantCode, float32: bool, measured_input: bool) -> tuple[str, ...]:
    """Return what the user of exported equations should know, a line each.

    Args:
        code: the equations.
        float32: whether numbers are of single precision.
        measured_input: whether inputs are given with each sample.
    """
    timed_input = not measured_input and "= now;" in code.once
    if not float32 or not (timed_input or "= times[l];" in code.lanes):
        return ()
    return (
        "the equations contain t, of which single precision keeps 7 digits: give times since a "
        "start that is not long ago, or export without --float32",
    )
