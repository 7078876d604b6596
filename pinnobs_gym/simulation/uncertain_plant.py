"""A system that also estimates what the mismatch conditions change of its plant."""

from __future__ import annotations

from pinnobs_gym.simulation.augmented import augmented
from pinnobs_gym.simulation.augmented_system import Augmented, Unknown
from pinnobs_gym.simulation.conditions.plant import uncertain_parameters
from pinnobs_gym.simulation.system import System
from pinnobs_gym.simulation.values import is_finite, is_number, shortly


def with_uncertain_plant(system: System, deviation: float) -> Augmented | None:
    """Return a system in which what `Mismatch` changes of the plant are further states.

    These are its parameters (`uncertain_parameters`), each with its value as mean and
    ``deviation`` times the absolute value as standard deviation. A parameter that is 0 has no
    relative deviation and stays known. Of a plant without such parameters they are the relative
    deviations of all rates of change, with mean 0 and this standard deviation.

    Args:
        system: the system, with the parameters that are known of it.
        deviation: standard deviation of each relative deviation, above 0.

    Returns:
        The system from `augmented`; None if all of the parameters are 0, or if there are none and
        the plant moves by a flow of its own, whose rates cannot be changed.

    Raises:
        ValueError: in one line, if ``deviation`` is no number above 0, or as `augmented` does, of
            a parameter that cannot be a state.
    """
    if not (is_finite(deviation) and deviation > 0):
        raise ValueError(f"deviation={shortly(deviation)}; expected a number above 0")
    names = uncertain_parameters(system)
    if not names:
        if system.own_flow:
            return None
        return augmented(system, rates={n: Unknown(0.0, deviation) for n in system.state_names})
    unknown = {}
    for name in names:
        value = getattr(system, name)
        if not is_number(value):
            kind = type(system).__name__
            raise ValueError(f"parameter {name}={shortly(value)} of {kind}; expected a number")
        if value:
            unknown[name] = Unknown(float(value), deviation * abs(float(value)))
    return augmented(system, parameters=unknown) if unknown else None
