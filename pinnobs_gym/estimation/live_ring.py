"""The point of a live filter, and its latest samples with the points after them, among which a late
one can be put."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable

from pinnobs_gym.estimation.live_sample import Sample, check_after
from pinnobs_gym.estimation.live_steps import Point, Steps


class Ring:
    """The latest samples of one plant, in the order of their times.

    Args:
        size: largest number of samples; 0 if none is kept.
        base: the point before the first of them.
        kept: the samples, each with the point after it.
    """

    def __init__(self, size: int, base: Point, kept: Iterable[tuple[Sample, Point]] = ()) -> None:
        self.size, self.base, self.kept = size, base, list(kept)
        while len(self.kept) > size:
            self._drop()

    @property
    def latest(self) -> Point:
        """The point after the last sample."""
        return self.kept[-1][1] if self.kept else self.base

    def add(self, sample: Sample, point: Point) -> None:
        """Add the sample after all others, with the point after it."""
        if not self.size:
            self.base = point
            return
        self.kept.append((sample, point))
        if len(self.kept) > self.size:
            self._drop()

    def _drop(self) -> None:
        self.base = self.kept.pop(0)[1]

    def with_late(self, sample: Sample, steps: Steps, unit: str, longest_gap: float) -> Ring:
        """Return the ring with a sample between the others, and all samples after it processed
        anew.

        Args:
            sample: the sample.
            steps: the filter.
            unit: the unit of time.
            longest_gap: the longest time to the next sample, in that unit.

        Raises:
            ValueError: in one line, if there is a sample of that time, or the sample is older than
                all that are kept, too long before the first one, or not usable by the model.
        """
        t, kept = sample.t, self.kept
        place = bisect_left(kept, t, key=lambda each: each[0].t)
        if self.base.t is not None and t <= self.base.t:
            raise ValueError(
                f"t={t:.15g} {unit} is older than the latest {len(kept)} samples, which go back to "
                f"t={kept[0][0].t:.15g} {unit}; expected a later one, or a larger ring"
            )
        if kept[place][0].t == t:
            raise ValueError(
                f"a sample with t={t:.15g} {unit} was taken before; expected all outputs of one "
                "time in one sample"
            )
        check_after(kept[place][0].t, t, longest_gap, unit)
        point = kept[place - 1][1] if place else self.base
        moved = []
        for each in (sample, *(later for later, _ in kept[place:])):
            point = steps(point, each)
            moved.append((each, point))
        return Ring(self.size, self.base, [*kept[:place], *moved])
