"""Many fast trainings at once in torch, for a GPU.

Each round evaluates one trial point of every record in one batch. Line searches, updates and ends
of trainings are operations on tensors with masks, and Python reads numbers back only every
`ROUNDS`. On a GPU one round is recorded as a CUDA graph, whose replays need no Python. On a CPU
all this is slower than one record after another, whose arrays then stay in the cache. The tests run
the same code on a CPU, where the results agree with those of single trainings, and on torch's meta
device, which has no numbers that could be read.
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
        recipe = trainer.recipe
        sizes = (*recipe.architecture.shapes, len(recipe.objective.points.t))
        batches.setdefault(sizes, []).append(trainer)
    for batch in batches.values():
        evaluate_first(batch, device)
        live = [trainer for trainer in batch if not ended_now(trainer, interrupt)]
        state: Minimisations | None = None
        while live:
            if state is None:
                objectives = [trainer.recipe.objective for trainer in live]
                thetas = np.stack([trainer.theta for trainer in live])
                made = [trainer.iteration for trainer in live]
                state = Minimisations(objectives, thetas, made, device, live[0].config)
            state.rounds(ROUNDS)
            for trainer, reached in zip(live, state.reached(), strict=True):
                trainer.reached(*reached)
            left = [i for i, trainer in enumerate(live) if not ended_now(trainer, interrupt)]
            if len(left) < len(live):
                live = [live[i] for i in left]
                state.keep(left)


def evaluate_first(trainers: Sequence[PinnObsTrainer], device: str) -> None:
    """Make the first iteration of trainers with networks of one shape, which evaluates the initial
    weights; again from the next seed where the loss is not finite, as `PinnObsTrainer.took` says.
    """
    while begun := [run for run in trainers if run.best is None and not run.finished()]:
        objective = Objective.stacked([run.recipe.objective for run in begun], device)
        thetas = torch.as_tensor(np.stack([run.theta for run in begun]), device=device)
        for run, loss in zip(begun, objective.values(thetas)[0].tolist(), strict=True):
            run.took(loss, run.theta)


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

    They are a batched version of `trainers.pinn_obs.quasi_newton.QuasiNewton`. The estimates H of
    the inverse Hessians take most of the memory, and their updates most of the time. So a factor
    of each is kept apart, as is the identity that a fresh H is: a fresh row has zeros, to which its
    first update is added. A row whose H is dropped, since a search along its direction failed,
    waits for the end of the `rounds`, where its H is set to zero.

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
        self._factor = torch.ones_like(self._f)
        """Factor of each H, shape (batch,)."""
        self._fresh = torch.ones(batch, dtype=torch.bool, device=device)
        """Whether H is the identity, and its place zero, bool (batch,)."""
        self.waiting = ~self._fresh
        """Whether H is to be dropped, bool (batch,)."""
        self._slope = torch.zeros_like(self._f)
        self._searches = Searches(batch, self._f)
        made = torch.as_tensor(list(iterations), device=device)
        self.progress = Progress(
            self._fresh, ~self._fresh, made, self._f, made, self._x, self._f, made
        )
        self._graph: torch.cuda.CUDAGraph | None = None
        self._recordable = self._x.is_cuda
        self._part()

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
        for owner, name in self._places():
            setattr(owner, name, getattr(owner, name)[index])
        self._objectives = [self._objectives[i] for i in rows]
        self._objective = Objective.stacked(self._objectives, str(self._x.device))
        self._graph = None

    def rounds(self, number: int) -> None:
        """Evaluate so many trials of every row that goes on.

        On a GPU the first is made as it is written, and recorded for the others. A round that
        cannot be recorded, since the model reads numbers back, is made as it is written each time.
        """
        self._settle()
        for _ in range(number):
            if self._graph is not None:
                self._graph.replay()
                continue
            self._round_in_place()
            if self._recordable:
                self._record()

    def _record(self) -> None:
        """Record a round, without making it."""
        places = [getattr(owner, name) for owner, name in self._places()]
        graph = torch.cuda.CUDAGraph()
        try:
            with torch.cuda.graph(graph):
                self._round_in_place()
            self._graph = graph
        except RuntimeError:
            self._recordable = False
            for (owner, name), place in zip(self._places(), places, strict=True):
                setattr(owner, name, place)

    def _places(self) -> list[tuple[object, str]]:
        """Return the attributes that hold tensors of the minimisations, with their owners."""
        searches = self._searches
        ends = (searches.start, searches.low, searches.high)
        owners = (self, self.progress, searches, *ends)
        return [(o, n) for o in owners for n, part in vars(o).items() if isinstance(part, Tensor)]

    def _part(self) -> None:
        """Give each tensor memory of its own, for `_round_in_place`."""
        seen: set[int] = set()
        for owner, name in self._places():
            part = getattr(owner, name)
            if id(part) in seen:
                setattr(owner, name, part.clone())
            seen.add(id(part))

    def _round_in_place(self) -> None:
        """Make a round whose results take the memory of what they replace, as a graph needs it."""
        before = [getattr(owner, name) for owner, name in self._places()]
        self._round()
        for (owner, name), place in zip(self._places(), before, strict=True):
            now = getattr(owner, name)
            if now is not place:
                place.copy_(now)
                setattr(owner, name, place)

    def _settle(self) -> None:
        """Drop the H of the rows that wait, and multiply those of the others by their factors,
        whose products would leave the finite numbers."""
        self._H.mul_(self._factor[:, None, None])
        self._H.masked_fill_(self.waiting[:, None, None], 0.0)
        self._factor.fill_(1.0)
        self.waiting.fill_(False)

    def _round(self) -> None:
        """Evaluate one trial of every row that goes on."""
        searches = self._searches
        ended = self._begin(self.progress.live & ~searches.active & ~self.waiting)
        trial = self._x + searches.step[:, None] * self._direction
        step = searches.step
        loss, gradient = self._objective.values(trial)
        made, failed = searches.advance(loss, (gradient * self._direction).sum(-1))
        ended = ended | (failed & self._fresh)
        dropped = failed & ~self._fresh  # then the next search is along the steepest descent
        self._fresh, self.waiting = self._fresh | dropped, self.waiting | dropped
        self._update(made, step, trial, gradient)
        self._f = torch.where(made, loss, self._f)
        self.progress.took(made, ended, self._f, self._x, self._config)

    def _times(self, vectors: Tensor) -> Tensor:
        """Return the products of H with vectors (batch, n)."""
        product = (self._H @ vectors[..., None])[..., 0] * self._factor[:, None]
        return torch.where(self._fresh[:, None], vectors, product)

    def _begin(self, rows: Tensor) -> Tensor:
        """Begin the line searches of these rows (batch,), but for those whose H is dropped; return
        those without a descent."""
        direction = -self._times(self._gradient)
        slope = (self._gradient * direction).sum(-1)
        uphill = rows & ~(slope < 0)
        ended = uphill & self._fresh
        dropped = uphill & ~self._fresh  # steepest descent instead
        self._fresh, self.waiting = self._fresh | dropped, self.waiting | dropped
        rows = rows & ~uphill
        self._direction = torch.where(rows[:, None], direction, self._direction)
        self._slope = torch.where(rows, slope, self._slope)
        first = (1 / (-slope).clamp(min=1e-300).sqrt()).clamp(max=1.0)
        first = torch.where(self._fresh, first, FIRST_STEP)
        self._searches.begin(rows, self._f, slope, first)
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
        # Rows without an update keep H: their factor stays, and what is added is zero.
        grown = torch.where(curved, size / weights[0], 1.0)
        by_ss, by_sw, by_ww = (torch.where(curved, a, 0.0)[:, None] for a in weights[1:])
        w = torch.where(curved, size, 0.0)[:, None] * w
        # H' = grown·H + [s w] M [s w]ᵀ, and H is factor·_H, or the identity.
        factor = torch.where(self._fresh, 1.0, self._factor * grown)
        self._factor = torch.where(curved, factor, self._factor)
        left = torch.stack([s, w], dim=-1)
        right = torch.stack([by_ss * s + by_sw * w, by_sw * s + by_ww * w], dim=-1)
        self._H.baddbmm_(left / self._factor[:, None, None], right.mT)
        new = torch.where(curved & self._fresh, grown, 0.0)[:, None]
        self._H.diagonal(dim1=-2, dim2=-1).add_(new)
        self._fresh = self._fresh & ~curved
        self._x = torch.where(moved, trial, self._x)
        self._gradient = torch.where(moved, gradient, self._gradient)
