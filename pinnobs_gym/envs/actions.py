"""Forms of the estimation task: the meaning of an agent's actions, and its observations.

A form converts the samples of a batch of episodes into features, and actions into estimates. It has
the same information as an estimator (outputs, inputs and the model) and is the same for single and
vectorised envs, and for a trained agent used as an estimator (`pinnobs_gym.estimators.sb3`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, replace
from typing import ClassVar

import numpy as np
from gymnasium.spaces import Box

from pinnobs_gym.estimation.gaussian import GaussianEstimator
from pinnobs_gym.estimation.kalman import joseph_update, predict
from pinnobs_gym.estimation.least_squares import root
from pinnobs_gym.registry import did_you_mean
from pinnobs_gym.simulation.initial_set import prior_moments
from pinnobs_gym.simulation.kernels.asked import ask
from pinnobs_gym.simulation.model import model_step
from pinnobs_gym.simulation.noise import AssumedNoise
from pinnobs_gym.simulation.residual import nearest
from pinnobs_gym.simulation.system import Setup, System, vector
from pinnobs_gym.simulation.values import is_whole, shortly

LARGEST_REWARD = 10.0
"""Bound of the absolute value of the reward ``improvement``."""
OUTSIDE = 2.0
"""Estimates of the gain and correction forms are clipped to the box of estimates times this
factor."""
_DRAWS = 33
"""Number of simulated episodes of the model from which the typical error is computed."""


@dataclass(frozen=True)
class AgentMemory:
    """The memory of a form for a batch of episodes."""

    xhat: np.ndarray
    """The prediction x̂(k|k−1), or after an action the estimate x̂(k|k), shape (batch, nx)."""
    start: np.ndarray
    """Times of the first samples in s, shape (batch,)."""
    t: np.ndarray
    """Times of the last samples in s, shape (batch,)."""
    u: np.ndarray
    """Inputs at the last samples, shape (batch, nu)."""
    y: np.ndarray
    """The last outputs, newest first, shape (batch, stack, ny); NaN where they are missing and
    before the first."""
    held: np.ndarray
    """The same with the latest present output in place of missing ones; zero before the first."""
    surprise: np.ndarray
    """Innovations over their typical standard deviation, shape (batch, ny); zero where y is
    missing."""

    def rows(self, rows: np.ndarray) -> AgentMemory:
        """Return the memory of the rows that indices or a mask select."""
        return AgentMemory(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})

    def with_rows(self, rows: np.ndarray, other: AgentMemory) -> AgentMemory:
        """Return the memory in which those of another replace the rows that indices or a mask
        select."""
        merged = {}
        for f in fields(self):
            merged[f.name] = getattr(self, f.name).copy()
            merged[f.name][rows] = getattr(other, f.name)
        return AgentMemory(**merged)


class Form(ABC):
    """A form of the task.

    Args:
        system: the model.
        setup: defines the length of episodes, the prior and the noise.
        stack: number of the last outputs in the features.
        mask: whether features that hold outputs also say which of them are present.
    """

    name: ClassVar[str]
    action_space: Box
    """The action space of one episode."""

    def __init__(self, system: System, setup: Setup, stack: int = 1, mask: bool = False) -> None:
        if not is_whole(stack, 1):
            raise ValueError(f"stack={shortly(stack)}; expected a whole number of at least 1")
        self.system, self.setup, self.stack, self.mask = system, setup, int(stack), mask
        self.scale = vector(system.scale, system.nx, "scale")
        bound = system.state_bound or tuple(10 * s for s in system.scale)
        self.bound = np.asarray(bound, dtype=float)
        self.duration = float(setup.times[-1])
        self.prepare()
        self.observation_space = self.features_space()

    @abstractmethod
    def prepare(self) -> None:
        """Set ``action_space`` and other attributes of the form.

        Raises:
            ValueError: in one line, if the form does not support the system or the stack.
        """

    @property
    @abstractmethod
    def num_features(self) -> int:
        """Number of features; the last one is a time from 0 to 1."""

    def features_space(self) -> Box:
        """Return the space of the features of one episode."""
        high = np.full(self.num_features, np.inf, np.float32)
        low = -high
        low[-1], high[-1] = 0, 1
        return Box(low, high)

    def begin(self, mean: np.ndarray, t: np.ndarray, u: np.ndarray) -> AgentMemory:
        """Return the memory before the first samples.

        Args:
            mean: prior means x̂₀, shape (batch, nx).
            t: times of the first samples in s, shape (batch,).
            u: inputs at these times, shape (batch, nu).
        """
        y = np.full((len(mean), self.stack, self.system.ny), np.nan)
        return AgentMemory(np.asarray(mean, dtype=float), t, t, u, y, np.zeros_like(y), y[:, 0])

    def observe(
        self, memory: AgentMemory, t: np.ndarray, y: np.ndarray, u: np.ndarray
    ) -> tuple[np.ndarray, AgentMemory]:
        """Return the features (batch, num_features) of the samples at times t, and the new memory.

        Args:
            memory: memory after the previous action.
            t: sample times in s, shape (batch,).
            y: outputs, shape (batch, ny); NaN marks a missing output.
            u: inputs, shape (batch, nu).
        """
        latest = np.where(np.isnan(y), memory.held[:, 0], y)
        pairs = ((y, memory.y), (latest, memory.held))
        outputs, held = (np.concatenate([new[:, None], old[:, :-1]], axis=1) for new, old in pairs)
        memory = self.predict(replace(memory, y=outputs, held=held), t, u)
        memory = replace(memory, t=t, u=u)
        return self.features(memory), memory

    @abstractmethod
    def predict(self, memory: AgentMemory, t: np.ndarray, u: np.ndarray) -> AgentMemory:
        """Return the memory with the model's prediction for the samples at times t, whose outputs
        it already holds."""

    @abstractmethod
    def features(self, memory: AgentMemory) -> np.ndarray:
        """Return the features (batch, num_features) of the last samples."""

    @abstractmethod
    def act(self, memory: AgentMemory, actions: np.ndarray) -> AgentMemory:
        """Return the memory with the estimates that result from actions (batch, ...)."""

    def checked(self, actions: np.ndarray) -> np.ndarray:
        """Return actions (batch, ...) in double precision, NaN where they are infinite: an action
        that is not finite has no finite estimate, even where the form clips.

        Raises:
            ValueError: in one line, if their shape is wrong.
        """
        actions = np.asarray(actions, dtype=float)
        actions = np.where(np.isinf(actions), np.nan, actions)
        shape: tuple[int, ...] = self.action_space.shape
        if actions.shape[1:] != shape:
            raise ValueError(
                f"action has shape {actions.shape[1:]}; action_mode={self.name!r} of "
                f"{type(self.system).__name__} expects {shape}"
            )
        return actions


class EstimateForm(Form):
    """Base class of forms whose action is an estimate. Features are the last outputs, newest first,
    then with ``mask`` a 1 for each of them that is present and a 0 for one that is missing, then u
    and t/T. In place of a missing output is the latest present one, zero before the first. The
    model is not used."""

    @property
    def num_features(self) -> int:
        return (1 + self.mask) * self.stack * self.system.ny + self.system.nu + 1

    def features_space(self) -> Box:
        space, outputs = super().features_space(), self.stack * self.system.ny
        if not self.mask:
            return space
        low, high = space.low.copy(), space.high.copy()
        low[outputs : 2 * outputs], high[outputs : 2 * outputs] = 0, 1
        return Box(low, high)

    def predict(self, memory: AgentMemory, t: np.ndarray, u: np.ndarray) -> AgentMemory:
        return memory

    def features(self, memory: AgentMemory) -> np.ndarray:
        parts = [memory.held, ~np.isnan(memory.y)] if self.mask else [memory.held]
        time = (memory.t - memory.start) / self.duration
        outputs = [part.reshape(len(time), -1) for part in parts]
        return np.concatenate([*outputs, memory.u, time[:, None]], axis=1)


class Estimate(EstimateForm):
    """The action is x̂ in physical units."""

    name = "estimate"

    def prepare(self) -> None:
        largest = self.bound.astype(np.float32)
        self.action_space = Box(-largest, largest)

    def act(self, memory: AgentMemory, actions: np.ndarray) -> AgentMemory:
        return replace(memory, xhat=self.checked(actions))


class Normalized(EstimateForm):
    """The action is x̂ over the bounds of the states."""

    name = "normalized"

    def prepare(self) -> None:
        self.action_space = _unit_box(self.system.nx)

    def act(self, memory: AgentMemory, actions: np.ndarray) -> AgentMemory:
        return replace(memory, xhat=self.bound * self.checked(actions))


class PredictionForm(Form):
    """Base class of forms whose action corrects the model's prediction x̂⁻ by a fraction of the
    typical error σ(k), a fixed schedule common to all episodes (`typical`).

    Features: asinh of the innovation over √S, zero where the output is missing, x̂⁻ over its scale,
    u over its largest value, and log(1 + k)/log(1 + N), with k the index of the sample and N that
    of the last sample.
    """

    def prepare(self) -> None:
        if self.stack != 1:
            raise ValueError(
                f"stack={self.stack} goes with estimates; {self.name!r} has a prediction"
            )
        ask(self.system, "model")
        self.sigma, self.root_S = typical(self.system, self.setup)
        u = abs(np.asarray(self.system.input(self.setup.times))).max(axis=0, initial=0.0)
        self.u_scale = np.where(u > 0, u, 1.0)
        self.action_space = _unit_box(self.num_actions)

    @property
    @abstractmethod
    def num_actions(self) -> int:
        """Number of components of an action, each from −1 to 1."""

    @property
    def num_features(self) -> int:
        return self.system.ny + self.system.nx + self.system.nu + 1

    def predict(self, memory: AgentMemory, t: np.ndarray, u: np.ndarray) -> AgentMemory:
        xhat = model_step(self.system, memory.t, t, memory.xhat, memory.u, u)
        y = memory.y[:, 0]
        innovation = self.system.output_residual(y, self.system.h(t, xhat, u))
        surprise = innovation / self.root_S[self._samples(t, memory)]
        return replace(memory, xhat=xhat, surprise=np.where(np.isnan(y), 0.0, surprise))

    def features(self, memory: AgentMemory) -> np.ndarray:
        k = np.minimum((memory.t - memory.start) / self.setup.dt, self.setup.num_steps)
        time = np.log1p(k) / np.log1p(self.setup.num_steps)
        xhat = nearest(memory.xhat, 0.0, self.system.state_period) / self.scale
        parts = (np.arcsinh(memory.surprise), xhat, memory.u / self.u_scale)
        return np.concatenate([*parts, time[:, None]], axis=1)

    def corrected(self, memory: AgentMemory, share: np.ndarray) -> AgentMemory:
        """Return the predictions corrected by a fraction (batch, nx) of the typical error, within
        bounds."""
        periods = self.system.state_period or [None] * self.system.nx
        repeats = np.array([period is not None for period in periods])
        largest = np.where(repeats, np.inf, OUTSIDE * self.bound)
        xhat = memory.xhat + share * self.sigma[self._samples(memory.t, memory)]
        return replace(memory, xhat=np.clip(xhat, -largest, largest))

    def improvement(self, memory: AgentMemory, xhat: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Return the decrease of the squared error due to the correction, relative to the typical
        one, (batch,).

        At each sample the best gain is the same as for −mean(((x̂ − x)/scale)²), because the
        subtracted and dividing terms do not depend on the action. The rewards of all samples have a
        similar size, however, while squared errors span six powers of ten.

        Args:
            memory: the memory before the correction.
            xhat: the corrected estimates, shape (batch, nx).
            x: the true states, shape (batch, nx).
        """
        nis = (memory.surprise**2).sum(axis=1) / self.system.ny
        with np.errstate(all="ignore"):
            residual = self.system.state_residual
            less = residual(memory.xhat, x) ** 2 - residual(xhat, x) ** 2
            less /= self.sigma[self._samples(memory.t, memory)] ** 2
            return np.clip(less.mean(axis=1) / (1 + nis), -LARGEST_REWARD, LARGEST_REWARD)

    def _samples(self, t: np.ndarray, memory: AgentMemory) -> np.ndarray:
        """Return the indices of samples in the schedules."""
        k = np.rint((t - memory.start) / self.setup.dt).astype(int)
        return np.minimum(k, len(self.sigma) - 1)


