"""The fast recipe: a small network in scaled quantities, points that resolve the initial layer, and
a quasi-Newton method, in NumPy with float64."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from pinnobs_gym.estimation.learned.mlp import Architecture, evaluate
from pinnobs_gym.estimators.pinn_obs import Covariance, TrainedNetwork
from pinnobs_gym.simulation.noise import Noise
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import System
from trainers.pinn_obs.config import PinnObsConfig
from trainers.pinn_obs.guide import LEAVING, Guide, Tracks, guide_of, least_noise, tracks_of
from trainers.pinn_obs.minimum import FIRST_STEP
from trainers.pinn_obs.objective import Lead, Objective, Weights
from trainers.pinn_obs.passes import draw_layers, flattened, unflattened
from trainers.pinn_obs.points import continuous, fast_frequencies, output_scale, points_of
from trainers.pinn_obs.quasi_newton import Inverse, QuasiNewton
from trainers.pinn_obs.recipe import Recipe

UNITS = 20
"""Units of time in a record; one unit corresponds to a second in the paper."""
NOISE = 0.01
"""Standard deviation of the noise, over an output's scale, above which an output weighs less."""
_DECAYS = ((LEAVING, 2.0, 10.0), (1e-3, 1e-2))
"""Time constants of the network's inputs, over the first interval and over the record's length."""
_GAIN = 10.0
"""Factor of the network's gains, in units of state, output and time."""
_SLOPES = 10.0
"""Standard deviation of the first layer's weights of the time from −1 to 1."""
_LEAST_RANGE = 1e-3
"""Least scale of a state, over that of the system."""
_PER_PERIOD = 8
"""Samples needed per period of the outputs."""
_NOISY = 5
"""Factor of the number of samples if they are noisy."""


