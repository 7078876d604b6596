"""filterpy's EKF for any system, of one episode."""

from __future__ import annotations

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.simulation.kernels.asked import ask
from pinnobs_gym.simulation.model import model_step_jacobian
from pinnobs_gym.simulation.record import Record


def filterpy_ekf(ekf: EKF, record: Record) -> np.ndarray:
    """Return the estimates (num_samples, nx) of the record's first episode, with the model's steps
    and Jacobians from compiled code, and with as many Runge-Kutta steps as the EKF's."""
    system, (t, y, u) = ekf.system, (record.t.tolist(), record.y[0], record.u[:1])
    ask(system, "model")
    time, samples = np.zeros(1), range(len(t))

    class Filter(ExtendedKalmanFilter):
        def predict_x(self, u=0):
            x, F = model_step_jacobian(system, t[k - 1], t[k], self.x[None], given[k - 1], given[k])
            self.x, self.F = x[0], F[0]

    given = [u[:, k] for k in samples]
    filter = Filter(dim_x=system.nx, dim_z=system.ny)
    filter.x, filter.P = record.prior.mean[0].copy(), record.prior.cov[0].copy()
    L = ekf.noise.L(0.0)[..., 0]
    filter.Q, filter.R = (t[1] - t[0]) * L @ L.T, ekf.noise.R(0.0)[..., 0]
    xhat = np.empty((len(t), system.nx))
    for k in samples:
        time[0] = t[k]
        if k:
            filter.predict()
        filter.update(
            y[k],
            lambda x, k=k: system.h_jacobian(time, x[None], given[k])[0],
            lambda x, k=k: system.h(time, x[None], given[k])[0],
        )
        xhat[k] = filter.x
    return xhat
