"""Equations at the bounds of states: where they are not finite, or their slopes nearly infinite."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pinnobs_gym.simulation.system import Setup, System, initial_states, vector

_POINTS = 16
"""Number of states at which a bound is tried."""
_NEAR, _FURTHER = 1e-8, 1e-2
"""Distances from a bound, over the scale, between which slopes are compared; the smaller one is
also the width of their differences."""
_STEEP = 30.0
"""Ratio of the slopes from which on that at the bound counts as nearly infinite: that of √x is
1000, that of a function that is smooth over the scale about 1."""
_SMALL = 0.01
"""Change of a rate over a sample, in scales, or of an output relative to its size, that does not
count, per change of a state by its scale."""


def faults_at_bounds(system: System, setup: Setup) -> list[str]:
    """Return a line for each of f and h that is not finite at a state within the bounds, or has a
    slope at a bound that is not finite or at least 30 times that a hundredth of the scale inside,
    as √x has at 0; the state and the bound that come first are named.

    A model that linearises there, or takes differences, is wrong by orders of magnitude. The states
    are those of the initial set with one component at its bound or, if it has two, between them.
    Slopes are differences to the inside, so that nothing is evaluated outside of the bounds.
    """
    box = system.state_box
    if box is None:
        return []
    x0 = box.clipped(initial_states(system, setup, _POINTS))
    now = np.zeros(_POINTS)
    u = np.asarray(system.input(now))
    scale = vector(system.scale, system.nx, "scale")
    size = scale if system.discrete else scale / setup.dt
    with np.errstate(all="ignore"):
        output = np.maximum(abs(np.asarray(system.h(now, x0, u))).max(axis=0), 1e-300)
        found = (
            _fault(system, "f", lambda x: np.asarray(system.f(now, x, u)), x0, size),
            _fault(system, "h", lambda x: np.asarray(system.h(now, x, u)), x0, output),
        )
    return [line for line in found if line is not None]


def _fault(
    system: System,
    name: str,
    function: Callable[[np.ndarray], np.ndarray],
    x0: np.ndarray,
    size: np.ndarray,
) -> str | None:
    """Return the line for a function of states (batch, nx), whose values have sizes (m,)."""
    box, scale = system.state_box, vector(system.scale, system.nx, "scale")
    assert box is not None
    of = f"{type(system).__name__}.{name}"
    for i, state in enumerate(system.state_names):
        for what, bound, inwards in (
            ("state_low", box.low[i], 1.0),
            ("state_high", box.high[i], -1.0),
        ):
            if not np.isfinite(bound):
                continue

            def at(distance: float, i: int = i, bound: float = bound, way: float = inwards):
                x = x0.copy()
                x[:, i] = bound + way * distance * scale[i]
                return function(box.clipped(x))

            width = (box.high[i] - box.low[i]) / scale[i]
            between = width * np.array([0.25, 0.5, 0.75]) if np.isfinite(width) else ()
            for distance in (0.0, _FURTHER, *between):
                if not np.isfinite(at(distance)).all():
                    where = f"{state}={bound + inwards * distance * scale[i]:g}"
                    return (
                        f"{of} is not finite at {where}, within its bounds ({what}={bound:g}); "
                        "expected numbers wherever a state may be"
                    )
            slopes = [
                abs(at(d + _NEAR) - at(d)).max(axis=0) / _NEAR / size for d in (0.0, _FURTHER)
            ]
            steep = slopes[0] > _STEEP * np.maximum(slopes[1], _SMALL)
            if steep.any():
                k = int(np.argmax(steep))
                ratio = slopes[0][k] / max(slopes[1][k], _SMALL)
                return (
                    f"{of} is at least {ratio:.0f} times as steep in {state} at {what}={bound:g} "
                    f"as {_FURTHER:g} of the scale inside; filters that linearise there fail: "
                    f"smooth it, such as sqrt(maximum(x, 1e-4)) in place of sqrt(x)"
                )
    return None
