"""Plants, records and loops for trainings that are over in a moment."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from array_api_compat import array_namespace
from plain_network import Network

from pinnobs_gym.estimation.learned.mlp import Architecture
from pinnobs_gym.estimation.learned.trained_file import identity
from pinnobs_gym.estimators.pinn_obs import TrainedNetwork
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Setup, System, independent, matrix, stack
from pinnobs_gym.simulation.truth import truth
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.training.log import Log
from pinnobs_gym.training.loop import train
from trainers.pinn_obs import PinnObsTrainer


def box(nx):
    corner = (0.0,) * nx
    return Setup(corner, corner, duration=1, dt=0.05, xhat0=corner, P0=independent(*corner))


@dataclass(frozen=True)
class Spring(System):
    """ẋ = Ax + Bu, linear, with a measured force."""

    stiffness: float = 4.0

    state_names = ("q", "v")
    output_names = ("q",)
    input_names = ("force",)
    input_hold = "linear"
    scale = (1.0, 1.0)
    setups: ClassVar = {"benchmark": box(2)}
    model_step = 0.01

    def f(self, t, x, u):
        return stack(x, x[..., 1], -self.stiffness * x[..., 0] - 0.3 * x[..., 1] + u[..., 0])

    def h(self, t, x, u):
        return x[..., :1]

    def h_jacobian(self, t, x, u):
        return matrix(x, [[1.0, 0.0]])


@dataclass(frozen=True)
class Mixer(System):
    """Three states, two nonlinear outputs, two inputs, time in f and h: nothing the paper has."""

    state_names = ("a", "b", "c")
    output_names = ("y1", "y2")
    input_names = ("u1", "u2")
    input_hold = "linear"
    scale = (1.0, 1.0, 1.0)
    setups: ClassVar = {"benchmark": box(3)}

    def f(self, t, x, u):
        xp = array_namespace(x)
        a, b, c = x[..., 0], x[..., 1], x[..., 2]
        return stack(x, b * c + u[..., 0], xp.sin(a) * t - b, u[..., 1] * a - c)

    def h(self, t, x, u):
        a, b, c = x[..., 0], x[..., 1], x[..., 2]
        return stack(x, a * b + t * u[..., 1], c**2 + t * b + u[..., 0] * a)

    def input(self, t):
        xp = array_namespace(t)
        return xp.stack([xp.cos(t), t * t], axis=-1)


def played(system, setup, noise_std=0.0):
    """A record of one episode, with the setup's fixed initial state."""
    t = setup.times
    x = truth(system, np.array([setup.x0_low], dtype=float), t)[:, 0]
    u = np.asarray(system.input(t))
    noise = noise_std * np.random.default_rng(5).standard_normal((len(t), system.ny))
    y = system.h(t, x, u) + noise
    return Record(t, y[None], u[None], Prior.of(system, setup, 1))


def duffing(**changes):
    system, setup = SYSTEMS.resolve("ReverseDuffing").configured("paper", **{"dt": 0.1, **changes})
    return system, played(system, setup)


def random_record(system, num_samples=40, batch=1, seed=3):
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.01, 0.09, num_samples)) + 0.5
    y = rng.standard_normal((batch, num_samples, system.ny))
    u = rng.standard_normal((batch, num_samples, system.nu))
    if not system.measured_input:
        u = np.broadcast_to(np.asarray(system.input(t)), u.shape)
    mean = rng.standard_normal((batch, system.nx))
    return Record(
        t, y, u, Prior(mean, np.broadcast_to(np.eye(system.nx), (batch,) + (system.nx,) * 2))
    )


def constant_gain(system, L, record=None):
    """A trained network whose gain is L at every time."""
    network = Network(Architecture(system.nx, system.ny, 1, 3, dtype="float64"))
    with torch.no_grad():
        network.weights[-1].zero_()
        network.biases[-1][system.nx :] = torch.tensor(L, dtype=torch.float64).flatten()
    return trained_network(system, network, record)


def trained_network(system, network, record=None):
    """A network as if it were trained."""
    record = record or random_record(system)
    about = identity(system)
    return TrainedNetwork(
        architecture=network.architecture,
        layers=tuple((W.detach().numpy(), b.detach().numpy()) for W, b in network.layers),
        t=record.t,
        y=record.y[0],
        trainer="pinn_obs",
        system=about["system"],
        parameters=about["parameters"],
        noise_std=(0.0,) * system.ny,
        ending="finished",
        condition="nominal",
        config={},
        seed=0,
        loss=0.25,
        iterations=1,
        seconds=0.0,
        recipe="paper's loss",
        knows=(),
    )


def network_of(trained):
    """A trained network in torch."""
    network = Network(trained.architecture)
    with torch.no_grad():
        for (W, b), (weight, bias) in zip(network.layers, trained.layers, strict=True):
            W.copy_(torch.from_numpy(weight))
            b.copy_(torch.from_numpy(bias))
    return network


def train_pinn_obs(system, config, *, record, noise_std=0.0, process_noise=None, **options):
    """What `train` makes of a training of PINN-Obs; by default of outputs without noise."""
    told = {"noise_std": noise_std, "process_noise": process_noise}
    return train(PinnObsTrainer(system, config, record=record, **told), **options)


def same_weights(one, other):
    pairs = zip(one.layers, other.layers, strict=True)
    layers = (zip(*pair, strict=True) for pair in pairs)
    return all(np.array_equal(a, b) for layer in layers for a, b in layer)


def gradient_of(network):
    """What `backward` left, in the order of `flattened`."""
    pairs = zip(network.weights, network.biases, strict=True)
    zero = [(W.grad, torch.zeros_like(b) if b.grad is None else b.grad) for W, b in pairs]
    return torch.cat([torch.cat([W, b[:, None]], dim=1).flatten() for W, b in zero]).numpy()


class Interrupting(Log):
    """Ctrl-C, once a curve reaches a step; keeps what is logged."""

    def __init__(self, step):
        super().__init__(None)
        self.at, self.losses = step, []

    active = True

    def figure(self, tag, figure, step):
        """Nothing is drawn."""

    def hparams(self, params, metrics):
        """Nothing is kept."""

    def scalar(self, tag, value, step):
        if tag == "loss/total":
            self.losses.append(value)
        if step >= self.at:
            raise KeyboardInterrupt


@dataclass(frozen=True)
class Failing(Spring):
    """A plant that is not a number for its first ``bad`` calls."""

    bad: int = 0
    calls: ClassVar[list[int]] = []

    def f(self, t, x, u):
        self.calls.append(1)
        return super().f(t, x, u) * (math.nan if len(self.calls) <= self.bad else 1.0)

    def f_jacobian(self, t, x, u):
        return matrix(x, [[0.0, 1.0], [-4.0, -0.3]])
