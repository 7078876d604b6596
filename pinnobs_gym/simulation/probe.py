"""The first call of a model's functions, so that a mistake in them is one line that says where."""

from __future__ import annotations

import functools
import inspect
import sys
import sysconfig
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from pinnobs_gym.simulation.at_bounds import faults_at_bounds
from pinnobs_gym.simulation.declared import check_declared, check_starts
from pinnobs_gym.simulation.noise import Noise
from pinnobs_gym.simulation.notices import say_once
from pinnobs_gym.simulation.system import Setup, System, initial_states
from pinnobs_gym.simulation.values import is_number


class ModelError(TypeError):
    """A function of a system fails or returns what it should not; the message is one line with the
    function, the file and line of the mistake, and what was expected."""


_TIMES = 5
"""Number of times in an episode at which the noise of a class is tried."""
_BATCHES = ((2,), (3,), (2, 3))
"""Leading axes of the arrays that are tried. Two sizes tell a batch from a fixed number."""
_LIBRARIES = [Path(sysconfig.get_path(name)) for name in ("stdlib", "purelib", "platlib")]
_PACKAGE = Path(__file__).parent
_ADVICE = "array functions of xp = array_namespace(x), on the last axis: x[..., 0]"


@functools.cache
def probe(cls: type[System]) -> None:
    """Call the functions of a system on small batches in NumPy, once per class, with the
    benchmark's parameters. A line in the log says where they are not finite within the bounds of
    the states, or nearly infinitely steep at one.

    Raises:
        TypeError: in one line, if the class declares what it should not, see `check_declared`.
        ModelError: in one line, if one of its functions raises an exception, returns another shape
            than expected, or returns other values when it is called again.
    """
    check_declared(cls)
    system, setup = cls.configured()
    times = np.linspace(0.0, setup.duration, 3)
    times = np.floor(times) if cls.discrete else times  # those of a map are whole numbers
    _check_breakpoints(system)
    if system.draws_input:
        _check_drawn(system, setup.times)
    if cls.noise is not System.noise:
        _check_noise(system, setup)
    inputs = _call(system, "input", (system.nu,), t=times)
    _call(system, "admissible", (), x=np.zeros((3, system.nx)) + setup.start(system.nx).mean)
    check_starts(cls)
    states = initial_states(system, setup, 6)
    for batch in _BATCHES:
        count = int(np.prod(batch))
        x = states[:count].reshape(*batch, system.nx)
        t = np.linspace(0.0, setup.duration, count).reshape(batch)
        t = np.floor(t) if cls.discrete else t
        u = np.broadcast_to(inputs[-1], (*batch, system.nu)).copy()
        _call(system, "f", (system.nx,), t=t, x=x, u=u)
        _call(system, "h", (system.ny,), t=t, x=x, u=u)
        if system.own_flow:
            _call(system, "flow", (system.nx,), t0=t, t1=t + setup.dt, x=x, u=u)
        _call(system, "observable", (system.nx,), x=x)
        if cls.flow_jacobian is not System.flow_jacobian:
            shape = (system.nx, system.nx)
            if len(batch) == 1:  # it is called for a batch with one axis
                _call(system, "flow_jacobian", shape, t0=t, t1=t + setup.dt, x=x, u=u)
        if cls.f_jacobian is not System.f_jacobian:
            _call(system, "f_jacobian", (system.nx, system.nx), t=t, x=x, u=u)
        if cls.h_jacobian is not System.h_jacobian:
            _call(system, "h_jacobian", (system.ny, system.nx), t=t, x=x, u=u)
    for line in faults_at_bounds(system, setup):
        say_once(line)


@functools.cache
def probe_torch(cls: type[System], name: str) -> None:
    """Differentiate a class's f or h once by torch, which its default Jacobian needs.

    Raises:
        ModelError: in one line, if that is not possible.
    """
    import torch

    system, setup = cls.configured()
    x = torch.tensor(initial_states(system, setup, 3))
    t = torch.linspace(0.0, setup.duration, 3, dtype=x.dtype)
    t = torch.floor(t) if cls.discrete else t
    u = torch.tensor(np.asarray(system.input(t.numpy())))
    function, where = getattr(system, name), _Where(system, name)
    what = f"of torch tensors, which {name}_jacobian needs; expected {_ADVICE}, or a "
    what += f"{name}_jacobian of its own"
    try:
        # Both a plain call and its derivative, as some functions support only the former.
        value = function(t, x, u)
        torch.func.jvp(lambda x: function(t, x, u), (x,), (torch.ones_like(x),))
    except Exception as error:  # whatever the user's function raises
        raise where.failed(error, what) from error
    if not isinstance(value, torch.Tensor):
        raise where.returned(value, what)


def _check_breakpoints(system: System) -> None:
    """Raise ModelError unless the breakpoints are a tuple or a list of finite numbers."""
    where = _Where(system, "breakpoints")
    what = "; expected a tuple of finite times in s, () for none"
    try:
        times = system.breakpoints()
    except Exception as error:  # whatever the user's function raises
        raise where.failed(error, what.removeprefix("; ")) from error
    if not isinstance(times, tuple | list) or not all(
        is_number(t) and np.isfinite(t) for t in times
    ):
        raise where.found(f"returns {times!r}{what}")


