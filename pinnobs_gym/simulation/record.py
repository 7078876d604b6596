"""The data available to an estimator in an episode: sampled outputs and inputs, and the prior."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pinnobs_gym.simulation.bounds import beyond
from pinnobs_gym.simulation.initial_set import prior_moments
from pinnobs_gym.simulation.shown import html
from pinnobs_gym.simulation.system import Setup, System
from pinnobs_gym.simulation.values import real_array

_ROUNDING = 1e-6
"""Largest difference of an input from that which a system defines, relative to its size."""
_TIMES = 200
"""Number of times at which that size is found."""
_SIZE = "_input_size"
"""Key of the size among the attributes of a system."""


@dataclass(frozen=True)
class Prior:
    """The prior of the initial state of a batch of episodes.

    Raises:
        ValueError: in one line, if an array does not hold finite real numbers.
    """

    mean: np.ndarray
    """Prior means x̂₀, shape (batch, nx), in state units."""
    cov: np.ndarray
    """Prior covariances P₀, shape (batch, nx, nx)."""

    def __post_init__(self) -> None:
        for name in ("mean", "cov"):
            array = real_array(f"the prior's {name}", getattr(self, name), truths=True)
            if not np.isfinite(array).all():
                wrong = float(array[~np.isfinite(array)][0])
                raise ValueError(f"the prior's {name} has the entry {wrong}; expected finite ones")
            object.__setattr__(self, name, array)

    def check_fits(self, system: System, batch: int) -> None:
        """Check that the prior is one of a system's states, for a number of episodes.

        Raises:
            ValueError: in one line that names the array, its shape and the shape expected.
        """
        nx = system.nx
        for name, size in (("mean", (nx,)), ("cov", (nx, nx))):
            shape, expected = getattr(self, name).shape, (batch, *size)
            if shape != expected:
                raise ValueError(
                    f"the prior's {name} has shape {shape}; {type(system).__name__} has nx={nx}, "
                    f"expected {expected}"
                )

    @staticmethod
    def of(system: System, setup: Setup, batch: int, xhat0: object = None) -> Prior:
        """Return the prior of a setup; ``xhat0``, (nx,) or (batch, nx), replaces its mean."""
        own, cov = prior_moments(system, setup)
        mean = own if xhat0 is None else real_array("xhat0", xhat0)
        if mean.shape not in ((system.nx,), (batch, system.nx)):
            raise ValueError(f"xhat0 has shape {mean.shape}; expected ({system.nx},)")
        if not np.isfinite(mean).all():
            raise ValueError(f"xhat0={mean.tolist()} is not finite")
        if (found := beyond(system, mean)) is not None:
            raise ValueError(f"xhat0={mean.tolist()}: {found}; expected it within the bounds")
        mean = np.broadcast_to(mean, (batch, system.nx)).copy()
        return Prior(mean, np.broadcast_to(cov, (batch, system.nx, system.nx)).copy())


@dataclass(frozen=True)
class Record:
    """The samples of a batch of episodes with common sample times.

    Arrays of float32 or of whole numbers are converted to double precision.

    Raises:
        ValueError: in one line, if an array does not hold real numbers, has another number of rows
            or samples than the others, or holds infinite values; if t does not increase; if a time
            or an input is not a number; or if a standard deviation is not above zero.
    """

    t: np.ndarray
    """Sample times in s, ascending, shape (num_samples,)."""
    y: np.ndarray
    """Outputs, shape (batch, num_samples, ny); NaN marks a missing output."""
    u: np.ndarray
    """Inputs at the samples, shape (batch, num_samples, nu)."""
    prior: Prior
    """The prior of the initial state."""
    noise_std: np.ndarray | None = None
    """Standard deviations of the output noise by sample, in output units, shape (batch,
    num_samples, ny); NaN where the level that the estimator is told holds, as it does everywhere if
    this is None."""

    def __post_init__(self) -> None:
        arrays = ["y", "u"] if self.noise_std is None else ["y", "u", "noise_std"]
        for name in ("t", *arrays):
            object.__setattr__(self, name, real_array(name, getattr(self, name), truths=True))
        steps = np.diff(self.t)
        if self.t.ndim != 1 or not len(self.t):
            raise ValueError(f"t has shape {self.t.shape}; expected (num_samples,)")
        if not np.isfinite(self.t).all():
            row = int(np.flatnonzero(~np.isfinite(self.t))[0])
            raise ValueError(f"t must be finite; sample {row} has t={self.t[row]}")
        if (steps <= 0).any():
            row = int(np.flatnonzero(~(steps > 0))[0]) + 1
            raise ValueError(
                f"t must increase; sample {row} has t={self.t[row]} after {self.t[row - 1]}"
            )
        batch = len(self.prior.mean)
        for name in arrays:
            array, last = getattr(self, name), "u" if name == "u" else "y"
            if array.ndim != 3 or array.shape[:2] != (batch, len(self.t)):
                raise ValueError(
                    f"{name} has shape {array.shape}; expected ({batch}, {len(self.t)}, n{last})"
                )
        std = np.ones(1) if self.noise_std is None else self.noise_std
        for name, wrong, allowed in (
            ("y", np.isinf(self.y), "finite numbers, or NaN if missing"),
            ("u", ~np.isfinite(self.u), "finite numbers"),
            ("noise_std", np.isinf(std) | (std <= 0), "numbers above 0, or NaN if not known"),
        ):
            if wrong.any():
                row, sample, i = (int(index) for index in np.argwhere(wrong)[0])
                raise ValueError(
                    f"{name}{i + 1} of row {row} is {getattr(self, name)[row, sample, i]} at "
                    f"sample {sample}; expected {allowed}"
                )

    def check_fits(self, system: System) -> None:
        """Check that the record has the outputs, the inputs and the states of a system and, for a
        map, that its times are whole numbers.

        Raises:
            ValueError: in one line that names the array, its size and the size expected, the
                sample, or the input that differs from the one that the system defines.
        """
        kind = type(system).__name__
        sizes = {"y": system.ny, "u": system.nu, "noise_std": system.ny}
        for name, size in sizes.items():
            array, last = getattr(self, name), "u" if name == "u" else "y"
            if array is not None and array.shape[2] != size:
                raise ValueError(
                    f"{name} has {array.shape[2]} column(s) in the record; {kind} has "
                    f"n{last}={size}"
                )
        check_use(system, self.t, self.u)
        self.prior.check_fits(system, self.batch)

    def __repr__(self) -> str:
        missing = 100 * float(np.isnan(self.y).mean()) if self.y.size else 0.0
        parts = [
            f"{self.batch} episode{'s' * (self.batch != 1)}",
            f"{self.num_samples} samples from t={self.t[0]:g} to {self.t[-1]:g}",
            f"ny={self.y.shape[2]}",
            f"nu={self.u.shape[2]}",
        ]
        parts += [f"{missing:.2g} % of the outputs missing"] * bool(missing)
        return f"{type(self).__name__}({', '.join(parts)})"

    def _repr_html_(self) -> str:
        names = [*(f"y{i + 1}" for i in range(self.y.shape[2]))]
        names += [f"u{i + 1}" for i in range(self.u.shape[2])]
        rows = []
        for name, column in zip(names, np.moveaxis(np.dstack([self.y, self.u]), 2, 0), strict=True):
            known = column[~np.isnan(column)]
            least, most = (f"{known.min():.4g}", f"{known.max():.4g}") if known.size else ("", "")
            rows.append((name, least, most, known.size))
        return html(repr(self), "", ("", "least", "most", "samples"), rows)

    @property
    def batch(self) -> int:
        """Number of episodes."""
        return len(self.y)

    @property
    def num_samples(self) -> int:
        """Number of samples of each episode."""
        return len(self.t)

    def rows(self, rows: np.ndarray | slice) -> Record:
        """Return the record of some of the episodes."""
        prior = Prior(self.prior.mean[rows], self.prior.cov[rows])
        std = None if self.noise_std is None else self.noise_std[rows]
        return Record(self.t, self.y[rows], self.u[rows], prior, std)

    def first_samples(self, number: int) -> Record:
        """Return the record of the first samples."""
        return self.samples(slice(number))

    def samples(self, chosen: slice | np.ndarray) -> Record:
        """Return the record of some of the samples."""
        std = None if self.noise_std is None else self.noise_std[:, chosen]
        return Record(self.t[chosen], self.y[:, chosen], self.u[:, chosen], self.prior, std)


def check_use(system: System, t: np.ndarray, u: np.ndarray) -> None:
    """Check that a system can use samples at times t (num_samples,), whole numbers for a map, and
    uses the inputs u (batch, num_samples, nu) that it is given.

    A system without measured inputs moves by those of its `System.input`. Others are refused;
    differences by a millionth of their size may be those of rounding to single precision.

    Raises:
        ValueError: in one line that names the time or the input and what was expected.
    """
    kind = type(system).__name__
    if system.discrete and (t != np.round(t)).any():
        wrong = t[t != np.round(t)][0]
        raise ValueError(f"a sample has t={wrong:g}; {kind} is a map, expected whole numbers")
    if system.nu and not system.measured_input:
        known = np.asarray(system.input(t))
        if (u == known).all():  # as usual, which takes a third of the time of what follows
            return
        size = np.maximum(abs(known).max(axis=0), abs(u).max(axis=(0, 1)))
        other = abs(u - known) > _ROUNDING * np.maximum(size, _input_size(system))
        if other.any():
            row, sample, i = (int(index) for index in np.argwhere(other)[0])
            raise ValueError(
                f"input {system.input_names[i]}={u[row, sample, i]:.6g} at t={t[sample]:g} is not "
                f"that of {kind}.input, {known[sample, i]:.6g}, which the model uses; expected the "
                f"same, or {kind}(measured_input=True) to use those given"
            )


def _input_size(system: System) -> np.ndarray:
    """Return the largest absolute value of each input (nu,) that the system defines over the
    benchmark's duration. It is kept among the attributes of the instance."""
    kept = vars(system)
    if _SIZE not in kept:
        t = np.linspace(0.0, system.setups["benchmark"].duration, _TIMES)
        kept[_SIZE] = abs(np.asarray(system.input(np.floor(t) if system.discrete else t))).max(
            axis=0
        )
    return kept[_SIZE]