class Gain(PredictionForm):
    """The action defines a gain L on the innovation: x̂ = x̂⁻ + L(y − h(t, x̂⁻, u)), x̂⁻ from the
    model.

    The Kalman gain of state i and output j is ρσᵢ/√Sⱼ, where σᵢ is the standard deviation of the
    prediction error, √Sⱼ that of the innovation, and ρ their correlation. The action is ρ, nx·ny
    numbers, row by row. σ(k) and S(k) are the schedules, so that the agent need not learn over
    which powers of ten a gain decays; it must find the right ρ in each episode.
    """

    name = "gain"

    @property
    def num_actions(self) -> int:
        return self.system.nx * self.system.ny

    def act(self, memory: AgentMemory, actions: np.ndarray) -> AgentMemory:
        correlation = self.checked(actions).reshape(-1, self.system.nx, self.system.ny)
        with np.errstate(all="ignore"):  # rows may contain values that are not finite
            share = np.einsum("bij,bj->bi", correlation, memory.surprise)
        return self.corrected(memory, share)


class Correction(PredictionForm):
    """The action is the correction of the model's prediction, over `LARGEST_CORRECTION` times the
    typical error σ(k)."""

    name = "correction"

    @property
    def num_actions(self) -> int:
        return self.system.nx

    def act(self, memory: AgentMemory, actions: np.ndarray) -> AgentMemory:
        return self.corrected(memory, LARGEST_CORRECTION * self.checked(actions))


