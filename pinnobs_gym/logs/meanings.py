"""What the verdicts on outputs mean, in plain words: what is seen, what it means, what to try."""

from __future__ import annotations

from collections.abc import Sequence

from pinnobs_gym.logs.innovation_tests import Size
from pinnobs_gym.logs.verdicts import CHANCE, DRIFTING, USUAL, OutputTests

NAMED = 4
"""Largest number of outputs that a line names."""
MEANINGS = {
    "unexplained": (
        "{values} are too large for their standard deviations, and one is like the next",
        "the model does not explain the outputs, or the filter has lost track of the state, so "
        "that estimates are worse than their standard deviations; check units, signs and columns, "
        "the inputs and their clock, and the parameters (pinnobs fit), or tell more "
        "--process-noise; for a lost filter try --estimator ukf or another --xhat0",
    ),
    "noisy": (
        "{values} are too large for their standard deviations, but one is not like the next",
        "the output is noisier than told, by about the root of that number, or its unit is wrong; "
        "try a larger --noise-std, or pinnobs fit --noise",
    ),
    "quiet": (
        "{values} are too small for their standard deviations",
        "the noise is told too large, or the unit of the output is wrong; estimates may be better "
        "than their standard deviations; try a smaller --noise-std (or --process-noise), or "
        "pinnobs fit --noise",
    ),
    "smooth": (
        "{values} are too small for their standard deviations, and one is like the next",
        "the noise is told too large, and what is left is an error of the model, or a noise that "
        "lasts from sample to sample, which the standard deviations do not count; try a smaller "
        "--noise-std with more --process-noise (pinnobs fit --noise), or pinnobs fit for the "
        "parameters",
    ),
    "hasty": (
        "one of the {values} tends to be the opposite of the one before",
        "the process noise is told too large, or the output noise too small, so that estimates "
        "follow the noise of the outputs; try a smaller --process-noise or --set assumed_noise=0, "
        "a larger --noise-std, or pinnobs fit --noise",
    ),
    "slow": (
        "{values} are about as large as expected, but one is like the next",
        "the model drifts away from the outputs, or the filter had lost track of the state, and "
        "estimates are worse than their standard deviations; tell more --process-noise (pinnobs "
        "fit --noise), estimate an unknown constant (--also), check the inputs and their clock, or "
        "try --estimator ukf",
    ),
    "driven": (
        "{values} can be told from the input before them",
        "the model does not use the input as the plant does; check the sign, the unit and the "
        "clock of its column, whether outputs are stamped late, and the parameters that multiply "
        "it (pinnobs fit)",
    ),
    "outliers": (
        "single outputs are far beyond their noise",
        "these are outliers, or a filter that fails at times, not a wrong noise; compare with "
        "--estimator ukf, and for outliers try --estimator robust_ekf, or leave their cells empty",
    ),
    "bursts": (
        "{values} far beyond the others come together",
        "the model fails, or the filter has lost track of the state, for some time; look at the "
        "innovations in the file of estimates and at what happened then",
    ),
    "not reproduced": (
        "estimates differ from the outputs by more than the noise",
        "the model does not explain the outputs (check units, signs and columns, the inputs and "
        "the parameters), or their noise is told too small, or this estimator has not converged; "
        "compare with --estimator ekf",
    ),
}
"""What is seen, and what it means and what to try, for each verdict."""
_EFFECTS = ("noisy", "slow", "driven", "early", "bursts", "outliers")
"""Verdicts of other outputs that a model with an unexplained one makes likely."""


def warnings_of(tests: Sequence[OutputTests], together: Size | None) -> list[str]:
    """Return a warning for each verdict, naming its outputs, the worst first.

    Args:
        tests: those of the outputs that have enough samples.
        together: size of the innovations of all outputs together, if there are several.
    """
    chance = CHANCE / max(1, len(tests))
    verdicts = [(each, verdict) for each in tests if (verdict := each.verdict(chance))]
    if any(verdict == "unexplained" for _, verdict in verdicts):
        verdicts = [
            (each, "unexplained" if verdict in _EFFECTS else verdict) for each, verdict in verdicts
        ]
    lines = []
    for verdict, (what, meaning) in MEANINGS.items():
        of_this = [each for each, other in verdicts if other == verdict]
        if of_this:
            worst = sorted(of_this, key=lambda each: each.badness, reverse=True)
            names = ", ".join(_seen(each, verdict) for each in worst[:NAMED])
            names += f" and {len(worst) - NAMED} more outputs" if len(worst) > NAMED else ""
            values = "innovations" if worst[0].of_filter else "residuals"
            lines.append(f"{names}: {what.format(values=values)}; {meaning}")
    low = USUAL[0] if all(each.small_tells for each in tests) else 0.0
    usual = together is None or low <= together.median <= USUAL[1]
    if not lines and together is not None and not usual and together.chance < CHANCE:
        lines.append(
            f"all outputs together (squares {_rounded(together.median)} times the expected): "
            "innovations of each are as large as expected, but not those of several at a time; "
            "the correlation of their noise is told wrongly"
        )
    return lines


def early_facts(tests: Sequence[OutputTests]) -> list[str]:
    """Return a line on outputs that fit from the second half of their values on only. A filter that
    has to find the state from a wide prior first is no fault of a log."""
    early = [
        f"{each.name} before t = {each.later.begin}"
        for each in tests
        if each.later is not None and each.verdict(CHANCE / len(tests)) == "early"
    ]
    if not early:
        return []
    more = f" and {len(early) - NAMED} more outputs" if len(early) > NAMED else ""
    return [
        f"the filter had to find the state first: estimates are worse than their standard "
        f"deviations by the innovations of {', '.join(early[:NAMED])}{more}, and fit later"
    ]


def _seen(tests: OutputTests, verdict: str) -> str:
    """Return the numbers that a verdict rests on, in words."""
    out = tests.outliers
    if verdict == "outliers":
        share = f"{100 * out.single:.2g} % of its samples"
        worst = f"{_rounded(out.largest)} standard deviations at t = {tests.when[2]}"
        return f"{tests.name} ({share}, the largest {worst})"
    if verdict == "bursts":
        share = f"{100 * out.share:.2g} % of its samples"
        return f"{tests.name} ({share}, t = {tests.when[0]} to {tests.when[1]})"
    if verdict == "driven":
        return f"{tests.name} (correlation {tests.driven.value:.2f} with {tests.driven.input_name})"
    parts = [f"squares {_rounded(tests.size.median)} times the expected"]
    if verdict in ("unexplained", "slow", "smooth", "hasty"):
        parts.append(f"correlation {tests.correlation.value:.2f}")
    if verdict in ("unexplained", "slow") and tests.drift.ratio > DRIFTING:
        parts.append(
            f"means of {tests.drift.length} vary {_rounded(tests.drift.ratio)} times as much as "
            "they should"
        )
    if verdict in ("unexplained", "slow") and tests.follows_input(CHANCE):
        own = tests.driven
        parts.append(f"correlation {own.value:.2f} with the input {own.input_name} before")
    return f"{tests.name} ({', '.join(parts)})"


def _rounded(value: float) -> str:
    """Return a positive number with two digits, without a power of ten where it is not needed."""
    return f"{float(f'{value:.2g}'):,.0f}" if 100 <= value < 1e7 else f"{value:.2g}"
