"""Time of a sample of a live filter, beside the estimator's own update and other libraries.

Medians and latencies of single samples are CPU time of one thread: on the clock, the slowest
samples are those at which the machine turned to something else.
"""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import Any

import numpy as np
from benchmarks import Figure, at_least, at_most
from kernel_figures.alone import estimators
from kernel_figures.timing import medians, repeated

from pinnobs_gym import Live
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimation.estimator import Estimator
from pinnobs_gym.estimation.live_ring import Ring
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.systems import SYSTEMS

NAMES = tuple(SYSTEMS.sources)
"""The systems of the package; other figures register their own."""
SAMPLES = 400
"""Number of samples of an episode that are played."""
ASKED = 8.0
"""Time of a sample in µs."""
SINGLE = 20_000
"""Number of samples whose latency is measured one by one."""
LATE = 10
"""How many samples are processed anew for a late one."""


def figures(repeats: int) -> Iterator[Figure]:
    """Measure live filters."""
    found = {name: make for name, make in PEERS.items() if available(name)}
    if missing := [name for name in PEERS if name not in found]:
        print(f"not installed: {', '.join(missing)}; left out", file=sys.stderr)
    for name in NAMES:
        yield from of_ekf(name, repeats, [peer for make in found.values() for peer in make()])
    yield from of_all("ReverseDuffing", repeats)
    yield from late(repeats)


@dataclass(frozen=True)
class Peer:
    """The EKF of another library, sample by sample from Python."""

    what: str
    """Its description."""
    of: str
    """What its estimates are called."""
    make: Callable[[EKF, Record], Callable[[], np.ndarray]]
    """Returns a call whose result is the estimates (num_samples, nx) of a record."""
    asked: float | None = 1.0
    """Its time over that of a live filter."""


def filterpy_peers() -> list[Peer]:
    """Return filterpy's EKF."""
    from kernel_figures.filterpy_peer import filterpy_ekf

    def make(ekf: EKF, record: Record) -> Callable[[], np.ndarray]:
        return lambda: filterpy_ekf(ekf, record)

    return [Peer("filterpy's, compiled model", "filterpy's", make)]


def jax_peers() -> list[Peer]:
    """Return that of JAX."""
    from log_figures.jax_step import jax_ekf

    return [Peer("a jitted step of JAX", "that of JAX", jax_ekf)]


def casadi_peers() -> list[Peer]:
    """Return those of CasADi. Its compiled code by buffers is a bare call without any check, and
    faster than `Live`."""
    from log_figures.casadi_step import casadi_ekf, compiled_ekf

    called = Peer("a function of CasADi called with arrays", "that of CasADi", casadi_ekf)
    if not shutil.which("gcc"):
        print("gcc is not found; CasADi's compiled code is left out", file=sys.stderr)
        return [called]
    what = "CasADi's compiled code by buffers"
    return [called, Peer(what, "that of CasADi's compiled code", compiled_ekf, None)]


PEERS: dict[str, Callable[[], list[Peer]]] = {
    "filterpy": filterpy_peers,
    "jax": jax_peers,
    "casadi": casadi_peers,
}
"""The EKFs of other libraries, by the name of the module."""


def available(module: str) -> bool:
    """Return whether a module is installed."""
    return find_spec(module) is not None


def of_ekf(name: str, repeats: int, peers: list[Peer]) -> Iterator[Figure]:
    """Measure the EKF of a system, and the same of other libraries."""
    ekf, record = EKF(SYSTEMS.resolve(name)()), repeated(name, 1, SAMPLES)
    exact = replace(ekf, assumed_noise=0.0)
    calls = {
        "live, what": played(ekf, record),
        "live, and all values read": played(ekf, record, read=True),
        "estimator's update": updated(ekf, record),
    }
    if ekf.system.nu:
        calls["live, inputs not given"] = played(ekf, record, given=False)
    for peer in peers:
        calls[peer.what] = peer.make(ekf, record)
        off = abs(peer.make(exact, record)() - exact.run(record).xhat[0]).max(axis=0)
        largest = float((off / np.asarray(ekf.system.scale)).max())
        yield at_most(f"ekf - {peer.of} over scale, {name}", largest, "", 1e-9)
    times = medians(list(calls.values()), repeats) / record.num_samples * 1e6
    own = dict(zip(calls, times.tolist(), strict=True))
    yield at_most(f"live ekf, {name}: one sample", own.pop("live, what"), "us", ASKED)
    for what, value in own.items():
        if what == "live, inputs not given":
            yield at_most(f"ekf, {name}: one sample, {what}", value, "us", ASKED)
        else:
            yield Figure(f"ekf, {name}: one sample, {what}", value, "us", "", None)
    for peer in peers:
        ratio = own[peer.what] / float(times[0])
        yield at_least(f"ekf, {name}: {peer.what} / live", ratio, "x", peer.asked)
    single = latencies(ekf, record)
    for share in (50.0, 99.9):
        value = float(np.percentile(single, share))
        yield Figure(f"live ekf, {name}: latency of {share:g} % of samples", value, "us", "", None)


