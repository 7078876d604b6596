"""The samples of a moving window."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pinnobs_gym.simulation.system import System


@dataclass(frozen=True)
class WindowSamples:
    """The times, outputs and inputs of a window's samples. The batch is the last axis."""

    t: np.ndarray
    """Times in s, shape (num_samples,)."""
    y: np.ndarray
    """Outputs, shape (num_samples, ny, batch); NaN marks a missing one."""
    u: np.ndarray
    """Inputs, shape (num_samples, nu, batch)."""

    @staticmethod
    def none(system: System, batch: int) -> WindowSamples:
        """Return no samples of a batch of episodes of a system."""
        y, u = (np.empty((0, size, batch)) for size in (system.ny, system.nu))
        return WindowSamples(np.empty(0), y, u)

    def __len__(self) -> int:
        return len(self.t)

    def extended(self, t: float, y: np.ndarray, u: np.ndarray) -> WindowSamples:
        """Return the samples with one more: y (batch, ny) and u (batch, nu) at time t (s)."""
        n = len(self.t)
        whole = np.empty(n + 1), *(np.empty((n + 1, *a.shape[1:])) for a in (self.y, self.u))
        for array, before, new in zip(
            whole, (self.t, self.y, self.u), (t, np.transpose(y), np.transpose(u)), strict=True
        ):
            array[:n], array[n] = before, new
        return WindowSamples(*whole)

    def without_first(self) -> WindowSamples:
        """Return the samples without the first one."""
        return WindowSamples(self.t[1:], self.y[1:], self.u[1:])

    def rows(self, rows: np.ndarray) -> WindowSamples:
        """Return the samples of some rows of the batch."""
        return WindowSamples(self.t, self.y[..., rows], self.u[..., rows])

    def at(self, k: int) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the time in s, the outputs (batch, ny) and the inputs (batch, nu) of a sample."""
        return float(self.t[k]), self.y[k].T, self.u[k].T
