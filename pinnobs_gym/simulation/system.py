"""What a plant is: its equations, its sizes and names, and the setups it is played under."""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Self, TypeAlias

import numpy as np
from array_api_compat import array_namespace

Array: TypeAlias = Any
"""An array of any library of the array API standard: numpy.ndarray, torch.Tensor, ..."""


@dataclass(frozen=True)
class Setup:
    """How episodes of a system are played: where they start, how long, how often and how noisily
    they are measured.

    Vectors are given as sequences (one number per state or output) or as one number for all.
    Initial states are uniform in the box ``x0_low`` to ``x0_high``, redrawn until the system's
    `System.admissible` accepts them; a box of no width means one fixed initial state.
    """

    x0_low: Sequence[float]
    """Lower corner of the box of initial states, in state units."""
    x0_high: Sequence[float]
    """Upper corner of the box of initial states, in state units."""
    xhat0: Sequence[float]
    """Initial estimate x̂₀, the mean of the prior, in state units."""
    P0_std: Sequence[float]
    """Square roots of the diagonal of the prior covariance P₀, in state units."""
    duration: float
    """Length of an episode in s."""
    dt: float
    """Time between samples in s."""
    noise_std: Sequence[float] | float = 0.0
    """Standard deviation of the white Gaussian output noise, in output units."""
    truth_step: float | None = None
    """Where the truth solver starts its search for a step, in s; it halves it as accuracy asks.
    A hundredth of the duration if None."""
    parameters: Mapping[str, float] = field(default_factory=dict)
    """Physical parameters that this setup changes from the system's defaults."""

    def __post_init__(self) -> None:
        for name in ("dt", "duration"):
            value = getattr(self, name)
            if not (isinstance(value, int | float | np.number) and 0 < value < np.inf):
                raise ValueError(f"{name}={value} s; expected a positive number of seconds")
        if self.duration < self.dt * (1 - 1e-9):
            raise ValueError(
                f"duration={self.duration} s is shorter than one sample, dt={self.dt} s"
            )
        noise = np.asarray(self.noise_std, dtype=float)
        if not (np.isfinite(noise).all() and (noise >= 0).all()):
            raise ValueError(f"noise_std={self.noise_std}; expected numbers of at least 0")

        if np.any(np.asarray(self.x0_low) > np.asarray(self.x0_high)):
            raise ValueError(f"x0_low={self.x0_low} is above x0_high={self.x0_high}")
        P0_std = np.asarray(self.P0_std, dtype=float)
        if not (np.isfinite(P0_std).all() and (P0_std >= 0).all()):
            raise ValueError(f"P0_std={self.P0_std}; expected numbers of at least 0")

    @property
    def num_steps(self) -> int:
        """Number of actions in an episode; it has one sample more than that."""
        return int(np.floor(self.duration / self.dt + 1e-6))

    @property
    def times(self) -> np.ndarray:
        """Sample times in s, shape (num_steps + 1,), beginning at 0."""
        return np.arange(self.num_steps + 1) * self.dt

    @property
    def fixed_x0(self) -> bool:
        """Whether every episode starts from the same state."""
        return bool(np.all(np.asarray(self.x0_low) == np.asarray(self.x0_high)))


