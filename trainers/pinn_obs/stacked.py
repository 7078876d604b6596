"""Many fast trainings at once in torch, for a GPU.

Each round evaluates one trial point of every record in one batch. Line searches, updates and ends
of trainings are operations on tensors with masks, and Python reads numbers back only every
`ROUNDS`. On a CPU this is slower than one record after another, whose arrays then stay in the
cache. The tests run the same code on a CPU, where the results agree with those of single
trainings, and on torch's meta device, which has no numbers that could be read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from pinnobs_gym.training.loop import Interrupt, ended_now
from trainers.pinn_obs.config import PinnObsConfig
from trainers.pinn_obs.minimum import FIRST_STEP, BestIterate, Mark
from trainers.pinn_obs.objective import Objective
from trainers.pinn_obs.searches import Searches, update_weights

if TYPE_CHECKING:
    from trainers.pinn_obs import PinnObsTrainer

ROUNDS = 20
"""Number of rounds after which numbers are read back, and the budget and Ctrl-C are looked at."""


def advance(trainers: Sequence[PinnObsTrainer], device: str, interrupt: Interrupt) -> None:
    """Train until every trainer has ended, or Ctrl-C is pressed.

    Trainers with networks of one shape and equally many points form a batch; batches are trained
    one after another. A trainer that has ended leaves its batch. The CPU seconds of a trainer
    include those of the others.
    """
    batches: dict[tuple, list[PinnObsTrainer]] = {}
    for trainer in trainers:
        # The first iteration of each, with restarts if its loss is not finite.
        while not trainer.finished() and trainer.best is None:
            trainer.step()
        recipe = trainer.recipe
        sizes = (*recipe.architecture.shapes, len(recipe.objective.points.t))
        batches.setdefault(sizes, []).append(trainer)
    for batch in batches.values():
        live = [trainer for trainer in batch if not ended_now(trainer, interrupt)]
        state: Minimisations | None = None
        while live:
            if state is None:
                objectives = [trainer.recipe.objective for trainer in live]
                thetas = np.stack([trainer.theta for trainer in live])
                made = [trainer.iteration for trainer in live]
                state = Minimisations(objectives, thetas, made, device, live[0].config)
            for _ in range(ROUNDS):
                state.round()
            for trainer, reached in zip(live, state.reached(), strict=True):
                trainer.reached(*reached)
            left = [i for i, trainer in enumerate(live) if not ended_now(trainer, interrupt)]
            if len(left) < len(live):
                live = [live[i] for i in left]
                state.keep(left)


@dataclass(eq=False)
class Progress:
    """How far each training of a batch has come; tensors of shape (batch,), but for the weights."""

    live: Tensor
    """Whether it goes on, bool."""
    stuck: Tensor
    """Whether no lower loss was found, bool."""
    iteration: Tensor
    best: Tensor
    """The least loss."""
    best_iteration: Tensor
    best_x: Tensor
    """The weights of the least loss, shape (batch, n)."""
    mark: Tensor
    """The last loss that reset the patience."""
    mark_iteration: Tensor

    def took(
        self, made: Tensor, ended: Tensor, f: Tensor, x: Tensor, config: PinnObsConfig
    ) -> None:
        """Count iterations as `PinnObsTrainer.took` does: those that made a step, and those that
        found none, bool (batch,) each, at losses (batch,) and weights (batch, n)."""
        self.iteration = self.iteration + (made | ended)
        self.stuck = self.stuck | ended
        lower = made & (f < self.best)
        marked = lower & (f < (1 - config.improvement) * self.mark)
        self.mark = torch.where(marked, f, self.mark)
        self.mark_iteration = torch.where(marked, self.iteration, self.mark_iteration)
        self.best = torch.where(lower, f, self.best)
        self.best_iteration = torch.where(lower, self.iteration, self.best_iteration)
        self.best_x = torch.where(lower[:, None], x, self.best_x)
        since = self.iteration - self.mark_iteration
        over = (self.iteration >= config.iterations) | (since >= config.patience) | self.stuck
        self.live = self.live & ~over


class Minimisations:
    """Self-scaled Broyden minimisations in progress, one per objective, after the iteration that
    evaluates the initial points.

    They are a batched version of `trainers.pinn_obs.quasi_newton.QuasiNewton`.

    Args:
        objectives: objectives of networks of one shape, with equally many points.
        starts: initial points, shape (batch, n).
        iterations: number of iterations that were made of each, up to these points.
        device: torch name of the device.
        config: settings of all, which say when a minimisation ends.
    """

    def __init__(
        self,
        objectives: Sequence[Objective],
        starts: np.ndarray,
        iterations: Sequence[int],
        device: str,
        config: PinnObsConfig,
    ) -> None:
        self._objectives, self._config = list(objectives), config
        self._objective = Objective.stacked(self._objectives, device)
        self._x = torch.as_tensor(starts, device=device)
        self._f, self._gradient = self._objective.values(self._x)
        self._direction = -self._gradient
        batch, n = starts.shape
        self._H = torch.zeros((batch, n, n), dtype=self._x.dtype, device=device)
        self._fresh = torch.ones(
            batch, dtype=torch.bool, device=device
        )  # whether H is the identity
        self._slope = torch.zeros_like(self._f)
        self._searches = Searches(batch, self._f)
        made = torch.as_tensor(list(iterations), device=device)
        self.progress = Progress(
            self._fresh, ~self._fresh, made, self._f, made, self._x, self._f, made
        )

    def reached(self) -> list[tuple[int, BestIterate, Mark, bool]]:
        """Return the iteration, the best iterate (of seed −1), the mark and whether it is stuck, of
        each minimisation."""
        p = self.progress
        parts = (p.iteration, p.best, p.best_iteration, p.mark, p.mark_iteration, p.stuck)
        rows = zip(*(part.tolist() for part in parts), strict=True)
        thetas = p.best_x.cpu().numpy()
        return [
            (iteration, BestIterate(best, at, -1, theta.copy()), Mark(mark, marked), stuck)
            for (iteration, best, at, mark, marked, stuck), theta in zip(rows, thetas, strict=True)
        ]

    def keep(self, rows: Sequence[int]) -> None:
        """Keep only these rows."""
        if not rows:
            return
        index = torch.as_tensor(list(rows), device=self._x.device)
        for name in ("_x", "_f", "_gradient", "_direction", "_H", "_fresh", "_slope"):
            setattr(self, name, getattr(self, name)[index])
        self.progress = Progress(*(part[index] for part in vars(self.progress).values()))
        self._searches.keep(index)
        self._objectives = [self._objectives[i] for i in rows]
        self._objective = Objective.stacked(self._objectives, str(self._x.device))

    def round(self) -> None:
        """Evaluate one trial of every row that goes on."""
        searches = self._searches
        ended = self._begin(self.progress.live & ~searches.active)
        trial = self._x + searches.step[:, None] * self._direction
        step = searches.step
        loss, gradient = self._objective.values(trial)
        made, failed = searches.advance(loss, (gradient * self._direction).sum(-1))
        ended = ended | (failed & self._fresh)
        self._fresh = self._fresh | failed  # then the next search is along the steepest descent
        self._update(made, step, trial, gradient)
        self._f = torch.where(made, loss, self._f)
        self.progress.took(made, ended, self._f, self._x, self._config)

    def _times(self, vectors: Tensor) -> Tensor:
        """Return the products of H with vectors (batch, n)."""
        product = (self._H @ vectors[..., None])[..., 0]
        return torch.where(self._fresh[:, None], vectors, product)

    def _begin(self, rows: Tensor) -> Tensor:
        """Begin the line searches of these rows (batch,); return those without a descent."""
        direction = -self._times(self._gradient)
        slope = (self._gradient * direction).sum(-1)
        uphill = rows & ~(slope < 0)  # steepest descent instead
        self._fresh = self._fresh | uphill
        direction = torch.where(uphill[:, None], -self._gradient, direction)
        slope = (self._gradient * direction).sum(-1)
        self._direction = torch.where(rows[:, None], direction, self._direction)
        self._slope = torch.where(rows, slope, self._slope)
        ended = rows & ~(slope < 0)
        first = (1 / (-slope).clamp(min=1e-300).sqrt()).clamp(max=1.0)
        first = torch.where(self._fresh, first, FIRST_STEP)
        self._searches.begin(rows & ~ended, self._f, slope, first)
        return ended

    def _update(self, made: Tensor, step: Tensor, trial: Tensor, gradient: Tensor) -> None:
        """Move these rows (batch,) to their trial points; update their H as `QuasiNewton` does."""
        moved = made[:, None]
        s = torch.where(moved, trial - self._x, 0.0)  # others' trials may not be finite
        y = torch.where(moved, gradient - self._gradient, 0.0)
        w = self._times(y)
        sy, ss, yy, yw = ((a * b).sum(-1) for a, b in ((s, y), (s, s), (y, y), (y, w)))
        curved = made & (sy > 1e-14 * (ss * yy).sqrt())
        size = torch.where(self._fresh, sy / yy, 1.0)  # of the identity, before its first update
        sBs = torch.where(self._fresh, ss / size, -step * self._slope * step)
        weights = update_weights(sBs, size * yw, sy, s.shape[-1])
        # Rows without an update keep H: τ and the size are one there, and the other weights zero.
        size = torch.where(curved, size, 1.0)[:, None]
        tau = torch.where(curved, weights[0], 1.0)[:, None]
        by_ss, by_sw, by_ww = (torch.where(curved, a, 0.0)[:, None] for a in weights[1:])
        w = size * w
        left = torch.stack([s, w], dim=-1)
        right = torch.stack([by_ss * s + by_sw * w, by_sw * s + by_ww * w], dim=-1)
        fresh = self._fresh[:, None]
        kept = torch.where(fresh, 0.0, size / tau)
        self._H.mul_(kept[..., None]).baddbmm_(left, right.mT)
        self._H.diagonal(dim1=-2, dim2=-1).add_(torch.where(fresh, size / tau, 0.0))
        self._fresh = self._fresh & ~curved
        self._x = torch.where(moved, trial, self._x)
        self._gradient = torch.where(moved, gradient, self._gradient)
