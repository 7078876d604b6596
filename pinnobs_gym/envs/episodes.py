"""The source of episodes: their random draws and their simulation."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence, Sized
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypedDict, Unpack

import numpy as np

from pinnobs_gym.simulation.bounds import beyond
from pinnobs_gym.simulation.conditions import parse_condition
from pinnobs_gym.simulation.conditions.base import Condition, Outputs, noise_scale
from pinnobs_gym.simulation.kernels.asked import ask
from pinnobs_gym.simulation.noise import Level
from pinnobs_gym.simulation.notices import say_once
from pinnobs_gym.simulation.probe import probe
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.runge_kutta import longest_step
from pinnobs_gym.simulation.system import System, vector
from pinnobs_gym.simulation.truth import disturbed_truth, noise_shape, truth
from pinnobs_gym.simulation.value_shape import of_shape
from pinnobs_gym.simulation.values import check_seed, real_array, shortly
from pinnobs_gym.systems import SYSTEMS

_DRAWS = 64
"""Number of initial states drawn at a time."""
_ATTEMPTS = 1000
"""Number of such draws without an admissible state after which the initial set counts as empty."""


FARTHEST = 1e5
"""Largest size of a state that is given, over its scale and its usual initial size."""
MOST_NUMBERS = 10**9
"""Largest number of states, outputs and inputs of the episodes that are computed at a time, which
take 8 GB."""


class Changes(TypedDict, total=False):
    """Values that replace those of a setup; None keeps the setup's value."""

    dt: float | None
    """Time between samples in s."""
    duration: float | None
    """Length of an episode in s."""
    noise_std: Level | None
    """Standard deviation of the output noise, in output units."""
    parameters: Mapping[str, float] | None
    """Physical parameters."""


@dataclass(frozen=True)
class Draws:
    """All random numbers of a batch of episodes."""

    x0: np.ndarray
    """Initial states, shape (batch, nx)."""
    noise: np.ndarray
    """Output noise of unit variance, shape (batch, num_steps + 1, ny)."""
    u: np.ndarray
    """Inputs, shape (batch, num_steps + 1, nu)."""
    seeds: tuple[int, ...]
    """A seed per episode for the draws of its condition and of the process noise; empty if neither
    draws anything."""


@dataclass(frozen=True)
class Episodes:
    """Simulated episodes of a system with common sample times, (time, batch, dim)."""

    x: np.ndarray
    """True states, shape (num_steps + 1, batch, nx)."""
    y: np.ndarray
    """Measured outputs, shape (num_steps + 1, batch, ny)."""
    u: np.ndarray
    """Inputs, shape (num_steps + 1, batch, nu)."""
    observations: np.ndarray
    """y, u and t/T in single precision, shape (num_steps + 1, batch, ny + nu + 1); NaN marks a
    missing output."""