@dataclass(frozen=True)
class System(ABC):
    """A plant ẋ = f(t, x, u), y = h(t, x, u), written once and used by everything else.

    To add one, subclass it in one file: the dataclass fields are the physical parameters, the class
    attributes below say the names, sizes and setups, and `f` and `h` are the equations. Both act on
    the last axis and take any leading ones, and are written in the array API
    (``xp = array_namespace(x)``), so that the same lines serve simulation in NumPy, filters, and
    automatic differentiation in torch. Neither contains noise.
    """

    measured_input: bool = field(default=False, kw_only=True)
    """True if u is only known at the samples (a log's columns) and joined by straight lines between
    them; False if `input` gives it at any time."""

    state_names: ClassVar[tuple[str, ...]]
    output_names: ClassVar[tuple[str, ...]]
    input_names: ClassVar[tuple[str, ...]] = ()
    units: ClassVar[Mapping[str, str]] = {}
    """Unit of each named state, output, input and parameter; unnamed ones have none."""
    scale: ClassVar[tuple[float, ...]]
    """One number per state, in its unit, that errors are divided by; frozen with the version."""
    state_bound: ClassVar[tuple[float, ...] | None] = None
    """Largest absolute states to expect, for the action space; ten times the scale if None."""
    setups: ClassVar[Mapping[str, Setup]]
    """The setups by name; ``benchmark`` must be among them."""
    version: ClassVar[int] = 0
    """Version of the env id ``pinnobs/<class name>-v<version>``."""
    ranked_condition: ClassVar[str] = "nominal"
    """The condition under which the leaderboard ranks estimators on this system."""
    uncertain: ClassVar[tuple[str, ...] | None] = None
    """Parameters that may be off under the conditions of mismatch; all that are numbers if None."""
    model_step: ClassVar[float | None] = None
    """Longest Runge-Kutta step in s of model-based estimators; the benchmark's dt if None."""

    @property
    def nx(self) -> int:
        """Number of states."""
        return len(self.state_names)

    @property
    def ny(self) -> int:
        """Number of outputs."""
        return len(self.output_names)

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return len(self.input_names)

    @abstractmethod
    def f(self, t: Array, x: Array, u: Array) -> Array:
        """The state's rate of change, (..., nx), at time t (s), state x (..., nx), input u."""

    @abstractmethod
    def h(self, t: Array, x: Array, u: Array) -> Array:
        """The noise-free output, (..., ny), at time t (s), state x (..., nx), input u (..., nu).

        The time is a number or an array (...), and t and u broadcast against the batch of x as in
        `f`. At a sample they are the sample's own time and input.
        """

    def input(self, t: Array) -> Array:
        """The known input u(t), (..., nu), at times t (...) in s. Zero unless overridden."""
        xp = np if isinstance(t, np.ndarray) else array_namespace(t)
        return xp.zeros((*t.shape, self.nu), dtype=t.dtype)

    def f_jacobian(self, t: Array, x: Array, u: Array) -> Array:
        """∂f/∂x, (..., nx, nx); by forward-mode automatic differentiation unless overridden."""
        return _jacobian(lambda x, t, u: self.f(t, x, u), x, t, u)

    def h_jacobian(self, t: Array, x: Array, u: Array) -> Array:
        """∂h/∂x, (..., ny, nx); by forward-mode automatic differentiation unless overridden."""
        return _jacobian(lambda x, t, u: self.h(t, x, u), x, t, u)

    def admissible(self, x0: Array) -> Array:
        """Which initial states (..., nx) of the benchmark's box belong to its set: bool (...)."""
        xp = array_namespace(x0)
        return xp.all(xp.isfinite(x0), axis=-1)

    def invariants(self, x: Array) -> Array | None:
        """Quantities (..., k) that the undisturbed plant conserves, or None. Tests use them."""
        return None

    def observable(self, x: Array) -> Array:
        """Which components can be told from the output near x: bool (..., nx). Errors of the others
        are not scored."""
        xp = array_namespace(x)
        return xp.ones_like(x, dtype=xp.bool)

    def indistinguishable(self, x: Array) -> tuple[Array, ...]:
        """Other states (..., nx) that give the same output for ever as x; none by default."""
        return ()

    def breakpoints(self) -> tuple[float, ...]:
        """Times in s at which f or the input jumps; the truth solver stops and restarts there."""
        return ()

    @property
    def parameters(self) -> dict[str, Any]:
        """The physical parameters by name."""
        return {f.name: getattr(self, f.name) for f in fields(self) if not f.kw_only}

    @classmethod
    def configured(
        cls,
        setup: str = "benchmark",
        *,
        dt: float | None = None,
        duration: float | None = None,
        noise_std: Sequence[float] | float | None = None,
        parameters: Mapping[str, float] | None = None,
    ) -> tuple[Self, Setup]:
        """The system and setup that a name and overrides mean.

        Raises:
            ValueError: naming the value, if the setup or a parameter is unknown, or a value is out
                of range.
        """
        if setup not in cls.setups:
            raise ValueError(
                f"unknown setup {setup!r} of {cls.__name__}; it has {', '.join(cls.setups)}"
            )
        changes = {"dt": dt, "duration": duration, "noise_std": noise_std}
        chosen = replace(cls.setups[setup], **{k: v for k, v in changes.items() if v is not None})
        system = cls()
        wanted = {**chosen.parameters, **(parameters or {})}
        for name in wanted:
            if name not in system.parameters:
                known = ", ".join(system.parameters) or "none"
                raise ValueError(f"unknown parameter {name!r} of {cls.__name__}; it has {known}")
        system = replace(system, **wanted)
        vector(chosen.noise_std, system.ny, f"noise_std of {cls.__name__}")
        return system, chosen

    @classmethod
    def validate(cls) -> None:
        """Check the class attributes of a new system.

        Raises:
            TypeError: in one line, naming the class and what is missing or of the wrong size.
        """
        for name in ("state_names", "output_names", "scale", "setups"):
            if getattr(cls, name, None) is None:
                raise TypeError(f"system {cls.__name__} has no class attribute {name!r}")
        for name in ("f", "h"):
            taken = list(inspect.signature(getattr(cls, name)).parameters)
            if len(taken) != 4:
                raise TypeError(
                    f"system {cls.__name__}: {name}({', '.join(taken)}); "
                    f"expected {name}(self, t, x, u)"
                )
        if "benchmark" not in cls.setups:
            raise TypeError(f"system {cls.__name__} has no setup named 'benchmark'")
        try:
            for name in cls.setups:
                system, setup = cls.configured(name)
                vector(cls.scale, system.nx, "scale")
                for part in ("x0_low", "x0_high", "xhat0", "P0_std"):
                    vector(getattr(setup, part), system.nx, f"{part} of setup {name!r}")
        except ValueError as error:
            raise TypeError(f"system {cls.__name__}: {error}") from None
        unknown = [name for name in cls.uncertain or () if name not in cls().parameters]
        if unknown:
            raise TypeError(f"system {cls.__name__}: uncertain names no parameter {unknown[0]!r}")


