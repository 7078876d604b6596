"""A system whose unknown parameters, biases, disturbances and deviations of rates are further
states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field, fields, make_dataclass, replace
from typing import Any

import numpy as np

from pinnobs_gym.simulation.augmented_system import Augmented, Constants, Unknown
from pinnobs_gym.simulation.bounds import Bounds, box
from pinnobs_gym.simulation.cached import cached_by_plant
from pinnobs_gym.simulation.initial_set import prior_moments
from pinnobs_gym.simulation.noise import Level, noise_root
from pinnobs_gym.simulation.start_law import Box, Joint
from pinnobs_gym.simulation.system import PoorPrior, Setup, System, vector
from pinnobs_gym.simulation.values import is_number


def augmented(
    system: System,
    parameters: Mapping[str, Unknown] | None = None,
    output_bias: Mapping[str, Unknown] | None = None,
    disturbance: Mapping[str, Unknown] | None = None,
    rates: Mapping[str, Unknown] | None = None,
) -> Augmented:
    """Return a system with unknown constants as further states, which do not change, so
    that every estimator estimates them (Jazwinski 1970, section 8.4).

    The further states are, in this order: the parameters by their names, ``bias_<output>``, which
    is added to an output, ``disturbance_<state>``, which is added to the rate of change of a state,
    in state units per second (to the next state of a map), and ``rate_<state>``, the relative
    deviation r of the plant's own rate: ẋᵢ = (1 + r)·fᵢ or, of a map, xᵢ⁺ − xᵢ = (1 + r)·(fᵢ − xᵢ),
    without unit, before a disturbance is added. A disturbed plant moves by its f even if it has a
    flow of its own. Their scale is the standard deviation, so that an error of 1 in the scores is
    no better than the prior.

    In each setup, initial states are those of the given system, and each constant is uniform within
    √3 standard deviations of its mean and within its bounds. The prior consists of the system's own
    and of the means and variances of the constants, all independent. Where a setup names an unknown
    parameter, the mean is the setup's value.

    Its class, ``type(augmented(...))``, is named after the system and its constants, as
    ``Satellite_a1_bias_y1``, and can be registered like any other.

    Args:
        system: the system. Its equations use an unknown parameter in arithmetic on components, as
            in ``self.k * x[..., 0]``, because it differs between the rows of a batch.
        parameters: the unknown parameters by name.
        output_bias: the unknown constant errors of outputs, by the output's name.
        disturbance: the unknown constants added to rates of change, by the state's name.
        rates: the unknown relative deviations of rates of change, by the state's name, such as
            ``Unknown(0.0, 0.1)`` for a rate that is known to 10 %.

    Raises:
        ValueError: in one line, if nothing is unknown, a name is unknown or taken, a parameter is
            no number, acts on the input or the breakpoints, or cannot differ between rows, or if
            rates of a plant with a flow of its own are unknown.
    """
    given = {
        "parameters": parameters,
        "output_bias": output_bias,
        "disturbance": disturbance,
        "rates": rates,
    }
    known = {
        "parameters": tuple(system.parameters),
        "output_bias": system.output_names,
        "disturbance": system.state_names,
        "rates": system.state_names,
    }
    for what, constants in given.items():
        _check_constants(type(system).__name__, what, constants or {}, known[what])
    if rates and system.own_flow:
        kind, named = type(system).__name__, ", ".join(rates)
        raise ValueError(
            f"rates of {named}: {kind} moves by a flow of its own; expected a plant that moves by f"
        )
    for name in parameters or {}:
        value = getattr(system, name)
        if not is_number(value):
            kind = type(system).__name__
            raise ValueError(f"parameter {name}={value!r} of {kind}; expected a number")
    plant = replace(system, **{name: value.mean for name, value in (parameters or {}).items()})
    made: Any = _class(plant, *(tuple((constants or {}).items()) for constants in given.values()))
    return made()  # its class has defaults for all fields


def with_constants(system: Augmented, setup: Setup) -> Setup:
    """Return a setup of a system's plant as one of the system: with the means and variances of the
    constants in the prior, and without process noise of the constants."""
    pairs = [pair for kind in system.constants for pair in kind]
    names = system.state_names[system.plant.nx :]
    extras = {name: value for name, (_, value) in zip(names, pairs, strict=True)}
    # The plant has its parameters, and the means of the unknown ones are those of the constants.
    own = replace(setup, parameters={})
    return _setup(system.plant, own, extras, [])


def _check_constants(
    system: str, what: str, constants: Mapping[str, Unknown], known: tuple[str, ...]
) -> None:
    """Raise ValueError if a name is not known or a value is no `Unknown`."""
    kind = {"parameters": "parameter", "output_bias": "output"}.get(what, "state")
    for name, value in constants.items():
        if name not in known:
            listed = ", ".join(known) or "none"
            raise ValueError(f"{what}: unknown {kind} {name!r} of {system}; it has {listed}")
        if not isinstance(value, Unknown):
            raise ValueError(f"{what}[{name!r}]={value!r}; expected Unknown(mean, std)")


@cached_by_plant
def _class(
    plant: System,
    parameters: Constants,
    biases: Constants,
    disturbances: Constants,
    rates: Constants,
) -> type[Augmented]:
    """Return the class of `augmented`, given the plant at the mean of the parameters. The same
    arguments give the same class."""
    cls, constants = type(plant), dict(parameters)
    _check_input(plant, parameters)
    pairs = [
        *parameters,
        *((f"bias_{name}", value) for name, value in biases),
        *((f"disturbance_{name}", value) for name, value in disturbances),
        *((f"rate_{name}", value) for name, value in rates),
    ]
    kept = [f for f in fields(plant) if not f.kw_only and f.name not in constants]
    taken = [*plant.state_names, *plant.output_names, *plant.input_names, *(f.name for f in kept)]
    _check_names(cls.__name__, [name for name, _ in pairs], taken)
    extras = dict(pairs)
    title = "_".join([cls.__name__, *extras])
    namespace = {
        **_attributes(plant, extras, [f.name for f in kept]),
        # A method that the plant leaves to `System` is left to it here, too: others ask for that.
        **{name: getattr(System, name) for name in _OPTIONAL if _is_inherited(cls, name)},
        **({"flow": System.flow} if disturbances else {}),
        "__doc__": f"{cls.__name__} with unknown constants as states: {', '.join(extras)}.",
        "__module__": cls.__module__,  # where its equations are
        "__reduce__": _reduced,
        "constants": (parameters, biases, disturbances, rates),
    }
    own: list[Any] = [(f.name, f.type, _default(getattr(plant, f.name))) for f in kept]
    own += [
        (name, kind, field(default=value, kw_only=True))
        for name, kind, value in (
            ("plant", "System", plant),
            ("measured_input", "bool", plant.measured_input),
        )
    ]
    made: Any = make_dataclass(title, own, bases=(Augmented,), namespace=namespace, frozen=True)
    if parameters:
        _check_rows(made(), plant)
    return made


def _reduced(system: Augmented) -> tuple[Any, ...]:
    """How a system is pickled: by what made its class, which pickle cannot import."""
    values = {f.name: getattr(system, f.name) for f in fields(system)}
    return _again, (system.plant, system.constants, values)


def _again(plant: System, constants: tuple[Any, Any, Any, Any], values: dict[str, Any]) -> System:
    return _class(plant, *constants)(**values)


_OPTIONAL = ("input", "draw_input", "admissible", "f_jacobian", "h_jacobian", "flow")


def _is_inherited(cls: type[System], name: str) -> bool:
    return getattr(cls, name) is getattr(System, name)


def _default(value: Any) -> Any:
    try:
        hash(value)
    except TypeError:  # dataclasses take no default that can change, such as an array
        return field(default_factory=lambda: value)
    return field(default=value)


def _attributes(plant: System, extras: Mapping[str, Unknown], kept: list[str]) -> dict[str, Any]:
    """Return the class attributes that `System` defines."""
    cls, n = type(plant), plant.nx
    scale = vector(plant.scale, n, "scale")
    bound = 10 * scale if plant.state_bound is None else vector(plant.state_bound, n, "state_bound")
    wide = [abs(value.mean) + 10 * value.std for value in extras.values()]
    varying = isinstance(getattr(cls, "output_names"), property)  # noqa: B009 (of the class)
    return {
        "state_names": (*plant.state_names, *extras),
        "output_names": property(lambda self: self._known.output_names)
        if varying
        else plant.output_names,
        "input_names": plant.input_names,
        "units": _units(plant, extras),
        "output_period": property(lambda self: self._known.output_period)
        if varying
        else plant.output_period,
        "state_period": plant.state_period and (*plant.state_period, *[None] * len(extras)),
        "scale": (*scale.tolist(), *(float(value.std) for value in extras.values())),
        "state_low": _extended(plant.state_low, n, [value.low for value in extras.values()]),
        "state_high": _extended(plant.state_high, n, [value.high for value in extras.values()]),
        "state_bound": (*bound.tolist(), *map(float, wide)),
        "setups": {name: _setup(plant, s, extras, kept) for name, s in plant.setups.items()},
        "version": plant.version,
        "ranked_condition": plant.ranked_condition,
        "uncertain": None
        if plant.uncertain is None
        else tuple(name for name in plant.uncertain if name in kept),
        "model_step": plant.model_step,
        "discrete": plant.discrete,
        "stiff": plant.stiff,
        "input_hold": plant.input_hold,
    }


def _extended(
    bounds: Bounds | None, nx: int, further: Sequence[float | None]
) -> tuple[float | None, ...] | None:
    """Return the bounds of the plant's states and those of the constants; None without any."""
    if bounds is None and not any(bound is not None for bound in further):
        return None
    return (*([None] * nx if bounds is None else bounds), *further)