class EpisodeSource:
    """Generates the episodes of an env: every seed defines an endless sequence of them.

    The random numbers of an episode (`Draws`) depend on the seed, the system's name and the number
    of earlier episodes of that seed. Everything else depends on these draws alone. The same seed
    thus gives the same episodes in any batch.

    Args:
        system: name, ``module:Class`` or class of the system.
        setup: the setup's name.
        condition: change of the episodes relative to the setup, or its name; see
            `pinnobs_gym.simulation.conditions`.
        changes: values that replace the setup's.
    """

    def __init__(
        self,
        system: str | type[System],
        setup: str = "benchmark",
        condition: str | Condition = "nominal",
        **changes: Unpack[Changes],
    ) -> None:
        for name in changes:
            if name not in Changes.__annotations__:
                known = ", ".join(["setup", "condition", *Changes.__annotations__])
                raise ValueError(f"unknown argument {name!r}; known are {known}")
        cls = SYSTEMS.resolve(system)
        probe(cls)
        self.system, chosen = cls.configured(setup, **changes)
        if self.system.draws_input:
            self.system = replace(self.system, measured_input=True)
        given = isinstance(condition, Condition)
        self.condition: Condition = condition if given else parse_condition(condition)
        self.condition.plant(self.system, ())  # raises if the condition does not apply
        self.setup = self.condition.setup(self.system, chosen)
        self.fixed_x0 = self.setup.fixed_x0
        own = self.system.noise(self.setup.noise_std, self.setup.process_noise)
        self.noise = own.and_process(self.condition.process_noise(self.system, self.setup))
        self.trivial = type(self.condition) is Condition
        self.deterministic = self.fixed_x0 and self.trivial and not np.any(self.setup.noise_std)
        self.deterministic &= not (self.noise.stochastic or self.system.draws_input)
        self.times = self.setup.times
        self.inputs = np.asarray(self.system.input(self.times))
        self.start = self.setup.start(self.system.nx)
        self._corners = np.stack(self.start.corners)
        ask(self.system, "truth")
        step = longest_step(self.system)
        self._drawn = noise_shape(self.system, self.noise, self.setup.dt, step)

    def check_batch(self, batch: int) -> None:
        """Check that the arrays of a batch of episodes are not absurdly large.

        Raises:
            ValueError: in one line, if they are.
        """
        system = self.system
        numbers = batch * len(self.times) * (system.nx + system.ny + system.nu)
        if numbers > MOST_NUMBERS:
            raise ValueError(
                f"{batch} episodes of {len(self.times)} samples at a time are {numbers:.3g} "
                f"numbers; expected at most {MOST_NUMBERS:.3g}"
            )

    def given_states(self, x0: object, batch: int) -> np.ndarray:
        """Return initial states that are given, as an array (nx,) or (batch, nx).

        Raises:
            ValueError: in one line, if their shape is wrong, or they are not finite or absurdly
                large.
        """
        states, nx = real_array("x0", x0), self.system.nx
        if states.shape not in ((nx,), (batch, nx)):
            raise ValueError(f"x0 has shape {states.shape}; expected ({nx},)")
        if not np.isfinite(states).all():
            raise ValueError(f"x0={states.tolist()} is not finite")
        self.check_near("x0", states)
        return states

    def check_near(self, name: str, x: np.ndarray) -> None:
        """Check that states (..., nx) are not farther away than any from which an episode can be
        computed.

        Raises:
            ValueError: in one line that names the state and the largest value of it.
        """
        system = self.system
        usual = np.maximum(vector(system.scale, system.nx, "scale"), abs(self._corners))
        largest = FARTHEST * usual.max(axis=0)
        wrong = abs(x) > largest
        if wrong.any():
            i = int(np.argwhere(wrong)[0][-1])
            raise ValueError(
                f"{name}={shortly(x.tolist())}; expected {system.state_names[i]} of at most "
                f"{largest[i]:g}, {FARTHEST:g} times its usual size"
            )

    def contains(self, x0: np.ndarray) -> np.ndarray:
        """Return which initial states (..., nx) belong to the setup's set: bool (...)."""
        inside = self.start.contains(x0)
        return inside if self.fixed_x0 else inside & self.system.admissible(x0)

    def stream(self, seeds: np.random.SeedSequence) -> Stream:
        """Return the random number stream of a seed for this system."""
        return Stream(seeds, type(self.system).__name__)

    def streams(self, seeds: Iterable[int | None]) -> list[Stream]:
        """Return the random number streams of these seeds; None is a seed that is drawn."""
        if isinstance(seeds, Sized):
            self.check_batch(len(seeds))
        return [
            self.stream(np.random.SeedSequence(None if seed is None else check_seed(seed)))
            for seed in seeds
        ]

    def draw(self, streams: Sequence[Stream], noise: np.ndarray | None = None) -> Draws:
        """Draw the random numbers of the next episode of each stream; a stream may occur several
        times. The array ``noise``, if given, must have the right size and is overwritten."""
        x0 = np.empty((len(streams), self.system.nx))
        u = np.broadcast_to(self.inputs, (len(streams), *self.inputs.shape))
        if self.system.draws_input:
            u = np.stack([self._drawn_input(stream.inputs) for stream in streams])
        if noise is None:
            noise = np.empty((len(streams), len(self.times), self.system.ny))
        for i, stream in enumerate(streams):
            x0[i] = stream.next_x0(self)
            stream.noise.standard_normal(out=noise[i])
        drawing = not self.trivial or self.noise.stochastic
        seeds = tuple(int(s.conditions.integers(2**63)) for s in streams) if drawing else ()
        return Draws(x0, noise, u, seeds)

    def _drawn_input(self, rng: np.random.Generator) -> np.ndarray:
        """Draw the inputs (num_steps + 1, nu) of an episode.

        Raises:
            ValueError: in one line, if the system draws something else.
        """
        name, shape = type(self.system).__name__, (len(self.times), self.system.nu)
        u = np.asarray(self.system.draw_input(rng, self.times))
        if u.shape != shape or u.dtype.kind not in "biuf" or not np.isfinite(u).all():
            raise ValueError(
                f"{name}.draw_input returned an array of {u.dtype}, shape {u.shape}; expected "
                f"finite numbers, shape {shape}"
            )
        return u

    def play(
        self, draws: Draws, x0: np.ndarray | None = None, into: Episodes | None = None
    ) -> Episodes:
        """Simulate the episodes of these draws.

        Args:
            draws: the random numbers.
            x0: initial states (batch, nx) that replace the drawn ones.
            into: finished episodes of the same size, whose arrays are overwritten.
        """
        start = draws.x0 if x0 is None else x0
        episodes = self._empty(len(start)) if into is None else into
        x, y, observations = episodes.x, episodes.y, episodes.observations
        u = episodes.u
        _copy(draws.u.swapaxes(0, 1), u)
        inputs = u if self.system.draws_input else None
        rngs = [np.random.default_rng(seed) for seed in draws.seeds]
        plant = self.condition.plant(self.system, rngs)
        if self.noise.stochastic:
            shape = (len(self.times) - 1, *self._drawn)
            drawn = np.stack([rng.standard_normal(shape) for rng in rngs], axis=3)
            step = self.setup.truth_step
            disturbed_truth(plant, self.noise, start, self.times, drawn, step, x, inputs)
        elif (
            plant is self.system and inputs is None and len(start) > 1 and (start == start[0]).all()
        ):
            x[:] = truth(plant, start[:1], self.times, self.setup.truth_step)
        else:
            truth(plant, start, self.times, self.setup.truth_step, x, inputs)
        if (found := beyond(self.system, x)) is not None:
            name, state = type(self.system).__name__, found.split(" comes to ")[0]
            say_once(
                f"{name}: {state} of the true states leaves its bounds (state_low, state_high), "
                "within which estimates are kept; scores are worse for it"
            )
        y[:] = self.noise.outputs(self.times, draws.noise.swapaxes(0, 1))
        y += of_shape(plant, "h", plant.h(self.times[:, None], x, u), y.shape)
        if not self.trivial:
            sent = Outputs(self.times, y, noise_scale(self.system, self.setup))
            y[:] = self.condition.outputs(sent, rngs)
        ny = self.system.ny
        _copy(y, observations[..., :ny])
        _copy(u, observations[..., ny:-1])
        observations[..., -1] = (self.times / self.times[-1])[:, None]
        return episodes

    def _empty(self, batch: int) -> Episodes:
        shape, system = (len(self.times), batch), self.system
        return Episodes(
            np.empty((*shape, system.nx)),
            np.empty((*shape, system.ny)),
            np.empty((*shape, system.nu)),
            np.empty((*shape, system.ny + system.nu + 1), np.float32),
        )

    def record(self, episodes: Episodes, xhat0: object = None) -> Record:
        """Return the record of the episodes, which estimators are given: the samples up to that of
        the last action.

        Args:
            episodes: the episodes.
            xhat0: initial estimates (nx,) or (batch, nx) in place of the prior's mean, if given.
        """
        batch, last = episodes.y.shape[1], self.setup.num_steps
        u = episodes.u[:last].swapaxes(0, 1).copy()
        prior = Prior.of(self.system, self.setup, batch, xhat0)
        return Record(self.times[:last], episodes.y[:last].swapaxes(0, 1).copy(), u, prior)


