"""Beliefs about a plant and their probabilities, learned on simulations of the model under random
conditions.

A dictionary of beliefs is run on the simulated episodes (`dictionary`), each with its filters. What
the filters say at some samples, of the outputs so far and of the true state, is all that the fit
needs (`fitting`): the probabilities of the beliefs before the first sample are those that give the
true states the highest density, a proper score, so that the covariance is learned with the
estimate. With ``supervision="outputs"`` the density is that
of the outputs, and no true state is used.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimation.learned.beliefs import Beliefs
from pinnobs_gym.estimators.robust_gain import RobustGain, TrainedBeliefs
from pinnobs_gym.simulation.matrices import cholesky, squared_size
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import vector
from pinnobs_gym.training.trainer import Trainer
from trainers.robust_gain.conditions import draw_condition, model_is_right
from trainers.robust_gain.config import HELD_OUT, RobustGainConfig, from_outputs
from trainers.robust_gain.dictionary import RIGHT, dictionary, right
from trainers.robust_gain.fitting import Evidence, fit, joined

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_LOOKS = 70
"""Largest number of samples of an episode at which the filters are asked."""
_SMALL = 1e-14
"""Variance that is added to those of scaled states, which may be zero."""
_LOWEST = -1e5
"""Logarithm of a density that stands for all lower ones."""


class RobustGainTrainer(Trainer[RobustGainConfig, TrainedBeliefs]):
    """Learn the probabilities of beliefs on episodes that the trainer simulates, each iteration
    under another random condition. A resumed training continues exactly."""

    name = "robust_gain"
    takes = RobustGain.takes
    simulates = True
    presets = {"default": RobustGainConfig, "outputs": from_outputs}

    def start(self) -> None:
        self.base = self.game.nominal.source
        if self.base.system.measured_input and not self.base.system.draws_input:
            raise ValueError(
                f"{type(self.system).__name__} has a measured input; robust_gain is trained on "
                "simulated episodes and needs an input or draw_input"
            )
        self.whole = dictionary(self.base, self.config)
        self.evidence: list[Evidence] = []
        """What each condition so far says."""
        self.right: list[bool] = []
        """Whether the model was right under each."""
        self.latest = math.nan
        self._estimator = self._of(self.whole)

    def _of(self, beliefs: Beliefs) -> RobustGain:
        trained = self._trained(beliefs, math.nan)
        return RobustGain(self.base.system, *self.levels, trained=trained)

    def _trained(self, beliefs: Beliefs, loss: float) -> TrainedBeliefs:
        facts = self.facts(loss=loss, seed=self.config.seed)
        return TrainedBeliefs(**facts, beliefs=beliefs, leak=self.config.leak)

    def step(self) -> None:
        """Simulate the episodes of a random condition, and run the filters of all beliefs."""
        number = self.iteration
        rng = np.random.default_rng((self.config.seed, number))
        condition, game = draw_condition(rng, self.base.system), self.game.nominal
        source = EpisodeSource(game.system, game.name.setup, condition, **game.changes)
        first, size = self.episode + number * self.config.per_condition, self.config.per_condition
        found = self._looks(source, list(range(first, first + size)))
        if found:
            self.evidence.append(joined(found))
            self.right.append(model_is_right(condition))
        self.iteration += 1
        self.latest = float(sum(len(each.weight) for each in found))
        if self.iteration >= HELD_OUT and 2 * len(self.evidence) < self.iteration:
            lost = self.iteration - len(self.evidence)
            raise ValueError(
                f"the states of {type(self.system).__name__} leave the finite numbers in all "
                f"episodes of {lost} of {self.iteration} conditions; expected at most half"
            )

    def _looks(self, source: EpisodeSource, seeds: list[int]) -> list[Evidence]:
        """Return what the filters say of the episodes of these seeds: of all together or, if one
        leaves the finite numbers, of each of the others."""
        try:
            episodes = source.play(source.draw(source.streams(seeds)))
        except FloatingPointError:
            if len(seeds) == 1:
                return []
            return [each for seed in seeds for each in self._looks(source, [seed])]
        record = source.record(episodes)
        truth = episodes.x[: record.num_samples].swapaxes(0, 1)
        return [self._look(source, record, truth)]

    def _look(self, source: EpisodeSource, record: Record, truth: np.ndarray) -> Evidence:
        """Return what the filters say of a record with these true states (batch, num_samples,
        nx)."""
        setup, system = source.setup, self.base.system
        estimator = RobustGain(
            system, setup.noise_std, setup.process_noise, trained=self._estimator.trained
        )
        found, n = estimator.hypotheses(record), record.num_samples
        assert found.P is not None
        assert found.innovation is not None
        assert found.S is not None
        R, missing = estimator.noise.R(0.0)[None], np.isnan(record.y)
        density = self.whole.densities(found.innovation, found.S, R, missing)
        density = np.where(np.isfinite(density), np.maximum(density, _LOWEST), _LOWEST)
        late = np.linspace(0, n - 1, MOST_LOOKS // 2)
        looks = np.unique(
            np.concatenate([np.geomspace(1, n, MOST_LOOKS // 2) - 1, late]).astype(int)
        )
        outputs = np.cumsum(density, axis=2)[..., looks]
        states = np.zeros(outputs.shape)
        if self.config.supervision == "states":
            scale = vector(system.scale, system.nx, "scale")
            with np.errstate(all="ignore"):
                error = (
                    system.state_residual(found.xhat[:, :, looks], truth[:, None, looks]) / scale
                )
                P = found.P[:, :, looks] / (scale[:, None] * scale) + _SMALL * np.eye(len(scale))
                flat = P.reshape(-1, system.nx, system.nx).transpose(1, 2, 0)
                size = squared_size(error.reshape(-1, system.nx), flat)
                pivots = np.einsum("iib->ib", cholesky(flat))
                states = -(size / 2 + np.log(pivots).sum(axis=0)).reshape(states.shape)
            states = np.where(np.isfinite(states), np.maximum(states, _LOWEST), _LOWEST)
        else:
            outputs, states = outputs[..., -1:], states[..., -1:]
        kept = [a.transpose(0, 2, 1).reshape(-1, a.shape[1]) for a in (outputs, states)]
        return Evidence(*kept, weight=np.ones(len(kept[0])))

    def _gathered(self, numbers: list[int]) -> Evidence:
        """Return the evidence of some conditions; those under which the model is right have the
        weight `RobustGainConfig.trust` together, if there are any of both kinds."""
        right = np.repeat(
            [self.right[i] for i in numbers], [len(self.evidence[i].weight) for i in numbers]
        )
        weight = np.ones(len(right))
        if right.any() and not right.all():
            trust = self.config.trust
            weight = np.where(right, trust / right.mean(), (1 - trust) / (1 - right.mean()))
        parts = joined([self.evidence[i] for i in numbers])
        return Evidence(parts.outputs, parts.states, weight)

    def finished(self) -> bool:
        return self.iteration >= self.config.iterations

    def progress(self) -> float:
        return self.iteration / self.config.iterations

    def status(self) -> str:
        return f"{self.iteration} conditions, {len(self.whole.weight)} beliefs"

    def curves(self) -> Mapping[str, float]:
        return {"looks": self.latest}

    def result(self) -> TrainedBeliefs:
        """Return the beliefs that are left, with their probabilities.

        Raises:
            ValueError: in one line, if the budget ended before there was a held-out condition.
        """
        number = len(self.evidence)
        held = [i for i in range(number) if i % HELD_OUT == HELD_OUT - 1]
        if not held:
            raise ValueError(
                f"the training ended after {self.iteration} condition(s) "
                f"(budget={self.config.budget}); expected at least {HELD_OUT}, one of them held out"
            )
        learned = self._gathered([i for i in range(number) if i not in held])
        # Of the levels of process noise with which the model counts as right, the best is kept.
        found = []
        for noise in RIGHT:
            others = [right(self.whole, other) for other in RIGHT if other != noise]
            kept = np.flatnonzero(~np.any(others, axis=0))
            hypotheses = np.flatnonzero(np.isin(self.whole.belief, kept))
            part = learned.of(hypotheses)
            beliefs = self.whole.kept(kept, np.full(len(kept), 1 / len(kept)))
            beliefs = self.whole.kept(kept, fit(beliefs, part))
            found.append((part.loss(beliefs.log_prior)[0], beliefs, hypotheses))
        _, beliefs, hypotheses = min(found, key=lambda each: each[0])
        loss, _ = self._gathered(held).of(hypotheses).loss(beliefs.log_prior)
        return self._trained(beliefs, loss)

    def figures(self, trained: TrainedBeliefs) -> dict[str, Figure]:
        return {}

    def state(self) -> dict[str, Any]:
        parts = [(each.outputs, each.states, each.weight) for each in self.evidence]
        return {"evidence": parts, "right": list(self.right)}

    def load_state(self, state: Mapping[str, Any]) -> None:
        self.evidence = [Evidence(*map(np.asarray, part)) for part in state["evidence"]]
        self.right = [bool(each) for each in state["right"]]
