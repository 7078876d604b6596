"""The ensemble Kalman filter in compiled code; see `pinnobs_gym.estimation.compiled_members`."""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING, Any

import numpy as np

from pinnobs_gym.estimation.compiled_layout import contiguous
from pinnobs_gym.estimation.compiled_members import SetCode, place
from pinnobs_gym.estimation.estimator import Estimates, State
from pinnobs_gym.simulation.kernels.plant_library import PlantLibrary
from pinnobs_gym.simulation.record import Record

if TYPE_CHECKING:
    from pinnobs_gym.estimation.recursive import RecursiveEstimator


class CompiledEnsemble:
    """The compiled code of one estimator.

    Args:
        estimator: a `pinnobs_gym.estimators.enkf.EnKF` without localisation.
        made: its library.
    """

    def __init__(self, estimator: Any, made: PlantLibrary) -> None:
        self._estimator: RecursiveEstimator = estimator
        self._nu, self._members = estimator.system.nu, estimator.members
        self._by_sample = estimator.noise.samples is not None
        self._G = np.ascontiguousarray(estimator.noise.G(0.0))
        self._numbers = self._G.shape[1]
        self._sets = SetCode(
            estimator,
            made,
            self._members,
            [(estimator.system.nx, self._members), ()],
            num_more=self._numbers,
            inflation=estimator.inflation,
        )
        self._code = made.code.ensemble
        self._code.argtypes, self._code.restype = [ctypes.c_void_p] * 3, ctypes.c_int64

    def update(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State | None:
        """Return the state after a sample; None if NumPy has to process it. The arguments are those
        of `Estimator.update`."""
        sets, sample = self._sets, state.memory.sample
        call = sets.call(state, t, (2 * sample + 1,))
        if call is None:
            return None
        more = sets.streams.at(2 * sample + 2).standard_normal((self._members, self._numbers))
        G = self._G
        if self._by_sample:
            G = np.ascontiguousarray(self._estimator.noise.G(t))
        structure = call.structure
        structure.more, structure.G, structure.G_rows = place(more), place(G), G.shape[2] > 1
        left = self._code(call.place, contiguous(y), contiguous(u) if self._nu else None)
        return None if left < 0 else sets.after(state, call, y, u, left=left > 0)

    def run(self, record: Record) -> Estimates | None:
        """Return None: records are processed sample by sample, each of which has its own random
        numbers."""
        return None
