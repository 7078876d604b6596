"""Minimisation of the posterior's squares by Levenberg and Marquardt's method, from much process
noise to the known one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from trainers.pinn_obs.path_posterior import PathPosterior

_NARROWING = 2.5
"""Factor by which the added process noise falls from stage to stage."""
_STEPS = 4
"""Largest number of steps of a stage but the last."""
_GAIN, _SETTLED = 0.1, 1e-4
"""Predicted decrease of the loss below which a stage ends, and the last one; 1 is one standard
deviation."""
_FIRST, _LEAST, _MOST = 1e-3, 1e-9, 1e8
"""First, least positive and largest damping, relative to the Hessian's diagonal."""
_ROUNDING = 1e-12
"""Relative increase of the loss that counts as none."""


def stages_of(widest: float, least: float) -> tuple[float, ...]:
    """Return the process noise that is added in each stage, a standard deviation over the states'
    scales in 1/√s: from ``widest`` down to under ``least``, the known one, and then none."""
    count = max(0, int(np.ceil(np.log(widest / least) / np.log(_NARROWING))) + 1)
    return (*(widest / _NARROWING**k for k in range(count)), 0.0)


@dataclass(eq=False)
class LevenbergMarquardt:
    """A minimisation in progress.

    With the known process noise alone the equations bind, and a path that is far from every
    solution near the outputs cannot be improved by small steps. The first stages therefore take
    more process noise, with which the path follows the outputs, and each begins where the one
    before it ended (a continuation). The last stage is the posterior itself.

    Steps are those of Nocedal & Wright, "Numerical Optimization", section 10.3, with Marquardt's
    scaling.
    """

    coefficients: np.ndarray
    """Current coefficients, shape (num, nx); see `PathPosterior`."""
    stages: tuple[float, ...]
    """See `stages_of`."""
    x: np.ndarray
    """The weights of the network, shape (n,)."""
    f: float
    """The loss with the known process noise alone, whatever the stage."""
    stage: int = 0
    steps: int = 0
    """Steps in this stage."""
    damping: float = _FIRST

    @staticmethod
    def start(
        objective: PathPosterior, coefficients: np.ndarray, stages: tuple[float, ...]
    ) -> LevenbergMarquardt:
        """Begin a minimisation at coefficients (num, nx)."""
        x, f = objective.theta(coefficients), objective.loss(coefficients)
        return LevenbergMarquardt(coefficients, stages, x, f)

    def step(self, objective: PathPosterior) -> bool:
        """Make one iteration; return False if it is the last one, in which the minimum is found, or
        no lower loss."""
        added, last = self.stages[self.stage], self.stage == len(self.stages) - 1
        decrease = self._move(objective, added)
        self.steps += 1
        if last:
            return decrease > _SETTLED
        if decrease <= _GAIN or self.steps == _STEPS:
            self.stage, self.steps = self.stage + 1, 0
        return True

    def _move(self, objective: PathPosterior, added: float) -> float:
        """Make a step that lowers the loss of a stage, and return the predicted decrease; zero if
        there is none."""
        here = objective.loss(self.coefficients, added)
        hessian, gradient = objective.linearised(self.coefficients, added)
        diagonal = np.diag(np.diag(hessian))
        while self.damping <= _MOST and np.isfinite(hessian).all():
            try:
                factor = cho_factor(hessian + self.damping * diagonal)
            except LinAlgError:  # by rounding
                self.damping = max(10 * self.damping, _LEAST)
                continue
            step = -cho_solve(factor, gradient)
            trial = self.coefficients + step.reshape(self.coefficients.shape[::-1]).T
            if objective.loss(trial, added) <= (1 + _ROUNDING) * here:
                self.damping /= 10
                self.coefficients, self.x = trial, objective.theta(trial)
                self.f = objective.loss(trial)
                return float(-gradient @ step)
            self.damping = max(10 * self.damping, _LEAST)
        self.damping = _FIRST
        return 0.0
