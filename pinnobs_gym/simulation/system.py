"""The plant: its equations, dimensions, names and setups."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, fields, replace
from typing import Any, ClassVar, Literal, Self, TypeAlias

import numpy as np

from pinnobs_gym.registry import did_you_mean
from pinnobs_gym.simulation.arrays import array_namespace
from pinnobs_gym.simulation.bounds import Bounds, StateBox, box
from pinnobs_gym.simulation.noise import Level, Noise, SampledLevel, noise_root
from pinnobs_gym.simulation.residual import Periods, residual
from pinnobs_gym.simulation.shown import call_of, html, summary_of
from pinnobs_gym.simulation.start_law import Box, Gaussian, StartLaw, check_covariance
from pinnobs_gym.simulation.values import (
    LARGEST,
    check_mapping,
    check_parameters,
    finite_array,
    is_finite,
    is_number,
    real_array,
    shortly,
)

Array: TypeAlias = Any
"""An array of any library of the array API standard, such as numpy.ndarray or torch.Tensor."""
_FROM_DT: Any = None
"""A duration that follows from the time between samples."""
_USUAL_STEPS = 100
"""Its number of steps."""
MOST_SAMPLES = 10**7
"""Largest number of samples of an episode."""


@dataclass(frozen=True)
class PoorPrior:
    """A prior that is not that of the initial states; see `Setup.poor_prior`."""

    xhat0: Sequence[float]
    """Initial estimate x̂₀, the mean, in state units."""
    P0: Sequence[Sequence[float]]
    """Covariance P₀, nx rows of nx numbers, in products of state units."""

    def __post_init__(self) -> None:
        finite_array("xhat0 of the poor prior", self.xhat0)
        check_covariance(self.P0, "P0")


@dataclass(frozen=True)
class Setup:
    """The settings of a system's episodes: initial states, prior, duration, sample time and output
    noise.

    Vectors are sequences (one number per state or output) or one number for all components. Initial
    states are uniform in the box ``x0_low`` to ``x0_high``, or follow the law ``x0_law``; they are
    redrawn until `System.admissible` accepts them. A box of zero width means one fixed initial
    state.

    The prior that estimators are given is N(x̂₀, P₀). By default x̂₀ and P₀ are the mean and the
    covariance of the law of the initial states
    (`pinnobs_gym.simulation.initial_set.prior_moments`). A fixed initial state has no such law; its
    setup must give both. If a setup gives both and no law, the initial states follow the prior,
    within the bounds of the states.
    """

    x0_low: Sequence[float] | None = None
    """Lower corner of the box of initial states, in state units; None with ``x0_law``."""
    x0_high: Sequence[float] | None = None
    """Upper corner of the box of initial states, in state units; None with ``x0_law``."""
    _: KW_ONLY
    x0_law: StartLaw | None = None
    """The law of initial states in place of a box, such as
    `pinnobs_gym.simulation.start_law.Gaussian` or `Points`; see `start`."""
    duration: float = _FROM_DT
    """Length of an episode in s; a hundred times ``dt`` if not given."""
    dt: float
    """Time between samples in s."""
    noise_std: Level = 0.0
    """Standard deviation of the white Gaussian output noise, in output units: one number for all
    outputs, one for each, or the rows of a square matrix G of the noise Gv with v standard normal
    (a root of the covariance GGᵀ)."""
    process_noise: Level = 0.0
    """Standard deviation of the process noise after one second, in state units per √s: one number
    for all states, one for each, or the rows of a matrix L of dx = f dt + L dw, where w is a Wiener
    process. The unit of time of a map is its step."""
    xhat0: Sequence[float] | None = None
    """Initial estimate x̂₀, the mean of the prior, in state units. The mean of the law of the
    initial states if None."""
    P0: Sequence[Sequence[float]] | None = None
    """Covariance P₀ of the prior, nx rows of nx numbers, in products of state units. That of the
    law of the initial states if None; see also `independent`."""
    poor_prior: PoorPrior | None = None
    """The prior that replaces the above under the condition ``poor_prior``; without one the
    condition does not apply."""
    transient: float | None = None
    """End of the transient window of the scores, in s from the first sample
    (`pinnobs_gym.scoring.metrics.windows`); a quarter of the duration if None."""
    truth_step: float | None = None
    """Initial step of the truth solver in s, halved until the error tolerance is met. A hundredth
    of the duration if None."""
    parameters: Mapping[str, float] = field(default_factory=dict)
    """Physical parameters that replace the system's defaults."""

    def __post_init__(self) -> None:
        if self.duration is _FROM_DT and is_number(self.dt):
            object.__setattr__(self, "duration", _USUAL_STEPS * self.dt)
        for name in ("dt", "duration", "transient", "truth_step"):
            value = getattr(self, name)
            if name in ("transient", "truth_step") and value is None:
                continue
            if not (is_finite(value) and value > 0):
                raise ValueError(
                    f"{name}={shortly(value)} s; expected a positive number of seconds"
                )
        if float(self.duration) / float(self.dt) > MOST_SAMPLES:
            raise ValueError(
                f"duration={self.duration:g} s has {self.duration / self.dt:.3g} samples of "
                f"dt={self.dt:g} s; expected at most {MOST_SAMPLES}"
            )
        if self.duration < self.dt * (1 - 1e-9):
            raise ValueError(
                f"duration={self.duration} s is shorter than one sample, dt={self.dt} s"
            )
        if self.transient is not None and self.transient > self.duration:
            raise ValueError(
                f"transient={self.transient} s is longer than the episode, "
                f"duration={self.duration} s"
            )
        for name in ("noise_std", "process_noise"):
            noise_root(getattr(self, name), None, name)
        for name, kind in (("x0_law", StartLaw), ("poor_prior", PoorPrior)):
            value = getattr(self, name)
            if value is not None and not isinstance(value, kind):
                raise ValueError(f"{name}={shortly(value)}; expected None or a {kind.__name__}")
        check_mapping(self.parameters)
        for name in ("x0_low", "x0_high", "xhat0"):
            if getattr(self, name) is not None:
                finite_array(name, getattr(self, name))
        corners = [name for name in ("x0_low", "x0_high") if getattr(self, name) is not None]
        if not corners and self.x0_law is None and self.xhat0 is not None and self.P0 is not None:
            check_covariance(self.P0, "P0")
            mean = vector(self.xhat0, len(self.P0), "xhat0")
            object.__setattr__(self, "x0_law", Gaussian(tuple(mean.tolist()), self.P0))
        elif len(corners) != (0 if self.x0_law else 2):
            given = ", ".join([*corners, *(["x0_law"] if self.x0_law else [])]) or "neither"
            raise ValueError(
                f"x0_low and x0_high, or x0_law, or xhat0 and P0 are expected; given: {given}"
            )
        if not self.x0_law and np.any(np.asarray(self.x0_low) > np.asarray(self.x0_high)):
            raise ValueError(f"x0_low={self.x0_low} is above x0_high={self.x0_high}")
        if self.P0 is not None:
            check_covariance(self.P0, "P0")
        if self.fixed_x0 and (self.xhat0 is None or self.P0 is None):
            missing = "xhat0" if self.xhat0 is None else "P0"
            state = f"x0_low=x0_high={self.x0_low}" if self.x0_law is None else f"{self.x0_law}"
            raise ValueError(
                f"the initial state is fixed, {state}, and defines no prior; give {missing}"
            )

    def start(self, nx: int) -> StartLaw:
        """Return the law of the initial states of a system with that number of states.

        Raises:
            ValueError: in one line, if the law has another number of states.
        """
        if self.x0_law is None:
            corners = (self.x0_low, "x0_low"), (self.x0_high, "x0_high")
            low, high = (
                vector(() if corner is None else corner, nx, name).tolist()
                for corner, name in corners
            )
            return Box(tuple(low), tuple(high))
        if len(self.x0_law.mean) != nx:
            raise ValueError(
                f"x0_law has states of {len(self.x0_law.mean)} number(s); expected {nx}"
            )
        return self.x0_law

    @property
    def num_steps(self) -> int:
        """Number of actions in an episode; an episode has one sample more."""
        return int(np.floor(self.duration / self.dt + 1e-6))

    @property
    def times(self) -> np.ndarray:
        """Sample times in s, shape (num_steps + 1,), starting at 0."""
        return np.arange(self.num_steps + 1) * float(self.dt)

    @property
    def transient_end(self) -> float:
        """End of the transient window in s from the first sample."""
        return self.duration / 4 if self.transient is None else self.transient

    @property
    def fixed_x0(self) -> bool:
        """Whether every episode starts from the same state."""
        if self.x0_law is not None:
            return self.x0_law.fixed
        return bool(np.all(np.asarray(self.x0_low) == np.asarray(self.x0_high)))


