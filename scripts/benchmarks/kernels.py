"""Compiled code against the same in NumPy, and against other libraries, on the built-in systems.

Times are of one thread, in CPU time. Compilation is told apart. Peers that are not installed (extra
``peers``) are named and left out.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from kernel_figures import env_speed
from kernel_figures.timing import environment, in_process, medians, pair, repeated

from benchmarks import Figure, at_least, at_most, cpu_seconds
from pinnobs_gym.estimation.recursive import RecursiveEstimator
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.enkf import EnKF
from pinnobs_gym.estimators.particle import ParticleFilter
from pinnobs_gym.estimators.ukf import UKF
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.systems import SYSTEMS

SHAPES = ((1, 1001), (16, 400), (256, 200), (4096, 40))
"""Numbers of episodes and of samples."""
ASKED = {1: 150.0, 256: 10.0}
"""NumPy's time over ours, by the number of episodes."""
ASKED_OF_JAX = {1: 5.0, 256: 8.0}
ASKED_OF_MOTOR = {1: 5.0, 256: 5.0}
"""The same of dynamax."""
ASKED_OF_UPDATE = {"ekf": 8.0, "mhe, window 20": 60.0}
"""Time of a single update in µs."""
OF_SETS = ((1, 200), (16, 100), (256, 20))
"""The same for ensembles and particles, which take longer."""
TEMPLATES = ("ekf", "sigma_points", "ensemble", "particles", "truth", "model")
PEERS = ("dynamax", "cuthbert", "filterpy")
AGREEMENT = {"filterpy": 1e-9, "cuthbert": 1e-9, "dynamax": 1e-4}
"""Largest difference of estimates over the states' scale."""
LORENZ = ((40, 1, 40), (40, 64, 4), (200, 1, 4), (200, 64, 2))
"""Numbers of states, of episodes and of samples."""


def figures(repeats: int) -> Iterator[Figure]:
    """Measure compiled code."""
    missing = [name for name in PEERS if not find_spec(name)]
    if missing:
        print(f"not installed: {', '.join(missing)}; left out", file=sys.stderr)
    yield Figure("peers that are not installed", len(missing), "", "", None)
    yield from compilation()
    for name in SYSTEMS.classes():
        for cls in (EKF, UKF):
            yield from against_numpy(name, cls, repeats, SHAPES)
        for cls in (EnKF, ParticleFilter):
            yield from against_numpy(name, cls, repeats, OF_SETS)
        yield from alone(name, repeats)
        if "filterpy" not in missing:
            yield from against_filterpy(name, repeats)
        if not {"dynamax", "cuthbert"} <= set(missing):
            yield from against_jax(name, repeats)
    yield from env_speed.figures(repeats)
    yield from large(repeats, peer="dynamax" not in missing)


def compilation() -> Iterator[Figure]:
    """Measure the compiler's time for each algorithm and system, and what is kept of it."""
    with tempfile.TemporaryDirectory() as folder:
        kept = {"XDG_CACHE_HOME": folder, "PINNOBS_CACHE": folder}
        for name in SYSTEMS.classes():
            for template in TEMPLATES:
                seconds = in_process("compilation", name, template, **kept)
                asked = 1.0 if name == "InductionMotor" else 0.7
                yield at_most(f"compilation, {template}, {name}", seconds, "CPU-s", asked)
        size = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())
    yield Figure("libraries of all algorithms and systems", size, "bytes", "", None)


def against_numpy(
    name: str,
    cls: type[RecursiveEstimator],
    repeats: int,
    shapes: Sequence[tuple[int, int]],
) -> Iterator[Figure]:
    """Compare records in compiled code with NumPy."""
    slow, fast = pair(name, cls)
    asked = ASKED if shapes is SHAPES else {}

    def in_numpy(record: Record) -> None:
        with environment(PINNOBS_KERNELS="0"):  # nor are steps of the model compiled
            slow.run(record)

    for batch, samples in shapes:
        record = repeated(name, batch, samples)
        times = medians([lambda r=record: in_numpy(r), lambda r=record: fast.run(r)], repeats)
        yield from compared("NumPy", f"{fast.label}, {name}", record, times, asked.get(batch))


def compared(
    peer: str, what: str, record: Record, times: np.ndarray, asked: float | None
) -> Iterator[Figure]:
    """Return the figures of a peer's time and ours, in s."""
    each = times / (record.batch * record.num_samples) * 1e9
    what = f"{what}, batch {record.batch}"
    yield Figure(f"{what}: {peer}, per sample and episode", float(each[0]), "ns", "", None)
    yield Figure(f"{what}: compiled, per sample and episode", float(each[1]), "ns", "", None)
    yield at_least(f"{what}: {peer} / compiled", float(each[0] / each[1]), "x", asked)


