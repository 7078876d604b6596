"""What the tests of an output's innovations say together.

A warning takes a probability below `CHANCE`, so that a right log is not blamed by chance, and an
effect that matters, so that a long log of a nearly right model is not blamed either.
"""

from __future__ import annotations

from dataclasses import dataclass

from pinnobs_gym.logs.innovation_tests import Correlation, Drift, Size
from pinnobs_gym.logs.input_tests import Driven
from pinnobs_gym.logs.outlier_tests import Outliers

CHANCE = 1e-4
"""Probability, over all outputs, below which something is not taken for chance."""
USUAL = (0.5, 2.0)
"""Range of the median of normalised squares over their expectation that is usual."""
CORRELATED = 0.3
"""Size of a correlation, of neighbours or with an input, from which on it matters."""
DRIFTING = 3.0
"""Variance of means of blocks, over that of white values, from which on it matters."""
MANY = 0.01
"""Share of values beyond the bound of outliers from which on it matters."""
EXTREME = 20.0
"""Standard deviations of a value from which on even a single one matters: the next estimate is off
by more than its own standard deviations say, unless outputs hardly move it."""
DISTURBED = 0.5
"""Largest correlation of neighbours that single wrong outputs explain."""
SINGLE = 3.0
"""Number of samples over which such values come together below which they are single wrong outputs,
with what each does to the next estimates."""
_PASSING = ("unexplained", "slow", "driven", "bursts")
"""Verdicts on a model or a filter that may fail at first only."""
_HINT = 0.01
"""Probability below which the second half may be wrong, too."""


@dataclass(frozen=True)
class OutputTests:
    """The tests of one output."""

    name: str
    """Name of the output."""
    size: Size
    """Size of its values: innovations or residuals."""
    correlation: Correlation
    """Correlation of each value with the next."""
    drift: Drift
    """Drift of the means of blocks of values."""
    outliers: Outliers
    """Outliers among the values."""
    when: tuple[str, ...]
    """Times of the first, the last and the largest outlier."""
    driven: Driven
    """How well an input tells the values."""
    small_tells: bool
    """Whether values that are too small speak against the noise."""
    white: bool
    """Whether values of a right model are uncorrelated."""
    of_filter: bool
    """Whether these are innovations with covariances; otherwise residuals."""
    begin: str
    """Time of the first value."""
    later: OutputTests | None = None
    """The tests of the second half of the values, if they are enough."""

    def verdict(self, chance: float) -> str:
        """Return what is wrong, a key of `pinnobs_gym.logs.meanings.MEANINGS`; an empty text if
        nothing is. It is "early", which is no fault of the log, where a model or a filter fails in
        the whole, but the second half of the values passes every test.

        Args:
            chance: probability below which something is not taken for chance.
        """
        found, later = self._verdict(chance), self.later
        passing = found in _PASSING and later is not None and later._fits
        return "early" if passing else found

    @property
    def _fits(self) -> bool:
        """Whether nothing hints at a wrong model, however small its effect."""
        chances = [self.drift.chance, self.driven.chance]
        chances += [self.correlation.chance] if self.correlation.value > 0 else []
        usual = USUAL[0] <= self.size.median <= USUAL[1] and self.outliers.share <= MANY
        usual &= self.outliers.largest <= EXTREME
        return usual and min(chances) >= _HINT

    def _verdict(self, chance: float) -> str:
        """Return the verdict on all values; see `verdict`."""
        size, r, out = self.size, self.correlation, self.outliers
        lasting = r.chance < chance and r.value > CORRELATED
        alike = self.white and lasting
        alike |= self.white and self.drift.chance < chance and self.drift.ratio > DRIFTING
        opposite = self.of_filter and r.chance < chance and r.value < -CORRELATED
        # Values that are alike are few independent ones, but already told by their likeness.
        told = alike or size.chance < chance
        # Residuals as large as the noise may last, but not larger ones, as noise is white.
        large, small = told or lasting, told and size.median < USUAL[0]
        large &= size.median > USUAL[1]
        small &= self.small_tells
        far = out.chance < chance and out.share > MANY
        far |= out.largest > EXTREME
        # Outliers disturb the next estimates, but do not make values much alike or much larger.
        others = size.median < USUAL[1] ** 2 and not (alike and (large or r.value > DISTURBED))
        if far and out.memory < SINGLE and others:
            return "outliers"
        if large:
            return ("unexplained" if alike else "noisy") if self.of_filter else "not reproduced"
        if small:
            return "smooth" if alike else "hasty" if opposite else "quiet"
        if alike:
            return "slow"
        if self.follows_input(chance):
            return "driven"
        return "hasty" if opposite else "bursts" if far and self.of_filter else ""

    def follows_input(self, chance: float) -> bool:
        """Return whether an input tells the innovations; see `verdict`."""
        driven = self.driven
        return self.of_filter and driven.chance < chance and driven.value > CORRELATED

    @property
    def badness(self) -> float:
        """How far the size is from the expected one, as a factor of at least 1."""
        median = self.size.median
        return max(median, 1 / median) if median > 0 else float("inf")