@dataclass(frozen=True)
class System(ABC):
    """A plant ẋ = f(t, x, u), y = h(t, x, u), the single source of its equations.

    With `discrete`, it is a map x⁺ = f(k, x, u) instead, whose time is counted in steps.

    To add a system, subclass it in one file. The dataclass fields are the physical parameters, the
    class attributes below define names, dimensions and setups, and `f` and `h` are the equations.
    Both act on the last axis and accept any leading axes. They are written in the array API (``xp =
    array_namespace(x)``), so that the same code serves simulation in NumPy, filters, and automatic
    differentiation in torch. Neither contains noise.
    """

    measured_input: bool = field(default=False, kw_only=True)
    """True if u is known only at the samples (a log's columns), and between them as `input_hold`
    says; False if `input` defines it at any time."""

    state_names: ClassVar[tuple[str, ...]]
    output_names: ClassVar[tuple[str, ...]]
    input_names: ClassVar[tuple[str, ...]] = ()
    units: ClassVar[Mapping[str, str]] = {}
    """Unit of each state, output, input and parameter by name; names not listed have none."""
    scale: ClassVar[tuple[float, ...]]
    """Scale of each state, in its unit, by which errors are divided; frozen with the version."""
    state_bound: ClassVar[tuple[float, ...] | None] = None
    """Largest expected absolute value of each state, for the action space; ten times the scale if
    None."""
    output_period: ClassVar[Periods | None] = None
    """Period of each output that repeats, such as ``(None, 2 * pi)`` for a range and a bearing, in
    its unit; None if none repeats. The truth and `h` need not be wrapped."""
    state_period: ClassVar[Periods | None] = None
    """Period of each state that repeats, in its unit; None if none repeats. States that differ by
    whole periods are the same state, for `f`, `h` and the scores."""
    state_low: ClassVar[Bounds | None] = None
    """Value below which each state cannot be, such as ``(0.0, None)``, in its unit; None for no
    bound. Neither estimates nor a truth with process noise are below."""
    state_high: ClassVar[Bounds | None] = None
    """Value above which each state cannot be, in its unit; None for no bound. Neither
    estimates nor a truth with process noise are above."""
    setups: ClassVar[Mapping[str, Setup]]
    """The setups by name; must contain ``benchmark``."""
    version: ClassVar[int] = 0
    """Version of the env id ``pinnobs/<class name>-v<version>``."""
    reward_threshold: ClassVar[float | None] = None
    """Return at which Gymnasium counts the env as solved: in this package the mean return of the
    unscented Kalman filter in the benchmark's episodes of seeds 0 to 99."""
    ranked_condition: ClassVar[str] = "nominal"
    """The condition under which the leaderboard ranks estimators of this system."""
    uncertain: ClassVar[tuple[str, ...] | None] = None
    """Parameters that the mismatch conditions change; all numeric ones if None."""
    model_step: ClassVar[float | None] = None
    """Longest Runge-Kutta step of model-based estimators in s; if None, one that keeps the local
    error small is found (`pinnobs_gym.simulation.runge_kutta.longest_step`)."""
    discrete: ClassVar[bool] = False
    """Whether the plant is a map x⁺ = f(k, x, u). All times are then counted in steps, and those of
    samples are whole numbers."""
    stiff: ClassVar[bool] = False
    """Whether f has rates so different that an explicit method would need very small steps. The
    model then moves by a linearly implicit method (`pinnobs_gym.simulation.rosenbrock`), with
    `f_jacobian`, and the truth by LSODA."""
    input_hold: ClassVar[Literal["previous", "linear"]] = "previous"
    """What measured inputs are between samples: the value at the previous sample, as the output of
    a computer is held; or on straight lines, for samples of a continuous signal. Inputs of a log
    are measured ones."""

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

    @property
    def time_unit(self) -> str:
        """The unit of time: the step of a map, and the second otherwise."""
        return "steps" if self.discrete else "s"

    @property
    def state_box(self) -> StateBox | None:
        """The states within `state_low` and `state_high`; None without bounds."""
        if self.state_low is None and self.state_high is None:
            return None
        return box(self.state_low, self.state_high, self.nx)

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if "__repr__" not in vars(cls):  # which a dataclass would write of all fields
            cls.__repr__ = System.__repr__

    def __repr__(self) -> str:
        return call_of(self)

    def _repr_html_(self) -> str:
        scales = vector(self.scale, self.nx, "scale")
        rows = [
            *((name, "state", f"{s:g}") for name, s in zip(self.state_names, scales, strict=True)),
            *((name, "output", "") for name in self.output_names),
            *((name, "input", "") for name in self.input_names),
        ]
        with_units = [(name, kind, self.units.get(name, ""), scale) for name, kind, scale in rows]
        header = ("name", "kind", "unit", "scale")
        return html(repr(self), summary_of(type(self)), header, with_units)

    @abstractmethod
    def f(self, t: Array, x: Array, u: Array) -> Array:
        """Return the rate of change of the state, (..., nx), at time t (s), state x (..., nx) and
        input u."""

    @abstractmethod
    def h(self, t: Array, x: Array, u: Array) -> Array:
        """Return the noise-free output, (..., ny), at time t (s), state x (..., nx), input u (...,
        nu).

        The time is a number or an array (...); t and u broadcast against the batch of x as in `f`.
        At a sample, t and u are the time and input of that sample.
        """

    def input(self, t: Array) -> Array:
        """Return the known input u(t), (..., nu), at times t (...) in s. Zero unless overridden."""
        xp = array_namespace(t)
        return xp.zeros((*t.shape, self.nu), dtype=t.dtype)

    def draw_input(self, rng: np.random.Generator, times: np.ndarray) -> np.ndarray:
        """Return inputs (num_samples, nu) that are drawn for one episode, at its sample times
        (num_samples,) in s.

        A system that overrides this has other inputs in each episode. Between the samples they are
        as `input_hold` says, for the plant and for the model alike; estimators are told them at the
        samples. They are drawn from a random stream of their own. `input` then stands for them
        where a typical input is needed, such as in the design of gains.
        """
        return np.asarray(self.input(times))

    @property
    def draws_input(self) -> bool:
        """Whether inputs are drawn for each episode."""
        return type(self).draw_input is not System.draw_input

    def f_jacobian(self, t: Array, x: Array, u: Array) -> Array:
        """Return ∂f/∂x, (..., nx, nx); unless overridden, that of
        `pinnobs_gym.simulation.derivatives.jacobian`."""
        from pinnobs_gym.simulation.derivatives import jacobian

        return jacobian(self, "f", t, x, u)

    def h_jacobian(self, t: Array, x: Array, u: Array) -> Array:
        """Return ∂h/∂x, (..., ny, nx); unless overridden, that of
        `pinnobs_gym.simulation.derivatives.jacobian`."""
        from pinnobs_gym.simulation.derivatives import jacobian

        return jacobian(self, "h", t, x, u)

    def output_residual(self, y: Array, yhat: Array) -> Array:
        """Return y − ŷ (..., ny), with outputs that repeat wrapped into half a period about zero;
        see `output_period`."""
        return y - yhat if self.output_period is None else residual(y, yhat, self.output_period)

    def state_residual(self, x: Array, xhat: Array) -> Array:
        """Return x − x̂ (..., nx), with states that repeat wrapped into half a period about zero;
        see `state_period`."""
        return x - xhat if self.state_period is None else residual(x, xhat, self.state_period)

    def flow(self, t0: Array, t1: Array, x: Array, u: Array) -> Array:
        """Return the state (..., nx) at t1 (s) that follows from the state x (..., nx) at t0.

        The default moves the model as all estimators do: by a map, a linearly implicit method or a
        Runge-Kutta method. A plant with an exact or own propagation overrides it, and every
        estimator then uses that. Truth is still the solution of `f`.

        Args:
            t0: a number or, like t1, an array (...) that broadcasts against the batch of x.
            t1: the later time in s.
            x: states at t0.
            u: inputs at t0, shape (..., nu), held until t1 if they are measured. An input that
                `input` defines is known to the plant at any time.
        """
        from pinnobs_gym.simulation.model import model_step

        return model_step(self, t0, t1, x, u, u)

    def flow_jacobian(self, t0: Array, t1: Array, x: Array, u: Array) -> Array:
        """Return the derivative of `flow` with respect to x, (batch, nx, nx), for x (batch, nx):
        exactly for the default flow, and by central differences for an overridden one."""
        from pinnobs_gym.simulation.model import flow_jacobian

        return flow_jacobian(self, t0, t1, x, u)

    def admissible(self, x0: Array) -> Array:
        """Return which states (..., nx) of a setup's law are valid initial states: bool (...).
        Unless overridden, those within `state_low` and `state_high`."""
        xp = array_namespace(x0)
        finite, box = xp.all(xp.isfinite(x0), axis=-1), self.state_box
        if box is None:
            return finite
        low, high = (xp.asarray(side, dtype=x0.dtype) for side in (box.low, box.high))
        return finite & xp.all((x0 >= low) & (x0 <= high), axis=-1)

    def invariants(self, x: Array) -> Array | None:
        """Return quantities (..., k) that the undisturbed plant conserves, or None. Tests use
        them."""
        return None

    def observable(self, x: Array) -> Array:
        """Return which components can be determined from the output near x: bool (..., nx). Errors
        of the others are not scored."""
        xp = array_namespace(x)
        return xp.ones_like(x, dtype=xp.bool)

    def indistinguishable(self, x: Array) -> tuple[Array, ...]:
        """Return other states (..., nx) that give the same output as x at all times; none by
        default."""
        return ()

    def distances(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the distances between states and outputs, (nx, ny), and between outputs, (ny, ny),
        of a plant that extends in space, in any unit; None otherwise. Ensembles may take far
        correlations as zero (`pinnobs_gym.estimators.enkf.EnKF.localisation`)."""
        return None

    def breakpoints(self) -> tuple[float, ...]:
        """Return the times in s at which f, the input or the process noise jumps; steps of truth
        and model end at each."""
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
        noise_std: Level | None = None,
        parameters: Mapping[str, float] | None = None,
    ) -> tuple[Self, Setup]:
        """Return the system and the setup of that name, with some values replaced. If the duration
        is shorter than the setup's transient window, that is a quarter of it.

        Raises:
            ValueError: naming the value, if the setup or a parameter is unknown, or a value is out
                of range.
        """
        if not isinstance(setup, str) or setup not in cls.setups:
            raise ValueError(
                f"unknown setup {shortly(setup)} of {cls.__name__}; it has {', '.join(cls.setups)}"
                f"{did_you_mean(setup, cls.setups)}"
            )
        changes: dict[str, Any] = {"dt": dt, "duration": duration, "noise_std": noise_std}
        changes = {name: value for name, value in changes.items() if value is not None}
        own = cls.setups[setup].transient
        shorter = duration is not None and is_number(duration) and 0 < duration < (own or 0.0)
        if shorter:
            changes["transient"] = None
        chosen = replace(cls.setups[setup], **changes)
        system = cls()
        wanted = {**chosen.parameters, **check_mapping(parameters or {})}
        for name in wanted:
            if name not in system.parameters:
                known = ", ".join(system.parameters) or "none"
                raise ValueError(f"unknown parameter {name!r} of {cls.__name__}; it has {known}")
        check_parameters(cls, wanted)
        system = replace(system, **wanted)
        system.noise(chosen.noise_std, chosen.process_noise)
        system.check_times(chosen)
        return system, chosen

    def check_times(self, setup: Setup) -> None:
        """Check that the samples of a setup are at whole steps, if the plant is a map.

        Raises:
            ValueError: in one line, if they are not.
        """
        if self.discrete and setup.dt != round(setup.dt):
            raise ValueError(
                f"dt={setup.dt:g} of {type(self).__name__}, a map; expected a whole number of steps"
            )

    def noise(
        self, noise_std: Level | SampledLevel | None = None, process_noise: Level | None = None
    ) -> Noise:
        """Return the noise of the plant and of its outputs, which truth, estimators, trainers and
        references share.

        Args:
            noise_std: as `Setup.noise_std`, or by sample; that of the setup ``benchmark`` if None.
            process_noise: as `Setup.process_noise`; that of the setup ``benchmark`` if None.

        Raises:
            ValueError: in one line, if a level is not of the right size, or not of finite numbers,
                standard deviations at least 0.
        """
        own, name = self.setups["benchmark"], type(self).__name__
        samples = noise_std if isinstance(noise_std, SampledLevel) else None
        given = noise_std.base if isinstance(noise_std, SampledLevel) else noise_std
        level = own.noise_std if given is None else given
        output = noise_root(level, self.ny, "noise_std", name)
        if output.shape != (self.ny, self.ny):
            raise ValueError(
                f"noise_std of {name} has shape {output.shape}; expected ({self.ny}, {self.ny})"
            )
        level = own.process_noise if process_noise is None else process_noise
        return Noise(noise_root(level, self.nx, "process_noise", name), output, samples)

    @property
    def own_flow(self) -> bool:
        """Whether the class overrides `flow`."""
        return type(self).flow is not System.flow

    @classmethod
    def validate(cls) -> None:
        """Check the class attributes of a new system; see
        `pinnobs_gym.simulation.declared.check_declared`.

        Raises:
            TypeError: in one line, naming the class and what is missing or has the wrong size.
        """
        from pinnobs_gym.simulation.declared import check_declared

        for name in ("state_names", "output_names", "scale", "setups"):
            if getattr(cls, name, None) is None:
                raise TypeError(f"system {cls.__name__} has no class attribute {name!r}")
        check_declared(cls)
        try:
            for name in cls.setups:
                system, setup = cls.configured(name)
                for part in ("x0_low", "x0_high"):
                    if getattr(setup, part) is not None:
                        vector(getattr(setup, part), system.nx, f"{part} of setup {name!r}")
                setup.start(system.nx)
                for prior in (setup, setup.poor_prior):
                    if prior is not None:
                        _check_sizes(prior, system.nx, f"of setup {name!r}")
        except ValueError as error:
            raise TypeError(f"system {cls.__name__}: {error}") from None
        unknown = [name for name in cls.uncertain or () if name not in cls().parameters]
        if unknown:
            raise TypeError(f"system {cls.__name__}: uncertain names no parameter {unknown[0]!r}")


def _check_sizes(prior: Setup | PoorPrior, nx: int, where: str) -> None:
    """Raise ValueError, naming the value, unless x̂₀ and P₀, if given, are of the right size."""
    if prior.xhat0 is not None:
        vector(prior.xhat0, nx, f"xhat0 {where}")
    if prior.P0 is not None and np.shape(prior.P0) != (nx, nx):
        raise ValueError(f"P0 {where} has shape {np.shape(prior.P0)}; expected ({nx}, {nx})")


def independent(*std: float) -> tuple[tuple[float, ...], ...]:
    """Return the covariance, as rows, of independent components with these standard deviations.

    Raises:
        ValueError: if one of them is not finite or below 0.
    """
    if not all(is_finite(each) and 0 <= each <= LARGEST for each in std):
        raise ValueError(
            f"standard deviations {shortly(std)}; expected numbers of at least 0, at most "
            f"{LARGEST:g}"
        )
    return tuple(tuple(row) for row in np.diag(np.square(std, dtype=float)).tolist())


def vector(value: Sequence[float] | np.ndarray | float, size: int, name: str) -> np.ndarray:
    """Return the value as a float array (size,); a single number is repeated.

    Raises:
        ValueError: naming the value and the expected size.
    """
    array = real_array(name, value)
    if array.ndim == 0:
        array = np.full(size, float(array))
    if array.shape != (size,):
        raise ValueError(f"{name} has shape {array.shape}; expected {size} number(s)")
    return array


def stack(like: Array, *components: Array | float) -> Array:
    """Return the array (..., n) of n components, each a number or an array that broadcasts to the
    batch (...) of ``like`` (..., nx). In NumPy the result has the memory order of ``like``, so that
    arithmetic on the two is contiguous."""
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
    """Return the matrix (..., n, m) of the given entries, each a number or an array (...) like the
    batch of ``like`` (..., nx).

    The last axis of the batch is innermost in memory, so that arithmetic on one entry is
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


_TIMES = 9
"""Number of times, evenly spread over an episode, at which `output_scale` evaluates the output."""
_MOST_DRAWS = 100
"""How often ten states for each wanted one are drawn from a law."""
_STATES = 16
"""Number of initial states at which it does."""


def output_scale(system: System) -> np.ndarray:
    """Return the scale of each output, (ny,), in its unit.

    It is the largest change of the output, to first order, when one state changes by its scale: the
    largest over `_STATES` states of the benchmark's initial set, and `_TIMES` times of the episode
    and their inputs; one if no state changes the output. The numbers of the first row stand for
    all.
    """
    from pinnobs_gym.simulation.plant_form import first_row

    system = first_row(system)
    setup, scale = system.setups["benchmark"], vector(system.scale, system.nx, "scale")
    t = np.repeat(np.linspace(0.0, setup.duration, _TIMES), _STATES)
    x = np.tile(initial_states(system, setup, _STATES), (_TIMES, 1))
    u = np.asarray(system.input(t))
    if type(system).h_jacobian is System.h_jacobian:
        from pinnobs_gym.simulation.derivatives import central_differences

        # Few evaluations: differences take less time than it takes to import SymPy.
        slopes = central_differences(
            lambda x: system.h(t, x, u), x, scale, periods=system.output_period
        )
        changes = slopes * scale
    else:
        changes = system.h_jacobian(t, x, u) * scale
    size = abs(changes).max(axis=(0, -1))
    return np.where(size > 0, size, 1.0)


def initial_states(system: System, setup: Setup, count: int) -> np.ndarray:
    """Return states (count, nx) of a setup's initial set, the same at every call: drawn from its
    law, of which the admissible ones are taken, or the fixed initial state.

    Raises:
        ValueError: in one line, if too few of the states drawn are admissible.
    """
    law, rng, x0 = setup.start(system.nx), np.random.default_rng(0), np.empty((0, system.nx))
    if law.fixed:
        return np.repeat(law.mean[None], count, axis=0)
    for _ in range(_MOST_DRAWS):
        if len(x0) >= count:
            break
        drawn = law.draw(rng, 10 * count)
        x0 = np.concatenate([x0, drawn[np.asarray(system.admissible(drawn))]])
    if len(x0) < count:
        raise ValueError(
            f"{type(system).__name__}: {len(x0)} of {_MOST_DRAWS * 10 * count} states of the "
            "setup's law are admissible"
        )
    return x0[:count]
