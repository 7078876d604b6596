"""The coefficients of Dormand and Prince's method of order 8, as C."""

from __future__ import annotations

import numpy as np

from pinnobs_gym.simulation import dop853


def coefficients() -> str:
    """Return the numbers of stages and coefficients, the nonzero coefficients, and the list
    ``EACH_STAGE(STAGE)`` of ``STAGE(i, state)``, the state of each stage and, last, at the end of a
    step.

    A state is component n of lane l of ``x`` plus the slopes ``k`` of earlier stages, weighted by
    ``w``, the step times the coefficients.
    """
    rows = [*dop853.A, dop853.B]
    numbers, states = [], []
    for i, row in enumerate(rows):
        terms = ["x[n][l]"]
        for j in np.flatnonzero(row):
            terms.append(f"w[{len(numbers)}] * k[{j}][n][l]")
            numbers.append(repr(float(row[j])))
        states.append(f"STAGE({i}, {' + '.join(terms)})")
    joined = " \\\n    ".join(states)
    return (
        f"#define STAGES {len(dop853.B)}\n#define COEFFICIENTS {len(numbers)}\n"
        f"static const double coefficients[COEFFICIENTS] = {{{', '.join(numbers)}}};\n"
        f"#define EACH_STAGE(STAGE) \\\n    {joined}\n"
    )
