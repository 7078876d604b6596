"""The estimator that runs a trained agent of Stable-Baselines3."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pinnobs_gym.envs.actions import AgentMemory, EstimateForm, Form, form_of
from pinnobs_gym.estimation.estimator import Estimator, State
from pinnobs_gym.estimation.learned.perceptron import perceptron
from pinnobs_gym.estimation.learned.trained import LearnedEstimator, Trained
from pinnobs_gym.estimation.learned.trained_file import check_same, plain
from pinnobs_gym.estimation.takes import EVERYTHING
from pinnobs_gym.simulation.initial_set import prior_moments
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.system import Setup, System

Layer = tuple[np.ndarray, np.ndarray]
"""Weights (rows, columns) and biases (rows,)."""

SETUP = ("xhat0", "P0", "dt", "duration", "noise_std")
"""Fields of the training's setup that the form of actions and features uses."""
SAME_STEP = 0.05
"""Largest relative difference of a step from that of the training."""
TINY = 1e-8
"""Number that SB3's ``VecNormalize`` adds to the variance of features."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainedAgent(Trained):
    """The policy of a trained agent. Its loss is the trainer's measure on held-out episodes."""

    layers: tuple[Layer, ...]
    """Layers from the normalised features, or from the recurrent layer, to the action."""
    recurrent: tuple[Layer, Layer] | None
    """Weights on the input and on the state of a long short-term memory before the other layers
    (gates in the order input, forget, cell, output, as in torch); None without one."""
    normalization: Layer
    """Mean and variance of the features."""
    clip: float
    """Bound on the absolute values of normalised features."""
    activation: str
    """Activation of all layers except the last: ``tanh`` or ``relu``."""
    squash: bool
    """Whether the action is the hyperbolic tangent of the last layer; otherwise it is clipped at
    ±1."""
    algorithm: str
    action_mode: str
    stack: int
    """Number of the last outputs in the features."""
    setup: Mapping[str, Any]
    """The fields `SETUP` of the training's setup."""
    sb3: str
    """Version of Stable-Baselines3 used in training."""
    steps: int
    """Number of env steps in training, summed over all rows."""

    @property
    def notes(self) -> Mapping[str, Any]:
        names = ("algorithm", "action_mode", "sb3", "steps")
        return {"reward": "of the true states", **{name: getattr(self, name) for name in names}}

    def check_fits(self, path: str | Path, system: System) -> None:
        installed = importlib.metadata.version("stable-baselines3")
        if self.sb3.partition(".")[0] != installed.partition(".")[0]:
            raise ValueError(
                f"{path} was trained with stable-baselines3 {self.sb3}; {installed} is installed, "
                "of another major version"
            )
        form = self.form(system)
        actions: int = form.action_space.shape[0]
        sizes = [self.normalization[0].size, len(self.layers[-1][1])]
        check_same(path, {"sizes": sizes}, {"sizes": [form.num_features, actions]})

    def form(self, system: System, noise_std: Any = None) -> Form:
        """Return the form of actions and features for a known noise level; that of the training if
        None."""
        known = dict(self.setup) | ({} if noise_std is None else {"noise_std": noise_std})
        setup = replace(system.setups["benchmark"], **known)
        form = form_of(self.action_mode, system, setup, self.stack)
        # With a mask if it was trained under a condition that loses outputs.
        masked = form_of(self.action_mode, system, setup, self.stack, mask=True)
        return masked if self.normalization[0].size == masked.num_features else form

    def begin(self, batch: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the initial hidden and cell state of the recurrent layer, (batch, size) each; the
        size is 0 without such a layer."""
        size = 0 if self.recurrent is None else self.recurrent[1][0].shape[1]
        return np.zeros((batch, size)), np.zeros((batch, size))

    def act(
        self, features: np.ndarray, state: tuple[np.ndarray, np.ndarray]
    ) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Return the actions (batch, n) without exploration for features (batch, m), and the next
        state of the recurrent layer. The computation is in double precision, and the result of a
        row does not depend on its batch."""
        mean, variance = self.normalization
        x = np.clip((features - mean) / np.sqrt(variance + TINY), -self.clip, self.clip)
        if self.recurrent is not None:
            x, state = _remember(self.recurrent, x, state)
        z = perceptron(self.layers, self.activation, x)
        return np.tanh(z) if self.squash else np.clip(z, -1.0, 1.0), state


def _remember(
    layer: tuple[Layer, Layer], x: np.ndarray, state: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Return the output and the next state of a long short-term memory (Hochreiter & Schmidhuber
    1997, with a forget gate)."""
    (W, b), (V, c) = layer
    hidden, cell = state
    gates = np.split(x @ W.T + b + hidden @ V.T + c, 4, axis=1)
    enter, forget, leave = (0.5 + 0.5 * np.tanh(0.5 * gates[i]) for i in (0, 1, 3))
    cell = forget * cell + enter * np.tanh(gates[2])
    hidden = leave * np.tanh(cell)
    return hidden, (hidden, cell)


@dataclass(frozen=True)
class Sb3(LearnedEstimator, Estimator):
    """An agent trained by reinforcement learning with Stable-Baselines3, run without exploration.
    Its reward in training is computed from the true states.

    The meaning of its actions is a form of `pinnobs_gym.envs.actions`. With ``gain`` the agent
    chooses the gain of an observer on the model at every sample.

    When to choose it: to study reinforcement learning as a way to an estimator, or where only a
    reward is known. The filters are more precise on the systems here.
    """

    trained: TrainedAgent = field(kw_only=True, repr=False)
    """The trained agent."""

    name = "sb3"
    takes = EVERYTHING - {"sampled_noise"}
    equations = r"""
\hat x_k &= \hat x_k^- + \sigma(k) \odot \rho_k\, \bigl( e_k \oslash \sqrt{S(k)} \bigr), \qquad
e_k = y_k - h(t_k, \hat x_k^-, u_k) \\
\rho_k &= \pi(\text{features of } e_k, \hat x_k^-, u_k, k) \quad
\text{(action mode gain: correlations in } [-1, 1]^{n_x \times n_y} \text{)}
"""
    needs_training = "rl"
    knows = ("model", "prior", "noise", "initial set", "true states in training")
    exempt_from = {
        "model_alone": "an agent's action may move the estimate at any time",
        "blank_rows": "its agent acts once per row",
        "units": "its agent sees numbers in the units of its training",
    }

    @cached_property
    def _form(self) -> Form:
        return self.trained.form(self.system, self.noise_std)

    def unfit(self, t: np.ndarray) -> str:
        """Return what differs from the training: the step, on which the meaning of actions depends,
        or an end after T for a form that sees t/T."""
        dt = float(self.trained.setup["dt"])
        steps = np.diff(t)
        wrong = np.flatnonzero(abs(steps - dt) > SAME_STEP * dt)
        if len(wrong):
            k = wrong[0]
            return (
                f"was trained on samples every {dt:g} s; the record has a step of {steps[k]:.6g} s "
                f"at t={t[k]:g} s, and the agent acts once per sample"
            )
        lasts, longest = float(t[-1] - t[0]), self._form.duration
        if isinstance(self._form, EstimateForm) and lasts > longest * (1 + SAME_STEP):
            return (
                f"was trained on episodes of {longest:g} s; the record lasts {lasts:g} s, and the "
                f"agent (action mode {self.trained.action_mode}) sees how much of that is over"
            )
        return ""

    def reset(self, prior: Prior) -> State:
        return State(np.asarray(prior.mean, dtype=float))

    def update(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        now = np.full(len(y), t)
        memory: AgentMemory
        if state.t is None:
            memory, hidden = self._form.begin(state.xhat, now, u), self.trained.begin(len(y))
        else:
            memory, hidden = state.memory
        features, memory = self._form.observe(memory, now, y, u)
        actions, hidden = self.trained.act(features, hidden)
        memory = self._form.act(memory, actions)
        return State(memory.xhat, t, u, memory=(memory, hidden))


def setup_of(system: System, setup: Setup) -> dict[str, Any]:
    """Return the fields `SETUP` of a system's setup as plain values that JSON can represent, the
    prior in numbers."""
    xhat0, P0 = prior_moments(system, setup)
    setup = replace(setup, xhat0=xhat0.tolist(), P0=P0.tolist())
    return plain({name: np.asarray(getattr(setup, name)) for name in SETUP})