def vector(value: Sequence[float] | float, size: int, name: str) -> np.ndarray:
    """The value as a float array (size,); one number stands for all components.

    Raises:
        ValueError: naming the value and the size expected.
    """
    array = np.asarray(value, dtype=float)
    if array.ndim == 0:
        array = np.full(size, float(array))
    if array.shape != (size,):
        raise ValueError(f"{name} has shape {array.shape}; expected {size} number(s)")
    return array


def stack(like: Array, *components: Array | float) -> Array:
    """The array (..., n) of n components, each a number or an array that broadcasts to the batch
    (...) of ``like`` (..., nx). In NumPy its axes lie in memory in the order of those of ``like``,
    so that arithmetic on the two is contiguous."""
    if isinstance(like, np.ndarray):  # several times faster than np.stack on small batches
        out = np.empty_like(like, shape=(*like.shape[:-1], len(components)))
        for i, component in enumerate(components):
            out[..., i] = component
        return out
    xp = array_namespace(like)
    batch = tuple(like.shape[:-1])
    columns = [
        xp.full(batch, component, dtype=like.dtype, device=like.device)
        if isinstance(component, int | float)
        else xp.broadcast_to(component, batch)
        for component in components
    ]
    return xp.stack(columns, axis=-1)


def matrix(like: Array, rows: Sequence[Sequence[Array | float]]) -> Array:
    """The (..., n, m) matrix of the given entries, each a number or an array (...) like the batch
    of ``like`` (..., nx).

    The last axis of the batch lies innermost in memory, so that arithmetic on one entry over it is
    contiguous.
    """
    *outer, inner = like.shape[:-1] if like.ndim > 1 else (1,)
    shape = (*outer, len(rows), len(rows[0]), inner)
    if isinstance(like, np.ndarray):
        out = np.zeros(shape, dtype=like.dtype)
    else:
        out = array_namespace(like).zeros(shape, dtype=like.dtype, device=like.device)
    for i, row in enumerate(rows):
        for j, entry in enumerate(row):
            if not (isinstance(entry, int | float) and entry == 0):
                out[..., i, j, :] = entry
    if like.ndim == 1:
        return out[..., 0]
    k = len(outer)
    axes = (*range(k), k + 2, k, k + 1)
    return (
        out.transpose(axes)
        if isinstance(out, np.ndarray)
        else array_namespace(out).permute_dims(out, axes)
    )


def _jacobian(function: Callable[..., Array], x: Array, *others: Array) -> Array:
    """∂function/∂x, (..., m, nx), by forward-mode differentiation in torch, in x's own library."""
    import torch

    given = torch.as_tensor(x)
    tensors = [
        other
        if isinstance(other, torch.Tensor)
        else torch.tensor(other, dtype=given.dtype, device=given.device)
        for other in others
    ]
    nx = given.shape[-1]
    directions = torch.eye(nx, dtype=given.dtype, device=given.device)
    directions = directions.reshape(nx, *([1] * (given.ndim - 1)), nx)
    repeated = given.expand(nx, *given.shape).clone()
    tangents = directions.expand(repeated.shape).clone()
    columns = torch.func.jvp(lambda x: function(x, *tensors), (repeated,), (tangents,))[1]
    jacobian = torch.movedim(columns, 0, -1)
    return jacobian if isinstance(x, torch.Tensor) else jacobian.numpy()


NOISE_FLOOR = 1e-3
"""Least standard deviation of output noise in R, over the output's scale."""


_TIMES = 9
"""Times of an episode, evenly spread from the first sample on, at which `output_scale` looks."""


def output_scale(system: System) -> np.ndarray:
    """The scale of each output, (ny,), in its unit: that of the state with the largest influence on
    it at the benchmark's x̂₀, at some times of its episode and the inputs then, or one if none has
    any there."""
    setup, scale = system.setups["benchmark"], vector(system.scale, system.nx, "scale")
    t = np.linspace(0.0, setup.duration, _TIMES)
    x = np.tile(vector(setup.xhat0, system.nx, "xhat0"), (_TIMES, 1))
    H = system.h_jacobian(t, x, np.asarray(system.input(t)))
    size = abs(H * scale).max(axis=(0, -1))
    return np.where(size > 0, size, 1.0)
