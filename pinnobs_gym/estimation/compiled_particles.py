"""The particle filter in compiled code; see `pinnobs_gym.estimation.compiled_members`."""

from __future__ import annotations

import ctypes
from typing import Any, TypeAlias

import numpy as np

from pinnobs_gym.estimation.compiled_layout import contiguous
from pinnobs_gym.estimation.compiled_members import LEFT, SetCall, SetCode, place
from pinnobs_gym.estimation.estimator import Estimates, State
from pinnobs_gym.estimation.regularisation import Sample, shrinkages
from pinnobs_gym.simulation.kernels.plant_library import PlantLibrary
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.truth import rows_of

_TEMPERED, _FEW, _COLLAPSED = 2, 4, 8
"""Marks of rows whose particles are to be resampled, in tempering or after the sample, and of those
with too many collapses; see ``members.c``."""
_Given: TypeAlias = tuple[np.ndarray, np.ndarray, bytes]
"""Outputs (batch, ny), inputs (batch, nu), and the outputs in the layout of compiled code."""


class CompiledParticles:
    """The compiled code of one estimator.

    Args:
        estimator: a `pinnobs_gym.estimators.particle.ParticleFilter`.
        made: its library.
        rounds: largest number of tempering steps per sample.
        few: the likelihood is tempered below this effective number of particles.
        collapsed: an effective number below this one is a collapse.
    """

    def __init__(
        self, estimator: Any, made: PlantLibrary, rounds: int, few: float, collapsed: float
    ) -> None:
        system, count = estimator.system, estimator.particles
        self._estimator, self._count, self._rounds = estimator, count, rounds
        self._nx, self._nu = system.nx, system.nu
        self._depends = estimator.discount is None and estimator.noise.stochastic
        self._usual = {tempering: estimator.shrinkage(tempering) for tempering in (False, True)}
        shapes = [(system.nx, count), (count,), (), ()]
        self._sets = SetCode(
            estimator, made, count, shapes, num_more=system.nx, few=few, collapsed=collapsed
        )
        self._begin, self._resample = made.code.begin, made.code.resample
        self._begin.argtypes = [ctypes.c_void_p] * 3
        self._resample.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64]
        self._begin.restype = self._resample.restype = ctypes.c_int64

    def update(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State | None:
        """Return the state after a sample; None if NumPy has to process it. The arguments are those
        of `Estimator.update`."""
        sets, sample = self._sets, state.memory.sample
        call = sets.call(state, t, (2, sample))
        if call is None:
            return None
        outputs, structure = contiguous(y), call.structure
        structure.rounds = self._rounds
        structure.most = self._estimator.most_collapses(sample)
        found = self._begin(call.place, outputs, contiguous(u) if self._nu else None)
        if found < 0:
            return None
        if found & _COLLAPSED:
            self._estimator.say_that_it_collapses()
        if found & (_TEMPERED | _FEW):
            found = self._resampled(state, call, (y, u, outputs), found)
            if found < 0:
                return None
        return sets.after(state, call, y, u, left=bool(found & LEFT))

    def run(self, record: Record) -> Estimates | None:
        """Return None: records are processed sample by sample, each of which has its own random
        numbers."""
        return None

    def _resampled(self, state: State, call: SetCall, given: _Given, found: int) -> int:
        """Resample the particles of rows in which it is to be done, and return what remains to be
        done; -1 if NumPy has to process the sample."""
        step, sample = 0, state.memory.sample
        while found > 0 and found & _TEMPERED:
            call.structure.rounds = self._rounds - step - 1
            found = self._round(state, call, given, _TEMPERED, (1, sample, step))
            step += 1
        if found > 0 and found & _FEW:
            found = self._round(state, call, given, _FEW, (1, sample, self._rounds))
        return found

    def _round(
        self, state: State, call: SetCall, given: _Given, kind: int, stream: tuple[int, ...]
    ) -> int:
        """Resample the rows of a mark with the numbers of a random stream, as `_resampled`."""
        y, u, outputs = given
        structure, shrinkage = call.structure, self._shrinkages(state, call, y, u, kind)
        rng = self._sets.streams.at(*stream)
        structure.uniform = rng.random()
        normal = rng.standard_normal((self._count, self._nx))
        structure.more, structure.shrinkage = place(normal), place(shrinkage)
        return self._resample(call.place, outputs, kind)

    def _shrinkages(
        self, state: State, call: SetCall, y: np.ndarray, u: np.ndarray, kind: int
    ) -> np.ndarray:
        """Return by how much centres of kernels are shrunk in the rows of a mark, (batch,); see
        `pinnobs_gym.estimation.regularisation.shrinkages`."""
        tempering = kind == _TEMPERED
        batch = len(state.xhat)
        if not (self._depends and state.t is not None):
            return np.full(batch, self._usual[tempering])
        rows = np.flatnonzero(call.marks() == kind)
        system, noise = rows_of(self._estimator.system, rows), self._estimator.noise
        sample = Sample.of(noise, state.t, call.structure.t, y, u).rows(rows)
        moments = call.layout.layout.arrays(call.buffer)
        mean, P = (np.ascontiguousarray(moments[name][rows]) for name in ("xhat", "P"))
        shrinkage = np.ones(batch)
        shrinkage[rows] = shrinkages(system, sample, mean, P, tempering=tempering)
        return shrinkage
