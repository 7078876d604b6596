"""Many fast trainings at once in torch, for a GPU.

Each round evaluates one trial point of every record in one batch. The line searches, a few scalars
each, run on the CPU, and are independent: one record may be within a search while another begins
its own. On a CPU this is slower than one record after another, whose arrays then stay in the cache.
It has not been tested on a GPU. The tests run the same code in torch on a CPU, where the results
agree with those of single trainings, and on torch's meta device, which refuses arrays of mixed
devices.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from pinnobs_gym.training.loop import Interrupt, ended_now
from trainers.pinn_obs.minimum import FIRST_STEP
from trainers.pinn_obs.objective import Objective
from trainers.pinn_obs.quasi_newton import (
    CURVATURE,
    Search,
    curved,
    first_step,
    trials,
    update_weights,
)

if TYPE_CHECKING:
    from trainers.pinn_obs import PinnObsTrainer


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
                thetas = np.stack([trainer.theta for trainer in live])
                objectives = [trainer.recipe.objective for trainer in live]
                state = Minimisations(objectives, thetas, device)
            made, stuck = state.round()
            x = state.x
            for i in (*made, *stuck):
                live[i].took(state.f[i], x[i], lower=i in made)
            left = [i for i, trainer in enumerate(live) if not ended_now(trainer, interrupt)]
            if len(left) < len(live):
                live = [live[i] for i in left]
                state.keep(left)


class Minimisations:
    """Self-scaled Broyden minimisations in progress, one per objective.

    They are a batched version of `trainers.pinn_obs.quasi_newton.QuasiNewton`.

    Args:
        objectives: objectives of networks of one shape, with equally many points.
        starts: initial points, shape (batch, n).
        device: torch name of the device.
    """

    def __init__(self, objectives: Sequence[Objective], starts: np.ndarray, device: str) -> None:
        self._objectives, self._device = list(objectives), device
        self._objective = Objective.stacked(self._objectives, device)
        self._x = torch.as_tensor(starts, device=device)
        loss, self._gradient = self._objective.values(self._x)
        self.f: list[float] = loss.tolist()
        self._direction, self._trial = -self._gradient, self._x
        batch, n = starts.shape
        self._H = torch.eye(n, dtype=self._x.dtype, device=device).repeat(batch, 1, 1)
        self._fresh = [True] * batch  # whether H is the unscaled identity
        self._slopes, self._steps = [0.0] * batch, [0.0] * batch
        self._searches: list[Search | None] = [None] * batch

    @property
    def x(self) -> np.ndarray:
        """Current points, shape (batch, n)."""
        return self._x.cpu().numpy().copy()

    def keep(self, rows: Sequence[int]) -> None:
        """Keep only these rows."""
        if not rows:
            return
        index = torch.as_tensor(list(rows), device=self._device)
        for name in ("_x", "_gradient", "_direction", "_trial", "_H"):
            setattr(self, name, getattr(self, name)[index])
        for name in ("_objectives", "f", "_fresh", "_slopes", "_steps", "_searches"):
            setattr(self, name, [getattr(self, name)[i] for i in rows])
        self._objective = Objective.stacked(self._objectives, self._device)

    def round(self) -> tuple[list[int], list[int]]:
        """Evaluate one trial of every row.

        Returns:
            The rows whose trial was accepted as a step, and the rows for which no step exists.
        """
        # Rows without a line search begin one; all trials are evaluated at once.
        ended = self._begin([i for i, search in enumerate(self._searches) if search is None])
        self._trial = self._x + self._column(self._steps) * self._direction
        loss, gradient = self._objective.values(self._trial)
        slope = (gradient * self._direction).sum(-1)
        seen: list[list[float]] = torch.stack([loss, slope], dim=-1).tolist()
        made: list[int] = []
        for i, (f, along) in enumerate(seen):
            search = self._searches[i]
            if search is None:
                continue
            try:
                self._steps[i] = search.send((f, along))
            except StopIteration as stop:  # accepted, or failed: then retry from the identity
                self._searches[i] = None
                if stop.value:
                    made.append(i)
                    self.f[i] = f
                elif self._fresh[i]:
                    ended.append(i)
                else:
                    self._forget(i)
        if made:
            self._update(made, gradient)
        return made, ended

    def _begin(self, rows: list[int]) -> list[int]:
        """Begin the line searches of these rows; return those without a descent direction."""
        if not rows:
            return []
        new = self._mask(rows)
        direction = -(self._H @ self._gradient[..., None])[..., 0]
        self._direction = torch.where(new, direction, self._direction)
        slopes = (self._gradient * self._direction).sum(-1).tolist()
        ended: list[int] = []
        for i in rows:
            if not slopes[i] < 0 and not self._fresh[i]:  # steepest descent instead
                self._forget(i)
                self._direction[i] = -self._gradient[i]
                slopes[i] = -float(self._gradient[i] @ self._gradient[i])
            if not slopes[i] < 0:
                self._steps[i] = 0.0
                ended.append(i)
                continue
            self._slopes[i] = slopes[i]
            first = first_step(slopes[i]) if self._fresh[i] else FIRST_STEP
            search = trials(self.f[i], slopes[i], first, CURVATURE)
            self._searches[i], self._steps[i] = search, next(search)
        return ended

    def _forget(self, row: int) -> None:
        """Reset H of a row to the identity."""
        self._H[row] = torch.eye(self._H.shape[-1], dtype=self._H.dtype, device=self._device)
        self._fresh[row] = True

    def _update(self, made: list[int], gradient: Tensor) -> None:
        """Move these rows to their trial points, and update their H as in `QuasiNewton`."""
        moved = self._mask(made)
        s = torch.where(moved, self._trial - self._x, 0.0)  # others' trials may not be finite
        y = torch.where(moved, gradient - self._gradient, 0.0)
        w = (self._H @ y[..., None])[..., 0]
        products = [(a * b).sum(-1) for a, b in ((s, y), (s, s), (y, y), (y, w))]
        weights = np.tile([1.0, 1.0, 0.0, 0.0, 0.0], (len(self.f), 1))  # leaves H unchanged
        for i, (sy, ss, yy, yw) in enumerate(torch.stack(products, dim=-1).tolist()):
            if i not in made or not curved(sy, ss, yy):
                continue
            size = sy / yy if self._fresh[i] else 1.0
            sBs = (
                ss / size if self._fresh[i] else -self._steps[i] * self._slopes[i] * self._steps[i]
            )
            weights[i] = (size, *update_weights(sBs, size * yw, sy, s.shape[-1]))
            self._fresh[i] = False
        # The update of rank two, on all rows at once.
        size, tau, ss, sw, ww = torch.as_tensor(weights, device=self._device).T[..., None]
        w = size * w
        left = torch.stack([s, w], dim=-1)
        right = torch.stack([ss * s + sw * w, sw * s + ww * w], dim=-1)
        self._H.mul_((size / tau)[..., None]).baddbmm_(left, right.mT)
        self._x = torch.where(moved, self._trial, self._x)
        self._gradient = torch.where(moved, gradient, self._gradient)

    def _mask(self, rows: list[int]) -> Tensor:
        """Return a mask (batch, 1) of these rows."""
        mask = np.zeros((len(self.f), 1), bool)
        mask[rows] = True
        return torch.as_tensor(mask, device=self._device)

    def _column(self, values: list[float]) -> Tensor:
        return torch.as_tensor(values, dtype=self._x.dtype, device=self._device)[:, None]
