"""Classical estimators: against other implementations, and what they reach."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks import Figure, at_least, at_most, cpu_seconds
from benchmarks.core import filterpy_ekf, system_step
from pinnobs_gym import evaluate
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.estimation.gaussian import GaussianEstimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.estimators.ckf import CKF
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.mhe import MHE
from pinnobs_gym.estimators.ukf import UKF
from pinnobs_gym.scoring.cramer_rao import cramer_rao, expected_nrmse
from pinnobs_gym.scoring.metrics import score, windows
from pinnobs_gym.simulation.model import model_step
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing

NAMES = ("ekf", "ukf", "strong_tracking_ekf", "enkf", "particle", "mhe")
SEEN = {
    "ReverseDuffing": "0/.28/.0013 0/.22/.0013 0/.27/.0066 0/.22/.0024 3/.17/.0013 0/.20/.0020",
    "HarmonicOscillator": "0/.58/.0016 0/.58/.0016 0/.77/.0097 0/.62/.0038 34/.99/.0020 "
    "0/.60/.0026",
    "Academic": "0/.22/.0020 0/.22/.0020 0/.31/.0070 0/.22/.0031 10/.26/.0021 0/.40/.0023",
    "ModifiedAcademic": "0/.20/.0006 0/.22/.0006 0/.24/.0037 0/.22/.0022 10/.31/.0007 0/.20/.0009",
    "Satellite": "3/.88/.0022 0/.94/.0022 0/.99/.0091 8/1.66/.0047 13/1.10/.0024 0/.80/.0032",
    "InductionMotor": "0/.19/.0007 0/.09/.0007 0/.04/.0077 0/.02/.0014 8/.28/.0008 0/.03/.0002",
}
"""Scores of independent implementations of `NAMES` on 100 benchmark episodes with the prior of
`CONDITION`: rate of divergence in %, median settling time in s, and median tail NRMSE modulo
indistinguishable states."""
CONDITION = "poor_prior"


def figures(repeats: int) -> Iterator[Figure]:
    """Measure the classical estimators."""
    yield from against_filterpy(repeats)
    yield from moving_horizon(repeats)
    yield from false_locks()
    for system, cells in SEEN.items():
        for name, cell in zip(NAMES, cells.split(), strict=True):
            yield from reached(name, system, *map(float, cell.split("/")))
    yield from over_the_reference()


def played(name: str, episodes: int) -> tuple[EpisodeSource, np.ndarray, Record]:
    """Return the source, true states (batch, num_samples, nx) and record of benchmark episodes."""
    source = EpisodeSource(name)
    streams = source.streams(range(episodes))
    result = source.play(source.draw(streams))
    return source, result.x[:-1].swapaxes(0, 1), source.record(result)


def against_filterpy(repeats: int) -> Iterator[Figure]:
    """Compare filters on 256 episodes of ReverseDuffing with filterpy's on one episode, with the
    same System. Estimates are compared without process noise, since filterpy's filters take its
    covariance over a step as given; times are those with the default tuning."""
    _, _, record = played("ReverseDuffing", 256)
    one = record.rows(slice(0, 1))
    peers: list[tuple[GaussianEstimator, Callable[[Any], np.ndarray], float | None]] = []
    ekf, ukf, ckf = EKF(ReverseDuffing()), UKF(ReverseDuffing()), CKF(ReverseDuffing())
    peers.append((ekf, lambda own: filterpy_ekf(own, one, system_step), 190.0))
    peers.append((ukf, lambda own: filterpy_sigma_points(own, one), 300.0))
    peers.append((ckf, lambda own: filterpy_sigma_points(own, one), None))
    for own, estimates, asked in peers:
        name, exact = own.label, replace(own, assumed_noise=0.0)
        largest = float(abs(estimates(exact) - exact.run(one).xhat[0]).max())
        yield at_most(f"{name} - filterpy's, largest difference", largest, "", 1e-9)
        peer = partial(estimates, own)
        times = [(cpu_seconds(peer), cpu_seconds(lambda own=own: own.run(record)) / record.batch)]
        for _ in range(repeats - 1):
            mine = cpu_seconds(lambda own=own: own.run(record)) / record.batch
            times.append((cpu_seconds(peer), mine))
        theirs, mine = np.median(times, axis=0) / record.num_samples * 1e9
        yield Figure(f"filterpy's {name}, per step", float(theirs), "ns", "", None)
        what = f"{name} of 256 episodes, per step and episode"
        if own is ekf:
            yield at_most(what, float(mine), "ns", 450.0)
        else:
            yield Figure(what, float(mine), "ns", "", None)
        ratio = float(np.median([peer_time / own_time for peer_time, own_time in times]))
        yield at_least(f"filterpy's {name} / own, per step and episode", ratio, "x", asked)


def filterpy_sigma_points(own: GaussianEstimator, record: Record) -> np.ndarray:
    """Return the estimates (num_samples, 2) of one ReverseDuffing episode by filterpy's UKF or CKF.

    The CKF's points are drawn again after the prediction, unlike in filterpy.
    """
    from filterpy.kalman import CubatureKalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter
    from filterpy.kalman.CubatureKalmanFilter import spherical_radial_sigmas

    system, dt = own.system, float(record.t[1] - record.t[0])

    def step(x: np.ndarray, dt: float) -> np.ndarray:
        return model_step(system, 0.0, dt, x)

    def output(x: np.ndarray) -> np.ndarray:
        return system.h(0.0, x, np.empty(0))

    if isinstance(own, UKF):
        points = MerweScaledSigmaPoints(2, alpha=1.0, beta=own.beta, kappa=1.0)
        filter = UnscentedKalmanFilter(2, 1, dt, output, step, points)
    else:
        filter = CubatureKalmanFilter(2, 1, dt, output, step)
    L, R = own.noise.L(0.0)[..., 0], own.noise.R(0.0)[..., 0]
    Q = dt * L @ L.T
    filter.x, filter.P = record.prior.mean[0].copy(), record.prior.cov[0].copy()
    filter.Q, filter.R = np.zeros((2, 2)), R
    xhat = np.empty((record.num_samples, 2))
    for k in range(record.num_samples):
        filter.predict(dt if k else 0.0)
        if isinstance(own, CKF):
            filter.sigmas_f = spherical_radial_sigmas(filter.x, filter.P)
        filter.Q = Q
        filter.update(record.y[0, k])
        xhat[k] = np.ravel(filter.x)
    return xhat


def moving_horizon(repeats: int) -> Iterator[Figure]:
    """Compare the MHE on 64 episodes of ReverseDuffing with do-mpc's on one, with window 20."""
    _, _, record = played("ReverseDuffing", 64)
    part = record.first_samples(200)
    own, peer = MHE(ReverseDuffing(), window=20), do_mpc_horizon(part.rows(slice(0, 1)), 20)
    times = []
    for _ in range(repeats):
        mine = cpu_seconds(lambda: own.run(part)) / part.num_samples / part.batch
        times.append((cpu_seconds(lambda: [next(peer) for _ in range(20)]) / 20, mine))
    theirs, mine = np.median(times, axis=0)
    yield Figure("do-mpc's MHE, window 20, per step", float(theirs * 1e3), "ms", "", None)
    what = "MHE of 64 episodes, window 20, per step and episode"
    yield Figure(what, float(mine * 1e6), "us", "", None)
    ratio = float(np.median([theirs / mine for theirs, mine in times]))
    yield at_least("do-mpc's MHE / own, per step and episode", ratio, "x", 50.0)