LARGEST_CORRECTION = 3.0
"""Correction for an action of one, in typical errors; see `Correction`."""

FORMS: dict[str, type[Form]] = {f.name: f for f in (Estimate, Normalized, Gain, Correction)}
"""The forms by their ``action_mode``."""


def form_of(
    action_mode: str, system: System, setup: Setup, stack: int = 1, mask: bool = False
) -> Form:
    """Return the form of that name; see `Form`.

    Raises:
        ValueError: listing the known names, if it is unknown.
    """
    if not isinstance(action_mode, str) or action_mode not in FORMS:
        raise ValueError(
            f"unknown action_mode {shortly(action_mode)}; known are {', '.join(FORMS)}"
            f"{did_you_mean(action_mode, FORMS)}"
        )
    return FORMS[action_mode](system, setup, stack, mask)


def typical(system: System, setup: Setup) -> tuple[np.ndarray, np.ndarray]:
    """Return the typical size of prediction errors, σ (num_steps + 1, nx) in state units, and of
    innovations, √S (num_steps + 1, ny) in output units, at each sample of an episode.

    Both are medians of a Kalman filter's covariances along trajectories of the model from initial
    states drawn from the prior. They depend on the model, prior and noise alone.

    Raises:
        ValueError: in one line, if the model diverges from every draw.
    """
    times, nx = setup.times, system.nx
    mean, cov = prior_moments(system, setup)
    draws = np.random.default_rng(0).standard_normal((_DRAWS, nx))
    x = mean + draws @ root(cov[..., None])[..., 0].T
    P = np.broadcast_to(cov[..., None], (nx, nx, _DRAWS))
    told = system.noise(setup.noise_std, setup.process_noise)
    noise = AssumedNoise.of(system, told, GaussianEstimator.assumed_noise)
    u = np.broadcast_to(np.asarray(system.input(times))[:, None], (len(times), _DRAWS, system.nu))
    zero = np.zeros((_DRAWS, system.ny))
    variance, S_all = np.empty((len(times), nx, _DRAWS)), np.empty((len(times), system.ny, _DRAWS))
    with np.errstate(all="ignore"):  # the model may diverge from some draws
        for k, t in enumerate(times):
            if k:
                x, P, *_ = predict(system, (times[k - 1], t), x, P, noise, (u[k - 1], u[k]))
            variance[k] = np.einsum("iib->ib", P)
            # Covariances of the update; the zero innovation leaves the trajectory unchanged.
            H = system.h_jacobian(t, x, u[k]).transpose(1, 2, 0)
            _, P, S = joseph_update(x, P, zero, H, noise.R(float(t)))
            S_all[k] = np.einsum("iib->ib", S)
        sound = np.isfinite(variance).all(axis=(0, 1)) & np.isfinite(S_all).all(axis=(0, 1))
    if not sound.any():
        name = type(system).__name__
        raise ValueError(f"{name}: the model runs away from every draw of its prior; no gain scale")
    sigma = np.sqrt(np.median(variance[..., sound], axis=2))
    return sigma, np.sqrt(np.median(S_all[..., sound], axis=2))


def _unit_box(size: int) -> Box:
    """Return a box of numbers from −1 to 1."""
    return Box(-1.0, 1.0, (size,), np.float32)