def of_all(name: str, repeats: int) -> Iterator[Figure]:
    """Measure all estimators of a system but the EKF beside their own updates."""
    record = repeated(name, 1, 61)
    for estimator in estimators(EpisodeSource(name)):
        if type(estimator) is EKF:
            continue
        calls = [played(estimator, record), updated(estimator, record)]
        live, own = medians(calls, repeats) / record.num_samples * 1e6
        window = estimator.options.get("window")
        label = estimator.label if window is None else f"{estimator.label}, window {window}"
        what = f"{label}, {name}: one sample"
        yield Figure(f"{what}, live", float(live), "us", "", None)
        yield Figure(f"{what}, estimator's update", float(own), "us", "", None)


def late(repeats: int) -> Iterator[Figure]:
    """Measure what late samples take."""
    ekf, record = EKF(SYSTEMS.resolve("ReverseDuffing")()), repeated("ReverseDuffing", 1, SAMPLES)
    samples = samples_of(record)
    begun, place = _started(ekf, record, late="replay"), len(samples) - LATE - 1
    for each in [*samples[:place], *samples[place + 1 :]]:
        begun.update(*each)
    ring = vars(begun)["_ring"]
    steps = vars(begun)["_steps"]

    def replayed() -> None:
        ring.with_late(_sample(samples[place]), steps, "s", np.inf)

    calls = [played(ekf, record, late="replay"), replayed]
    times = medians(calls, repeats) * 1e6 / (record.num_samples, 1)
    yield Figure("live ekf that takes late samples: one in order", float(times[0]), "us", "", None)
    what = f"live ekf: a sample that is {LATE} samples late"
    yield Figure(what, float(times[1]), "us", "", None)


def _sample(values: tuple[float, np.ndarray, np.ndarray]) -> Any:
    from pinnobs_gym.estimation.live_sample import sample_of

    return sample_of(SYSTEMS.resolve("ReverseDuffing")(), *values)


def samples_of(record: Record) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Return time, outputs and inputs of the samples of a record's first row."""
    return list(zip(record.t.tolist(), record.y[0], record.u[0], strict=True))


def _started(estimator: Estimator, record: Record, **settings: Any) -> Live:
    return Live(estimator, record.prior.mean[0], record.prior.cov[0], **settings)


def played(
    estimator: Estimator,
    record: Record,
    *,
    read: bool = False,
    given: bool = True,
    late: Any = "refuse",
) -> Callable[[], object]:
    """Return a call that plays a record through a live filter, which has been made.

    Args:
        estimator: the estimator.
        record: the record.
        read: read all values of the estimates.
        given: give the inputs with the samples.
        late: as in `Live`.
    """
    live = _started(estimator, record, late=late)
    size, begin = vars(live)["_ring"].size, vars(live)["_ring"].latest
    samples = [(t, y, u if given else None) for t, y, u in samples_of(record)]

    def play() -> None:
        vars(live)["_ring"] = Ring(size, begin)  # from the beginning
        for t, y, u in samples:
            estimate = live.update(t, y, u)
            if read:
                _ = estimate.xhat, estimate.std, estimate.nis

    return play


def updated(estimator: Estimator, record: Record) -> Callable[[], object]:
    """Return a call that plays a record by the estimator's own updates."""
    samples = [(t, record.y[:, k], record.u[:, k]) for k, t in enumerate(record.t.tolist())]
    begun = estimator.reset(record.prior)

    def play() -> None:
        state = begun
        for t, y, u in samples:
            state = estimator.update(state, t, y, u)

    return play


def latencies(estimator: Estimator, record: Record) -> np.ndarray:
    """Return the CPU times of single samples in µs, (num_samples,), each with that of two looks at
    the clock."""
    samples, taken = samples_of(record), []
    clock = time.thread_time_ns
    for _ in range(-(-SINGLE // record.num_samples)):
        live = _started(estimator, record)
        for t, y, u in samples:
            start = clock()
            live.update(t, y, u)
            taken.append(clock() - start)
    return np.array(taken) / 1e3


if __name__ == "__main__":
    for figure in figures(5):
        print(f"{figure.figure}: {figure.value:.4g} {figure.unit} {figure.asked}", flush=True)
