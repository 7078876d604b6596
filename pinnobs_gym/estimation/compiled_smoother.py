"""The smoother of Rauch, Tung and Striebel in compiled code.

A row that the compiled code leaves to NumPy, because the filter does (`pinnobs_gym.estimation.
compiled`) or predicted covariances may be too near to singular, is smoothed in NumPy altogether.
Every row has the same result alone and in any batch.
"""

from __future__ import annotations

import ctypes
from ctypes import addressof

import numpy as np

from pinnobs_gym.estimation.compiled_code import library_of, noise_at, plan_of, rows_of_numbers
from pinnobs_gym.estimation.estimator import BaseEstimator, Estimates
from pinnobs_gym.estimation.smoother import LEAST
from pinnobs_gym.simulation.kernels.calls import address
from pinnobs_gym.simulation.kernels.plant_library import PlantLibrary
from pinnobs_gym.simulation.record import Record


def compiled_smoother(estimator: BaseEstimator) -> CompiledSmoother | str:
    """Return the compiled code of a smoother, or the reason in one line why there is none."""
    made = library_of(estimator)
    return made if isinstance(made, str) else CompiledSmoother(estimator, made)


class CompiledSmoother:
    """The compiled code of one smoother.

    Args:
        estimator: the smoother; its class names the template.
        made: the library.
    """

    def __init__(self, estimator: BaseEstimator, made: PlantLibrary) -> None:
        self._estimator, self._made = estimator, made
        self._rows = rows_of_numbers(estimator, made)
        self._plan = plan_of(estimator, made, estimator.noise.R(0.0)[None])
        self._smooth, self._entries = made.code.smooth, made.code.scratch_entries
        self._smooth.argtypes = [
            *(ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64, ctypes.c_double),
            *[ctypes.c_void_p] * 9,
        ]
        self._smooth.restype = None
        self._entries.argtypes, self._entries.restype = [ctypes.c_int64], ctypes.c_int64

    def run(self, record: Record) -> tuple[Estimates, np.ndarray] | None:
        """Return the estimates of a record, and the numbers of the rows that NumPy has to smooth;
        None if these are all."""
        batch, n, nx = record.batch, record.num_samples, self._estimator.system.nx
        if self._rows not in (1, batch):
            return None
        plan, noise = self._plan, self._estimator.noise
        if noise.samples is not None:
            plan = plan.with_R(noise_at(noise, record.t))
        prior = record.prior
        given = [
            np.ascontiguousarray(part, dtype=float)
            for part in (record.t, record.y, record.u, prior.mean, prior.cov)
        ]
        # Views of one array, because only a large one is allocated in large memory pages
        parts = np.empty(batch * n * (nx + nx * nx))
        xhat = parts[: batch * n * nx].reshape(batch, n, nx)
        P = parts[batch * n * nx :].reshape(batch, n, nx, nx)
        scratch, left = np.empty(self._entries(n)), np.empty(batch, dtype=np.int64)
        arrays = [*given, xhat, P, scratch, left]
        self._smooth(addressof(plan.structure), batch, n, LEAST, *map(address, arrays))
        return Estimates(xhat, P), np.flatnonzero(left)