class FastRecipe(Recipe[Objective, QuasiNewton]):
    """Minimisation of the loss in scaled quantities by self-scaled Broyden steps.

    States are scaled by `System.scale`, or by their range in the guide if that is smaller, outputs
    by the effect of the system's scale on them, and time by twentieths of the record, so that the
    terms of the loss have similar sizes on all systems. The loss that is logged and returned is the
    paper's.

    The loss is taken at some of the samples and at further points right after t₀, where y is
    interpolated linearly, as in the replay. Without these points the network could jump from x̂₀ to
    the trajectory between two samples, and L would be arbitrary. Outputs with noise σ, over their
    scale, have the weight min(1, (0.01/σ)²), so that the estimates follow the equations and do not
    fit the noise.

    With `PinnObsConfig.guide` a penalty draws the estimates and gains towards those of `guide_of`;
    without it, the gains towards zero.
    """

    def __init__(
        self,
        system: System,
        config: PinnObsConfig,
        record: Record,
        noise: Noise,
        tracks: Tracks | None = None,
    ) -> None:
        self.config, self.system = config, system
        self.noise_std = np.sqrt(np.einsum("iib->i", noise.R(0.0)))
        self.record = record = continuous(system, record)
        t = record.t
        noisy = bool(self.noise_std.any())
        most = config.points * (_NOISY if noisy else 1)
        # Points of the loss, and the samples for the guide.
        self.points, samples = points_of(system, self.record, most)
        # Units of time, states, outputs and gains, and the weights of the terms in them.
        length, interval = float(t[-1] - t[0]), float(t[1] - t[0])
        unit = length / UNITS
        y_scale = output_scale(system, self.record)
        self.guide = self._guide_of(samples, y_scale, tracks)
        x_scale = self._state_scale()
        per_gain = x_scale[:, None] / y_scale / unit
        quiet = np.minimum(1.0, (NOISE * y_scale / np.maximum(self.noise_std, 1e-100)) ** 2)
        weights = Weights(
            config.w0 / x_scale**2,
            config.w_ode * (unit / x_scale) ** 2,
            config.w_y * quiet / y_scale**2,
        )
        lead = self._lead_of(x_scale, _GAIN * per_gain)
        # Inputs of the network: the time, decays for the initial layer, and a fast oscillation.
        frequencies = fast_frequencies(self.record)
        self._check_resolution(frequencies, len(samples.t), most)
        decays = [interval * part for part in _DECAYS[0]] + [length * part for part in _DECAYS[1]]
        self.architecture = Architecture(
            system.nx,
            system.ny,
            config.depth,
            config.width,
            config.activation,
            config.dtype,
            span=(float(t[0]), float(t[-1])),
            decays=tuple(map(float, decays)),
            frequencies=tuple(map(float, frequencies)),
            scale=tuple(map(float, (*x_scale, *(_GAIN * per_gain).ravel()))),
        )
        self.objective = Objective(self.architecture, system, self.points, weights, lead)

    @classmethod
    def many(
        cls, system: System, config: PinnObsConfig, rows: Sequence[Record], noise: Noise
    ) -> list[FastRecipe]:
        """Return the recipes of records of one episode each, with the same sample times. The
        filters of their guides are run on all of them at once."""
        if not config.guide:
            return [cls(system, config, row, noise) for row in rows]
        std = np.sqrt(np.einsum("iib->i", noise.R(0.0)))
        most = config.points * (_NOISY if std.any() else 1)
        alike: dict[bytes, tuple[np.ndarray, dict[int, Record]]] = {}
        for i, row in enumerate(rows):  # those with the same noise together
            whole = continuous(system, row)
            told = least_noise(std, output_scale(system, whole))
            group = alike.setdefault(told.tobytes(), (told, {}))[1]
            group[i] = points_of(system, whole, most)[1]
        tracks: dict[int, Tracks] = {}
        for told, group in alike.values():
            parts = list(group.values())
            y, u = (np.concatenate([getattr(p, name) for p in parts]) for name in ("y", "u"))
            mean, cov = (
                np.concatenate([getattr(p.prior, name) for p in parts]) for name in ("mean", "cov")
            )
            batch = Record(parts[0].t, y, u, Prior(mean, cov))
            found = tracks_of(system, batch, told, bool(std.any()) and not config.transfer)
            tracks |= {i: found.row(k) for k, i in enumerate(group)}
        return [cls(system, config, row, noise, tracks[i]) for i, row in enumerate(rows)]

    def _guide_of(
        self, samples: Record, y_scale: np.ndarray, tracks: Tracks | None
    ) -> Guide | None:
        """Return the guide at the points; None, with a warning, if no smoother stays finite."""
        if not self.config.guide:
            return None
        about = (self.system, samples, self.points, self.noise_std, y_scale)
        guide = guide_of(*about, self.config.transfer, tracks)
        if guide is None:
            message = f"no smoother follows this record of {type(self.system).__name__}"
            warnings.warn(f"{message}; training has no guide", stacklevel=2)
        return guide

    def _state_scale(self) -> np.ndarray:
        """Return the scale of each state (nx,): that of the system or, if it is smaller, the range
        of the guide's estimates.

        A state that moves little beside its scale would weigh too little in the loss. On the
        motor's paper setup the speed moves by a thousandth of the system's scale; with that scale
        its errors were a hundred times larger, and the RMSE from 0.03 to 0.20 by the seed.
        """
        scale = np.asarray(self.system.scale, float)
        if self.guide is None:
            return scale
        return np.clip(np.ptp(self.guide.xhat, axis=0), _LEAST_RANGE * scale, scale)

    def _check_resolution(self, frequencies: tuple[float, ...], samples: int, most: int) -> None:
        """Warn if the samples in the loss do not resolve the outputs of a long record."""
        length = float(self.record.t[-1] - self.record.t[0])
        needed = math.ceil(max(frequencies, default=0.0) * length / (2 * math.pi) * _PER_PERIOD)
        if samples < min(needed, self.record.num_samples):
            points = math.ceil(needed * self.config.points / most)
            problem = f"points={self.config.points} do not resolve the outputs over {length:g} s"
            swings = f"they swing {needed / _PER_PERIOD:.0f} times"
            message = f"{problem}: {swings}; take points={points} or a shorter record"
            warnings.warn(message, stacklevel=2)

    def _lead_of(self, x_scale: np.ndarray, L_scale: np.ndarray) -> Lead:
        """Return the targets of the penalty on estimates and gains, with relative weights."""
        config, weights, n = self.config, self.points.equation, len(self.points.t)
        xhat = np.broadcast_to(self.points.xhat0, (n, self.system.nx))
        L = np.zeros((n, *L_scale.shape))
        if self.guide is not None:
            xhat, L = self.guide.xhat, self.guide.L
        # A guide draws x̂ and L in the short initial layer, too, by a weight for each point. Without
        # one, the penalty on L is an integral over time, so that L may be large in that layer.
        each = (weights + 1 / n)[:, None]
        by_gain = weights[:, None] if self.guide is None else each
        return Lead(
            xhat,
            config.guide * each / x_scale**2,
            L,
            config.gain_penalty * by_gain[..., None] / (L_scale**2 + L**2),
        )

    def draw(self, generator: torch.Generator) -> np.ndarray:
        layers = draw_layers(self.architecture, generator)
        weight, bias = layers[0]  # spread the centres of the neurons over the record
        slopes = _SLOPES * torch.randn(len(bias), generator=generator, dtype=bias.dtype)
        middles = 2 * torch.rand(len(bias), generator=generator, dtype=bias.dtype) - 1
        weight[:, 0], bias[:] = slopes, -slopes * middles
        return flattened(layers)

    def begin(self, theta: np.ndarray) -> QuasiNewton:
        return QuasiNewton.start(self.objective, theta, first=FIRST_STEP)

    def held_out(self, theta: np.ndarray) -> None:
        return None

    def completed(self, trained: TrainedNetwork) -> TrainedNetwork:
        return trained

    def covariance(self, theta: np.ndarray) -> Covariance | None:
        """Return the smoother's covariances plus the squared deviations of the network's estimates.

        The smoother's covariance is Laplace's approximation at the smoothed states; the deviations
        are from these states.
        """
        if self.guide is None:
            return None
        t, layers = self.guide.t, unflattened(self.architecture, theta)
        away = evaluate(self.architecture, layers, t)[0] - self.guide.smoothed
        return Covariance(t, self.guide.P + away[:, :, None] * away[:, None, :])

    def method_state(self, method: QuasiNewton) -> dict[str, Any]:
        parts: dict[str, Any] = {"gradient": method.gradient, "direction": method.direction}
        if method.H is not None:
            parts |= {"H_scale": method.H.scale, "H_middle": method.H.middle}
            parts |= {
                "H": method.H.matrix.T,
                "H_vectors": method.H.vectors.T,
            }  # transposed to C order
        return parts

    def load_method(self, state: Mapping[str, Any], best: tuple[np.ndarray, float]) -> QuasiNewton:
        H = None
        if "H" in state:
            vectors, middle = state["H_vectors"].T, state["H_middle"]
            H = Inverse(state["H"].T, state["H_scale"], vectors, middle)
        here = *best, state["gradient"]
        return QuasiNewton(*here, H, state["direction"], first=FIRST_STEP)