def _check_noise(system: System, setup: Setup) -> None:
    """Raise ModelError unless the noise that a class defines has finite L, G and R of the right
    shapes, at times over an episode."""
    where, nx, ny = _Where(system, "noise"), system.nx, system.ny
    try:
        noise = system.noise(setup.noise_std, setup.process_noise)
    except Exception as error:  # whatever the user's function raises
        raise where.failed(error, "; expected a Noise") from error
    if not isinstance(noise, Noise):
        raise where.returned(noise, "; expected a Noise")
    for t in np.linspace(0.0, setup.duration, _TIMES).tolist():
        for name, rows, columns in (("L", nx, "m"), ("G", ny, "m"), ("R", ny, str(ny))):
            what = f"whose {name}(t={t:g})"
            expected = f"; expected finite numbers of shape ({rows}, {columns}, 1)"
            try:
                value = np.asarray(getattr(noise, name)(t))
            except Exception as error:  # whatever the user's function raises
                raise where.failed(error, f"returns noise {what} fails{expected}") from error
            given = value.shape
            wide = len(given) == 3 and columns in ("m", str(given[1]))
            if not (wide and (given[0], given[2]) == (rows, 1)):
                raise where.found(f"returns noise {what} has shape {given}{expected}")
            if value.dtype.kind not in "biuf" or not np.isfinite(value).all():
                raise where.found(f"returns noise {what} is {value[..., 0].tolist()}{expected}")


def _check_drawn(system: System, times: np.ndarray) -> None:
    """Raise ModelError unless the inputs drawn at these times (num_samples,) are finite numbers,
    shape (num_samples, nu)."""
    where, shape = _Where(system, "draw_input"), (len(times), system.nu)
    what = f"for times {times.shape}; expected finite numbers of shape {shape}"
    try:
        u = system.draw_input(np.random.default_rng(0), times)
    except Exception as error:  # whatever the user's function raises
        raise where.failed(error, what) from error
    if np.shape(u) != shape:
        raise where.returned(u, what)
    array = np.asarray(u)
    if array.dtype.kind not in "biuf" or not np.isfinite(array).all():
        wrong = array[~np.isfinite(array)][0] if array.dtype.kind in "biuf" else array.flat[0]
        raise where.found(f"returns the input {wrong} {what}")


def _call(system: System, name: str, shape: tuple[int, ...], **arguments: np.ndarray) -> np.ndarray:
    """Return a function's value (*batch, *shape) in NumPy.

    Raises:
        ModelError: unless it is an array of that shape, and the same at each call.
    """
    function, where = getattr(system, name), _Where(system, name)
    values = tuple(arguments.values())
    batch = arguments["x"].shape[:-1] if "x" in arguments else arguments["t"].shape
    expected = (*batch, *shape)
    given = ", ".join(f"{a} {value.shape}" for a, value in arguments.items())
    what = f"for {given}; expected shape {expected}"
    try:
        with np.errstate(all="ignore"):
            value, again = function(*values), function(*values)
    except Exception as error:  # whatever the user's function raises
        raise where.failed(error, f"{what}, by {_ADVICE}") from error
    if not isinstance(value, np.ndarray | np.generic) or value.shape != expected:
        raise where.returned(value, what, lambda: function(*values))
    if not np.array_equal(value, again, equal_nan=value.dtype.kind == "f"):
        raise where.found(f"returns other values when called again {what}, the same at each call")
    return np.asarray(value)


class _Where:
    """The place of a mistake in a function of a system."""

    def __init__(self, system: System, name: str) -> None:
        self._name = f"{type(system).__name__}.{name}"
        self._code = inspect.unwrap(getattr(type(system), name)).__code__
        self._file, self._line = self._code.co_filename, self._code.co_firstlineno

    def found(self, what: str) -> ModelError:
        """Return the error of one line."""
        line = f"{self._name} ({Path(self._file).name}, line {self._line}) {what}"
        return ModelError(" ".join(line.split()))

    def failed(self, error: Exception, what: str) -> ModelError:
        """Return the error for an exception, whose place is the last line of the user's code."""
        for frame in traceback.extract_tb(error.__traceback__):
            path = Path(frame.filename)
            library = any(path.is_relative_to(folder) for folder in (*_LIBRARIES, _PACKAGE))
            if frame.filename == self._code.co_filename or not library:
                self._file, self._line = frame.filename, frame.lineno or self._line
        return self.found(f"raises {type(error).__name__}: {error}, {what}")

    def returned(self, value: Any, what: str, again: Callable[[], Any] | None = None) -> ModelError:
        """Return the error for a wrong result, whose place is the line of the return that a further
        call takes."""

        def note(frame: Any, event: str, _: Any) -> None:
            if event == "return" and frame.f_code is self._code:
                self._line = frame.f_lineno

        if again is not None:
            before = sys.getprofile()
            sys.setprofile(note)
            try:
                again()
            finally:
                sys.setprofile(before)
        shape = getattr(value, "shape", None)
        kind = type(value).__name__ if shape is None else f"shape {tuple(shape)}"
        return self.found(f"returns {kind} {what}")
