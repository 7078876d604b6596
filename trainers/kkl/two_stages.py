"""The fit in two stages: of T, then of T*."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, fields
from typing import Any, Literal, TypeAlias

import numpy as np
import torch
from torch import Tensor

from pinnobs_gym.estimation.learned.kkl_dynamics import at_rest
from pinnobs_gym.estimation.learned.kkl_maps import Mlp
from pinnobs_gym.estimation.learned.perceptron import Layers, perceptron
from pinnobs_gym.simulation.system import output_scale
from trainers.kkl.config import KKLConfig
from trainers.kkl.fitting import Equations, Fit, Objective, Term
from trainers.kkl.samples import Samples

Stage: TypeAlias = Literal["T", "T*", "done"]
"""Which map is fitted."""

_USUAL = 0.95
"""Weight of the past in the moving average of each part's mean squared error."""
_SHARE = 0.02
"""Fraction of the overall mean squared error that regularises that of each part."""


@dataclass(eq=False)
class BestWeights:
    """The weights of the least validation error."""

    error: float
    iteration: int
    layers: Layers
    made: int = 0
    """Number of steps of the whole stage."""


class TwoStageFit:
    """Fit T to the trainer's equations, then T* to x at the z that occur online.

    Args:
        samples: the training samples.
        config: the settings.
        encoding: returns the equations to which T is fitted.
        clock: returns the CPU seconds of the whole training.
        deadline: what the clock shows when the fit has to end; None without a limit.
    """

    def __init__(
        self,
        samples: Samples,
        config: KKLConfig,
        encoding: Callable[[Samples], Objective],
        clock: Callable[[], float],
        deadline: float | None,
    ) -> None:
        self.samples, self.config, self._encoding = samples, config, encoding
        self._clock, self._deadline = clock, deadline
        self.latest = np.nan
        self.best: dict[str, BestWeights] = {}
        self._begin("T")

    @property
    def iterations(self) -> int:
        """Number of steps so far, for both networks."""
        return self.fit.iteration + (self.best["T"].made if self.stage != "T" else 0)

    @property
    def encoder(self) -> Layers:
        """The best weights of T."""
        return self.best["T"].layers

    def decoder(self) -> BestWeights:
        """Return the best weights of T*; the initial ones if T is still in training, which is not
        disturbed."""
        if self.stage != "T":
            return self.best["T*"]
        aside = copy(self)
        aside.best, aside.samples = dict(self.best), copy(self.samples)
        aside._begin("T*")
        return aside.best["T*"]

    def finished(self) -> bool:
        """Return whether both networks are trained."""
        return self.stage == "done"

    def step(self) -> None:
        """Make a step of the current stage, and begin the next stage after its last step."""
        self.fit.step(self._stage_progress)
        if self.fit.iteration % self.config.check_every == 0:
            self._validate()
        if self._stage_over():
            self._validate()
            self.best[self.stage].made = self.fit.iteration
            if self.stage == "T":
                self._begin("T*")
            else:
                self.stage = "done"

    def progress(self) -> float:
        """Return the finished fraction of the whole fit, from 0 to 1."""
        share = self.config.share / (1 + self.config.share)
        if self.stage == "T":
            return share * min(self._stage_progress, 1.0)
        return 1.0 if self.finished() else share + (1 - share) * min(self._stage_progress, 1.0)

    def _begin(self, stage: Stage) -> None:
        """Draw the network of a stage, and prepare its data."""
        self.stage: Stage = stage
        self._stage_start = self._clock()
        config, samples = self.config, self.samples
        generator = torch.Generator().manual_seed(2 * config.seed + (stage == "T*"))
        if stage == "T":
            inputs = samples.x_scaling
            if samples.driven:
                inputs = inputs.beside(samples.clock_scaling)
            outputs = samples.z_scaling
        else:
            inputs, outputs = samples.whitening.beside(samples.clock_scaling), samples.x_scaling
        shape = (config.depth, config.width, config.activation)
        net = Mlp(inputs, outputs, *shape, generator, samples.dtype, samples.device)
        if stage == "T":
            objective = self._encoding(samples)
            self._checked = _held_equations(objective, config.seed)
        else:
            if samples.labels is None:  # T* inverts the trained T, not simulated z
                samples.z = samples.tensor(samples.whitening.scaled(self._own_z()))
            objective = self._decoding
            parts = int(samples.parts[-1]) + 1
            self._mse = torch.ones(parts, dtype=samples.dtype, device=samples.device)
        self.fit = Fit(net, objective, config.method, config.learning_rate, generator)
        self._validate()

    def _own_z(self) -> np.ndarray:
        """Compute the z along the episodes from the trained T, (kept, batch, nz).

        It is T(x(t)) + Φ(t)(z₀ − T(x₀)), or T(t, x(t)) of a driven plant.
        """
        data, map_of = self.samples.data, self.encoder
        if self.samples.driven:
            clock = self.samples.clock(data.t[:, None], data.u)
            x = np.concatenate(
                [data.x, np.broadcast_to(clock, (*data.x.shape[:2], clock.shape[-1]))], axis=-1
            )
            return perceptron(map_of, self.config.activation, x)
        # The transient from z₀ to T(x) decays with Φ.
        T, T0 = (perceptron(map_of, self.config.activation, x) for x in (data.x, data.x0))
        first = self.samples.t[0]
        y0 = self.samples.system.h(first, data.x0, np.asarray(self.samples.system.input(first)))
        z0 = y0 @ at_rest(self.samples.dynamics, self.config.start).T
        if self.config.start == "prior":
            z0 = z0 + perceptron(map_of, self.config.activation, self.samples.prior)
        return T + np.einsum("kij,bj->kbi", data.flow, z0 - T0)

    def _decoding(self, generator: torch.Generator) -> Sequence[Equations]:
        """Draw the equations x̂ = x of T* at random samples.

        They are weighted by the inverse of the root mean square error in their part of the episode.
        Otherwise the transient, whose errors are never small, would dominate.
        """
        samples = self.samples
        k, i = samples.draw(generator, samples.system.nx)
        # Inputs of T*: z with a random draw of the noise, and the clock.
        rows = samples.z_noise.shape[1]
        j = torch.randint(rows, (len(k),), generator=generator).to(samples.device)
        a = torch.cat([samples.z[k, i] + samples.z_noise[k, j], samples.clocked(k, i)], dim=-1)
        target, part = samples.x[k, i], samples.parts.to(samples.device)[k]
        with torch.no_grad():  # moving average of each part's error, and the weights from it
            square = (self.fit.net(a) - target).square().mean(dim=-1)
            count = torch.bincount(part, minlength=len(self._mse))
            mse = torch.zeros_like(self._mse).index_add_(0, part, square) / count.clamp(min=1)
            self._mse = torch.where(count > 0, _USUAL * self._mse + (1 - _USUAL) * mse, self._mse)
            usual = self._mse + _SHARE * self._mse.mean()
            weight = (usual.mean() / usual).sqrt()[part][:, None]
        return [Equations([Term(a)], target, weight)]

    @property
    def _stage_progress(self) -> float:
        """Finished fraction of the current stage: of its steps or, if larger, of its CPU time."""
        config = self.config
        steps = config.iterations * (config.share if self.stage == "T" else 1.0)
        done = self.fit.iteration / steps
        if self._deadline is not None:
            budget = self._deadline - self._stage_start
            share = budget * config.share / (1 + config.share) if self.stage == "T" else budget
            spent = self._clock() - self._stage_start
            done = max(done, spent / max(share, 1e-9))
        return done

    def traded(self) -> dict[str, float]:
        """Return the errors between which a cut-off trades; see
        `trainers.kkl.trainer.KKLTrainer`."""
        noisy, clean = (self._held_squares(noise).cpu().numpy() for noise in (True, False))
        t = self.samples.data.t
        late = t >= t[0] + 0.75 * (t[-1] - t[0])
        end, without = noisy[late].mean(), clean[late].mean()
        above = np.flatnonzero(noisy > 4 * end)
        scale = self.samples.noise_std / output_scale(self.samples.system)
        own = float(np.sqrt(np.mean(scale**2)))
        return {
            "noisy": float(np.sqrt(end)),
            "clean": float(np.sqrt(without)),
            "noise_gain": float(np.sqrt(max(end - without, 0.0))) / own if own else 0.0,
            "convergence": float(t[above[-1]]) if len(above) else 0.0,
        }

    def _stage_over(self) -> bool:
        """Return whether the steps, the time or the patience of the stage are used up."""
        best = self.best[self.stage]
        config = self.config
        steps = config.iterations * (config.share if self.stage == "T" else 1.0)
        waited = (self.fit.iteration - best.iteration) / steps
        return self._stage_progress >= 1 or (waited >= config.patience and self.fit.iteration > 0)

    def _validate(self) -> None:
        """Compute the validation error, and keep the weights if it is the least so far."""
        with torch.no_grad():
            self.latest = self._held_error()
        best = self.best.get(self.stage)
        if best is None or self.latest < best.error:
            self.best[self.stage] = BestWeights(
                self.latest, self.fit.iteration, self.fit.net.layers()
            )

    def _held_error(self) -> float:
        """Return the validation error.

        For T it is the mean squared residual of fixed equations; for T* the geometric mean over
        the parts of the episode of the mean squared error on held-out episodes.
        """
        net = self.fit.net
        if self.stage == "T":
            losses = [e.residual(net).square().mean() for e in self._checked]
            return float(torch.stack(losses).sum())
        square = self._held_squares(noise=True)
        parts = torch.zeros_like(self._mse).index_add_(
            0, self.samples.parts.to(self.samples.device), square
        )
        count = torch.bincount(self.samples.parts, minlength=len(parts)).to(self.samples.device)
        return float((parts / count).log().mean().exp())

    def _held_squares(self, noise: bool) -> Tensor:
        """Return the mean squared scaled errors of x̂ on the held-out episodes, (kept,)."""
        with torch.no_grad():
            z = self.samples.z[:, self.samples.held]
            if noise:
                z = z + self.samples.z_noise[:, : self.samples.held.stop]
            clock = self.samples.times[:, self.samples.held].expand(-1, z.shape[1], -1)
            error = self.fit.net(torch.cat([z, clock], -1)) - self.samples.x[:, self.samples.held]
            return error.square().mean((1, 2))

    def state(self) -> dict[str, Any]:
        """Return all that `load_state` needs to resume exactly; samples are simulated again."""
        return {
            "stage": self.stage,
            "stage_start": self._stage_start,
            "best": {
                stage: {f.name: getattr(best, f.name) for f in fields(BestWeights)}
                for stage, best in self.best.items()
            },
            "usual": None if self.stage == "T" else self._mse.cpu().numpy(),
            "fit": self.fit.state(),
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Restore the result of `state`."""
        self.best = {stage: BestWeights(**weights) for stage, weights in state["best"].items()}
        kept = dict(self.best)
        if state["stage"] != "T":
            self._begin("T*")
        self.fit.load_state(state["fit"])
        self.best = kept
        if state["usual"] is not None:
            self._mse = torch.from_numpy(state["usual"]).to(self.samples.device)
        self._stage_start = state["stage_start"]
        # A fit that its budget has ended goes on if there is more of it now.
        if state["stage"] == "done" and self._stage_over():
            self.stage = "done"


def _held_equations(objective: Objective, seed: int) -> list[Equations]:
    """Draw five batches of equations for the validation of T."""
    generator = torch.Generator().manual_seed(seed + 10**6)
    return [e for _ in range(5) for e in objective(generator)]