def _units(plant: System, extras: Mapping[str, Unknown]) -> dict[str, str]:
    """Return the units of the plant and of the constants, by name."""
    units = dict(plant.units)
    for name in plant.output_names:
        if f"bias_{name}" in extras and name in units:
            units[f"bias_{name}"] = units[name]
    for name in plant.state_names:
        if f"disturbance_{name}" in extras:
            unit = units.get(name, "1")
            faster = f"{unit}²" if unit.endswith("/s") else f"{unit}/s"
            units[f"disturbance_{name}"] = unit if plant.discrete else faster
    return units


def _setup(plant: System, setup: Setup, extras: Mapping[str, Unknown], kept: list[str]) -> Setup:
    """Return a setup with the initial states and the prior of the constants added."""
    own = {name: value for name, value in setup.parameters.items() if name in kept}
    mean, cov = prior_moments(replace(plant, **setup.parameters), setup)
    # A constant whose name is not that of a parameter is not named by a setup.
    means = np.array([setup.parameters.get(name, value.mean) for name, value in extras.items()])
    stds = np.array([value.std for value in extras.values()])
    law = setup.start(plant.nx)
    half = np.sqrt(3) * stds  # of a uniform law with this standard deviation
    lows, highs = means - half, means + half
    sides = [[getattr(value, side) for value in extras.values()] for side in ("low", "high")]
    limits = box(sides[0], sides[1], len(means))
    if limits is not None:
        lows, highs = limits.clipped(lows), limits.clipped(highs)
    poor = setup.poor_prior
    if isinstance(law, Box):
        starts = {"x0_low": _row(law.corners[0], lows), "x0_high": _row(law.corners[1], highs)}
    else:
        starts = {"x0_law": Joint(law, Box(tuple(lows.tolist()), tuple(highs.tolist())))}
    return replace(
        setup,
        **starts,
        xhat0=_row(mean, means),
        P0=_diagonal(cov, stds),
        poor_prior=poor
        and PoorPrior(
            _row(vector(poor.xhat0, plant.nx, "xhat0"), means),
            _diagonal(np.array(poor.P0, dtype=float), stds),
        ),
        parameters=own,
        process_noise=_padded(plant, setup, len(stds)),
    )