def do_mpc_horizon(record: Record, window: int) -> Iterator[np.ndarray]:
    """Yield the estimates (2,) of one ReverseDuffing episode by do-mpc's MHE, once its window is
    full.

    The Runge-Kutta step, the weights of the outputs and the prior, its arrival cost, are those of
    our MHE.
    """
    import casadi
    from do_mpc.estimator import MHE as Peer
    from do_mpc.model import Model

    dt = float(record.t[1] - record.t[0])

    def f(x: Any) -> Any:
        return casadi.vertcat(x[1] ** 3, -x[0])

    model = Model("discrete")
    x = model.set_variable("_x", "x", (2, 1))
    model.set_meas("y", x[0], meas_noise=True)
    k1 = f(x)
    k2 = f(x + dt / 2 * k1)
    k3 = f(x + dt / 2 * k2)
    k4 = f(x + dt * k3)
    model.set_rhs("x", x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4), process_noise=False)
    model.setup()
    peer = Peer(model, [])
    peer.settings.n_horizon, peer.settings.t_step = window, dt
    peer.settings.meas_from_data = True
    peer.settings.supress_ipopt_output()
    R = np.diagonal(EKF(ReverseDuffing()).noise.R(0.0)[..., 0])
    peer.set_default_objective(P_x=np.linalg.inv(record.prior.cov[0]), P_v=np.diag(1 / R))
    peer.setup()
    peer.x0 = record.prior.mean[0]
    peer.set_initial_guess()
    for k in range(record.num_samples):
        xhat = peer.make_step(record.y[0, k][:, None]).ravel()
        if k >= window:
            yield xhat


