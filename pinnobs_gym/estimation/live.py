"""An online estimator that runs on one plant while it is measured, sample by sample."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from pinnobs_gym.estimation.estimator import Estimator
from pinnobs_gym.estimation.live_estimate import Estimate
from pinnobs_gym.estimation.live_file import damaged, read, write
from pinnobs_gym.estimation.live_ring import Ring
from pinnobs_gym.estimation.live_sample import Sample, check_after, sample_of
from pinnobs_gym.estimation.live_start import check_online, check_settings, prepare, prior_of
from pinnobs_gym.estimation.live_steps import Steps, state_of, steps_of
from pinnobs_gym.simulation.system import System

Late: TypeAlias = Literal["refuse", "replay"]
"""What is done with a sample that is earlier than the last one."""
LONGEST_GAP = 500
"""Longest time between two samples, over the ``dt`` of the setup ``benchmark``, if none is given.
Milliseconds that are taken for seconds are a thousand of it."""


class Live:
    """A filter that runs: an online estimator with its state, on one plant.

    ```python
    live = Live(EKF(system), xhat0=(1.0, 0.0), P0=independent(0.5, 0.5))
    estimate = live.update(t=0.02, y=0.98)
    estimate.xhat, estimate.std, estimate.nis
    ```

    All that takes long is done here: modules are imported, code is compiled, gains are designed,
    and the first steps of the estimator are tried. A sample then takes the estimator's own time.

    A sample that is refused, by a ``ValueError`` of one line, changes nothing. One ``Live`` serves
    one thread: two threads that give it samples at once need a lock of their own.

    Args:
        estimator: an online estimator of the model; a learned one is loaded from its file first.
        xhat0: initial estimate (nx,) in state units, or one number for all; that of the system's
            setup ``benchmark`` if None.
        P0: its covariance (nx, nx), such as `pinnobs_gym.simulation.system.independent` makes from
            standard deviations; that of the setup if None.
        late: ``refuse`` samples that are not later than the last one, or ``replay``: put them where
            they belong, and process those after them anew.
        ring: number of the latest samples among which a late one can be put.
        longest_gap: longest time in s from one sample to the next; `LONGEST_GAP` times the setup's
            ``dt`` if None.

    Raises:
        ValueError: in one line, if the estimator is not an online one of one plant, or a value is
            not what was expected.
        TypeError: in one line, if the first argument is no estimator.
    """

    def __init__(
        self,
        estimator: Estimator,
        xhat0: Sequence[float] | np.ndarray | float | None = None,
        P0: Sequence[Sequence[float]] | np.ndarray | None = None,
        *,
        late: Late = "refuse",
        ring: int = 64,
        longest_gap: float | None = None,
    ) -> None:
        check_online(estimator)
        self.estimator = estimator
        self._system: System = estimator.system
        dt = float(self._system.setups["benchmark"].dt)
        self._longest_gap = LONGEST_GAP * dt if longest_gap is None else longest_gap
        check_settings(late, ring, self._longest_gap)
        begun = estimator.reset(prior_of(self._system, xhat0, P0))
        self._steps: Steps = steps_of(estimator)
        prepare(estimator, self._steps, begun, dt)
        self._ring = Ring(ring if late == "replay" else 0, begun)

    @property
    def t(self) -> float | None:
        """Time of the last sample in s; None before the first."""
        return self._ring.latest.t

    def update(
        self,
        t: float,
        y: Sequence[float] | np.ndarray | float,
        u: Sequence[float] | np.ndarray | float | None = None,
    ) -> Estimate:
        """Process a sample, and return the estimate after it.

        Args:
            t: time in s, a whole number for a map. At the first sample, the prior is the
                prediction, whatever the time.
            y: outputs (ny,), NaN where one is missing; a number is taken for one output.
            u: inputs (nu,), likewise. If the system defines them (`System.input`), None stands for
                these; a system with `System.measured_input` needs them at every sample.

        Returns:
            The estimate at the time of the last sample, which is another one if this is late.

        Raises:
            ValueError: in one line that names the value and what was expected, if a shape or a
                number is wrong, the time is not later than that of the last sample (see ``late``)
                or later by more than ``longest_gap``, or the model would take too many steps. The
                filter is as it was before.
        """
        sample, point = sample_of(self._system, t, y, u), self._ring.latest
        last = point.t
        if last is not None:
            if not sample.t > last:
                return self._replayed(sample, last)
            if not sample.t - last <= self._longest_gap:
                check_after(sample.t, last, self._longest_gap, self._system.time_unit)
        point = self._steps(point, sample)
        self._ring.add(sample, point)
        return Estimate(point, sample.y)

    def predict(self, t: float, u: Sequence[float] | np.ndarray | float | None = None) -> Estimate:
        """Return the estimate at a time after the last sample, and leave the filter as it is.

        Args:
            t: the time in s.
            u: inputs at that time, if they are measured and known; those of the last sample if
                None.

        Raises:
            ValueError: in one line, as by `update`, or before the first sample.
        """
        last, system = self._ring.latest.t, self._system
        if last is None:
            raise ValueError(f"t={t!r} is before the first sample, at which the prior holds")
        sample = self._without_outputs(t, u)
        if not sample.t > last:
            raise ValueError(
                f"t={sample.t:.15g} {system.time_unit} is not after the last sample, "
                f"t={last:.15g} {system.time_unit}; expected a later time"
            )
        check_after(sample.t, last, self._longest_gap, system.time_unit)
        return Estimate(self._steps(self._ring.latest, sample), sample.y)

    def _without_outputs(self, t: Any, u: Any = None) -> Sample:
        """Return a sample of which all outputs are missing; the arguments are those of
        `predict`."""
        system = self._system
        if u is None and system.measured_input and system.nu:
            u = np.asarray(state_of(self._ring.latest).u)[0]
        return sample_of(system, t, [float("nan")] * system.ny, u)

    def _replayed(self, sample: Sample, last: float) -> Estimate:
        """Return the estimate at the time of the last sample, ``last`` in s, after a late one."""
        unit = self._system.time_unit
        if not self._ring.size:
            raise ValueError(
                f"t={sample.t:.15g} {unit} is not after the last sample, t={last:.15g} {unit}; "
                "expected a later one, or Live(..., late='replay')"
            )
        self._ring = self._ring.with_late(sample, self._steps, unit, self._longest_gap)
        latest, point = self._ring.kept[-1]
        return Estimate(point, latest.y)

    def __reduce_ex__(self, protocol: Any) -> Any:
        raise TypeError(
            "a Live is neither copied nor pickled, as copies would share its state; save() it, and "
            "Live.load() the file"
        )

    def save(self, path: str | Path) -> None:
        """Write the filter to a file: arrays and plain values, with what the estimator and its
        model are. A file of that name is replaced at once, or stays as it is.

        Raises:
            ValueError: in one line, if the file cannot be written, or the estimator remembers what
                no file can hold.
        """
        ring = self._ring
        kept = [(*sample, state_of(point)) for sample, point in ring.kept]
        content = {
            "late": "replay" if ring.size else "refuse",
            "ring": max(ring.size, 1),
            "longest_gap": self._longest_gap,
            "base": state_of(ring.base),
            "kept": [list(each) for each in kept],
        }
        write(Path(path), self.estimator, content)

    @classmethod
    def load(cls, path: str | Path, estimator: Estimator) -> Live:
        """Return the filter in a file, which goes on where it was saved: the next estimates are
        those without the break.

        Args:
            path: path of a file that `save` wrote.
            estimator: the same estimator, with the same settings, noise and model; a file holds no
                code.

        Raises:
            ValueError: in one line, if the file is not one of that estimator and model, which names
                what differs, is of another version, or damaged.
        """
        check_online(estimator)
        content = read(Path(path), estimator)
        try:
            settings = {name: content[name] for name in ("late", "ring", "longest_gap")}
            live = cls(estimator, **settings)
            kept = [(Sample(*sample), state) for *sample, state in content["kept"]]
            live._continue(Ring(live._ring.size, content["base"], kept))
        except Exception as error:  # whatever an estimator makes of states that are none
            raise damaged(Path(path), error) from None
        return live

    def _continue(self, ring: Ring) -> None:
        """Go on from the samples and points of a file, which are tried first."""
        begun = state_of(self._ring.latest)
        for point in (ring.base, *(point for _, point in ring.kept)):
            for name in ("xhat", "P"):
                shapes = [np.shape(getattr(state, name)) for state in (point, begun)]
                if shapes[0] != shapes[1]:
                    raise ValueError(f"{name} has shape {shapes[0]}; expected {shapes[1]}")
        self._ring = ring
        if self.t is not None:
            dt = float(self._system.setups["benchmark"].dt)
            later = max(self.t + dt, float(np.nextafter(self.t, np.inf)))
            self._steps(ring.latest, self._without_outputs(later))