def alone(name: str, repeats: int) -> Iterator[Figure]:
    """Measure single updates of all estimators, and the truth, in a process with kernels and in one
    without."""
    slow, fast = (in_process("alone", name, repeats, PINNOBS_KERNELS=k) for k in ("0", "1"))
    for what, value in fast.items():
        unit, one = ("ns", "per sample and episode") if "truth" in what else ("us", "one update")
        about = f"{what}, {name}: {one}"
        asked = ASKED_OF_UPDATE.get(what)
        yield Figure(f"{about}, NumPy", slow[what], unit, "", None)
        if asked is None:
            yield Figure(f"{about}, with kernels", value, unit, "", None)
        else:
            yield at_most(f"{about}, with kernels", value, unit, asked)
        yield Figure(f"{about}, NumPy / with kernels", slow[what] / value, "x", "", None)


def against_filterpy(name: str, repeats: int) -> Iterator[Figure]:
    """Compare updates of the EKF with those of filterpy's, whose model is compiled."""
    from kernel_figures.filterpy_peer import filterpy_ekf

    fast, record = pair(name, EKF)[1], repeated(name, 1, 121)
    exact = replace(fast, assumed_noise=0.0)
    yield from difference("filterpy", name, exact, filterpy_ekf(exact, record)[None], record)

    def play() -> None:
        state = fast.reset(record.prior)
        for k, t in enumerate(record.t.tolist()):
            state = fast.update(state, t, record.y[:, k], record.u[:, k])

    times = medians([lambda: filterpy_ekf(fast, record), play], repeats) / record.num_samples * 1e6
    yield Figure(
        f"filterpy's ekf, compiled model, {name}: one update", float(times[0]), "us", "", None
    )
    ratio = float(times[0] / times[1])
    yield at_least(f"filterpy's ekf, compiled model / one update, {name}", ratio, "x", 1.0)


def difference(
    peer: str, name: str, exact: EKF, xhat: np.ndarray, record: Record
) -> Iterator[Figure]:
    """Return the largest difference between estimates of an EKF without process noise."""
    scale = np.asarray(exact.system.scale)
    worst = float(abs((xhat - exact.run(record).xhat) / scale).max())
    # dynamax adds a small number to the covariance of outputs.
    yield at_most(f"ekf - {peer}'s over scale, {name}", worst, "", AGREEMENT[peer])


def against_jax(name: str, repeats: int) -> Iterator[Figure]:
    """Compare the EKF with those of JAX's libraries, with the same model and Runge-Kutta steps."""
    from kernel_figures.jax_peers import EKFS

    fast = pair(name, EKF)[1]
    asked = ASKED_OF_MOTOR if name == "InductionMotor" else ASKED_OF_JAX
    for peer, make in EKFS.items():
        for batch, samples in SHAPES[:3]:
            record = repeated(name, batch, samples)
            call = make(fast, record)
            started = cpu_seconds(call)
            if batch == 1:
                yield Figure(f"{peer}'s ekf, {name}: compilation", started, "CPU-s", "", None)
                exact = replace(fast, assumed_noise=0.0)
                yield from difference(peer, name, exact, make(exact, record)(), record)
            times = medians([call, lambda r=record: fast.run(r)], repeats)
            bound = asked.get(batch) if peer == "dynamax" else None
            yield from compared(peer, f"ekf, {name}", record, times, bound)


def large(repeats: int, *, peer: bool) -> Iterator[Figure]:
    """Compare the EKF on Lorenz-96 with dynamax's, both in double precision and with as many
    Runge-Kutta steps. Ours integrates the process noise over each of these; dynamax adds it once
    per sample."""
    for nx, batch, samples in LORENZ:
        what = f"ekf, Lorenz-96 of {nx} states, batch {batch}"
        own = in_process("lorenz", "own", nx, batch, samples, repeats)
        for value, unit in zip(own, ("ms per sample", "MB at most"), strict=True):
            yield Figure(what, value, unit, "", None)
        if peer:
            other = in_process("lorenz", "dynamax", nx, batch, samples, repeats)
            for value, unit in zip(other, ("ms per sample", "MB at most"), strict=True):
                yield Figure(f"dynamax's {what}", value, unit, "", None)
            yield at_most(f"{what}: time / dynamax's", own[0] / other[0], "x", 0.5)
            yield at_most(f"{what}: memory / dynamax's", own[1] / other[1], "x", 1.0)