def false_locks() -> Iterator[Figure]:
    """Measure the EKF's rate of divergence on the motor with a large Q, without and with a gate."""
    for gate in (None, 0.9999):
        options = {"assumed_noise": 3e-2, "gate": gate}
        motor = "pinnobs/InductionMotor-v0"
        rows = evaluate("ekf", motor, episodes=100, condition=CONDITION, options=options)
        lost = float(np.mean([row["diverged"] for row in rows]))
        what = f"EKF of the motor with assumed_noise 0.03, gate {gate}: diverged"
        yield Figure(what, lost, "", "", None) if gate is None else at_most(what, lost, "", 0.0)


def reached(
    name: str, system: str, diverged: float, settling: float, tail: float
) -> Iterator[Figure]:
    """Compare an estimator on 100 benchmark episodes with an independent implementation."""
    rows = evaluate(name, f"pinnobs/{system}-v0", episodes=100, condition=CONDITION)
    tails = np.array([row["nrmse_tail_modulo"] for row in rows])
    lost = ~(tails <= 0.2)
    settled = np.where(lost, np.inf, [row["settling"] for row in rows])
    what = f"{name}, {system}, {CONDITION}"
    # The episodes are others than those: two binomial standard deviations for the rate.
    rate = diverged / 100
    rate = round(rate + 2 * np.sqrt(rate * (1 - rate) / len(lost)), 3)
    yield at_most(f"{what}: diverged", float(lost.mean()), "", rate)
    bound = round(1.3 * settling, 6)
    yield at_most(f"{what}: settling, median", float(np.median(settled)), "s", bound)
    median = float(np.median(np.where(lost, np.inf, tails)))
    yield at_most(f"{what}: tail NRMSE, median", median, "", round(1.3 * tail, 6))


def over_the_reference() -> Iterator[Figure]:
    """Compare the best online estimator of each system with the Cramér-Rao reference.

    The figure is the RMS over 100 episodes of the NRMSE of the steady window, over the RMS of the
    reference: a bound of the mean square bounds no median.
    """
    within = 0
    for name in SYSTEMS.classes():
        source, x, record = played(name, 100)
        bound = cramer_rao(source.system, record.t, x, record.prior.cov[0], source.noise)
        scored = source.system.observable(x)
        end = source.setup.transient_end
        part = windows(record.t, end)["steady"]
        reference = expected_nrmse(bound, source.system.scale, part, scored)
        best, ratio = "", np.inf
        for label, cls in ESTIMATORS.classes().items():
            if cls.track != "online" or cls.needs_training or cls.trains_on_record:
                continue
            own: BaseEstimator = cls.for_setup(source.system, source.setup)
            scores = score(source.system, record, x, own.run(record), end)
            now = _rms(scores.nrmse_steady_modulo) / _rms(reference)
            if now < ratio:
                best, ratio = label, now
        within += ratio <= 1.15
        yield Figure(f"steady RMS / reference of {best}, best on {name}", ratio, "x", "", None)
    yield at_least("systems on which that is at most 1.15", within, "", 4.0)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