def _padded(plant: System, setup: Setup, count: int) -> Level:
    """Return the plant's process noise with none in ``count`` further states."""
    L = noise_root(setup.process_noise, plant.nx, "process_noise")
    if not L.any():
        return 0.0
    return tuple(map(tuple, np.pad(L, ((0, count), (0, 0))).tolist()))


def _row(first: np.ndarray, second: np.ndarray) -> tuple[float, ...]:
    return (*first.tolist(), *second.tolist())


def _diagonal(cov: np.ndarray, stds: np.ndarray) -> tuple[tuple[float, ...], ...]:
    """Return the block-diagonal matrix of a covariance (n, n) and of variances."""
    whole = np.diag(np.r_[np.zeros(len(cov)), stds**2])
    whole[: len(cov), : len(cov)] = cov
    return tuple(map(tuple, whole.tolist()))


def _check_names(system: str, names: list[str], taken: list[str]) -> None:
    """Raise ValueError if there are no constants, or if one has the name of something else."""
    if not names:
        raise ValueError(
            f"nothing of {system} is unknown; give parameters, output_bias, disturbance or rates"
        )
    for i, name in enumerate(names):
        if name in taken or name in names[:i]:
            raise ValueError(f"{system} has {name!r} already; the new state needs that name")


def _check_input(plant: System, parameters: Constants) -> None:
    """Raise ValueError if a parameter changes what is known at all times: input, breakpoints."""
    t = np.linspace(0.0, plant.setups["benchmark"].duration, 101)
    for name, value in parameters:
        other = replace(plant, **{name: value.mean + value.std})
        for what, same in (
            ("input", np.array_equal(plant.input(t), other.input(t), equal_nan=True)),
            ("breakpoints", plant.breakpoints() == other.breakpoints()),
        ):
            if not same:
                raise ValueError(
                    f"parameter {name} of {type(plant).__name__} acts on its {what}; expected one "
                    "that acts on f and h alone"
                )


def _check_rows(system: Augmented, plant: System) -> None:
    """Raise ValueError if the equations do not take parameters that differ between rows."""
    count = 2 + max(system.nx, system.ny)  # not a size that could be taken for that of an axis
    mean = vector(system.setups["benchmark"].xhat0 or (), system.nx, "xhat0")
    x, t = np.tile(mean, (count, 1)), np.zeros(count)
    u, later = np.asarray(system.input(t)), t + system.setups["benchmark"].dt
    calls: dict[str, tuple[int, tuple[Any, ...]]] = {
        "f": (system.nx, (t, x, u)),
        "h": (system.ny, (t, x, u)),
    }
    if system.own_flow:
        calls["flow"] = system.nx, (t, later, x, u)
    for name, (size, arguments) in calls.items():
        try:
            with np.errstate(all="ignore"):
                shape = np.shape(getattr(system, name)(*arguments))
            found = "" if shape == (count, size) else f"returns shape {shape}"
        except Exception as error:  # whatever the user's function raises
            found = f"raises {type(error).__name__}: {' '.join(str(error).split())}"
        if found:
            raise ValueError(
                f"{type(plant).__name__}.{name} {found} for parameters of shape ({count},), one "
                f"per row of x; expected ({count}, {size}), from self.k * x[..., 0] and stack"
            )