def _copy(values: np.ndarray, to: np.ndarray) -> None:
    """Copy an array (..., n) component by component, whose loops are longer than those over n."""
    for j in range(values.shape[-1]):
        to[..., j] = values[..., j]


class Stream:
    """The random number generators of one seed and system, and its queue of initial states.

    The seed is salted with the system's name. The same seed thus gives independent episodes of
    different systems.

    Args:
        seeds: the seed.
        system: name of the system.
    """

    def __init__(self, seeds: np.random.SeedSequence, system: str) -> None:
        salt = np.frombuffer(hashlib.sha256(system.encode()).digest()[:16], "<u4").tolist()
        self._entropy, self._key = seeds.entropy, (*seeds.spawn_key, *salt)
        self._states, self.noise = self._generator(0), self._generator(1)
        self._queue: list[np.ndarray] = []

    # Most setups draw neither of these, and to make a generator takes time.
    @cached_property
    def conditions(self) -> np.random.Generator:
        """The generator of the seeds of conditions and process noise."""
        return self._generator(2)

    @cached_property
    def inputs(self) -> np.random.Generator:
        """The generator of inputs."""
        return self._generator(3)

    def _generator(self, number: int) -> np.random.Generator:
        """Return the generator of the child with this number."""
        key = (*self._key, number)
        return np.random.default_rng(np.random.SeedSequence(self._entropy, spawn_key=key))

    def next_x0(self, source: EpisodeSource) -> np.ndarray:
        """Return the next initial state (nx,) from the setup's set, as changed by the condition.

        Raises:
            ValueError: in one line, if no drawn state is admissible.
        """
        for _ in range(1 if source.fixed_x0 else _ATTEMPTS):
            if self._queue:
                return self._queue.pop(0)
            if source.fixed_x0:
                drawn = source.start.mean[None]
            else:
                drawn = source.start.draw(self._states, _DRAWS)
                drawn = drawn[source.system.admissible(drawn)]
            self._queue = list(source.condition.starts(drawn, source.contains))
        if self._queue:
            return self._queue.pop(0)
        name = type(source.system).__name__
        raise ValueError(f"{name}: none of {_ATTEMPTS * _DRAWS} states drawn is admissible")
