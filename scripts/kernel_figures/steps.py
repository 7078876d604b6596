"""The model of other libraries' filters: as many Runge-Kutta steps as ours, and the same noise."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.simulation.runge_kutta import longest_step
from pinnobs_gym.simulation.system import System

Function = Callable[[Any, Any, Any], Any]
"""f, h or the input of a system as a function of t, x and u, in the arrays of a library."""


def flow(system: System, dt: float, f: Function, given: Function) -> Callable[..., Any]:
    """Return the state x after a time of at most dt in s, from the time t on, as a function of x, t
    and that time, by as many Runge-Kutta steps as ours.

    Args:
        system: the model.
        dt: the time between samples in s.
        f: its equation.
        given: the input that it defines.
    """
    steps = max(1, round(float(np.ceil(dt / longest_step(system) - 1e-6))))

    def moved(x: Any, start: Any, ahead: Any) -> Any:
        part = ahead / steps
        for i in range(steps):
            t = start + i * part
            inputs = [given(t + c * part, x, None) for c in (0.0, 0.5, 1.0)]
            k1 = f(t, x, inputs[0])
            k2 = f(t + part / 2, x + part / 2 * k1, inputs[1])
            k3 = f(t + part / 2, x + part / 2 * k2, inputs[1])
            k4 = f(t + part, x + part * k3, inputs[2])
            x = x + part / 6 * (k1 + 2 * (k2 + k3) + k4)
        return x

    return moved


def matrices(ekf: EKF, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the covariances Q over a step of dt (s), and R."""
    L, R = ekf.noise.L(0.0)[..., 0], ekf.noise.R(0.0)[..., 0]
    return dt * L @ L.T, R
