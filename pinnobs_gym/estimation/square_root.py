"""Square roots of covariances, for episodes whose prior is very wide beside the output noise.

In double precision, a covariance keeps 16 digits. Where the variances of the prior are 10¹⁶ times
those of the noise, HPHᵀ + R has lost R: two equal sensors make it singular, and what the first
outputs tell is lost at the next prediction. A root L with P = LLᵀ keeps the digits, because it
holds standard deviations instead of variances. Filters carry it in `State.root` for those episodes
alone. The steps below are the array algorithms of Kailath, Sayed & Hassibi (2000, "Linear
Estimation", chapter 12), by Householder's QR factorisation.

Here the batch is the first axis.
"""

from __future__ import annotations

import numpy as np

from pinnobs_gym.estimation.least_squares import root
from pinnobs_gym.simulation.cached import cached_by_plant
from pinnobs_gym.simulation.matrices import cholesky
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.system import System, output_scale, vector

WIDE = 1e5
"""Ratio of standard deviations, of the prior over the state's scale to the noise over the output's
scale, beyond which an episode is carried by roots. Covariances then lose up to ten of their digits
in the first update alone."""


_output_scale = cached_by_plant(output_scale)


def prior_root(system: System, prior: Prior, R: np.ndarray) -> np.ndarray | None:
    """Return roots of the covariances of a prior, shape (batch, nx, nx): NaN in rows that are not
    wide, and None if no row is.

    Args:
        system: the model.
        prior: the prior, checked.
        R: covariance of the output noise, shape (ny, ny, batch or 1).
    """
    scale = vector(system.scale, system.nx, "scale")
    widest = np.sqrt(np.einsum("bii->bi", prior.cov)) / scale
    noise = np.sqrt(np.einsum("iib->bi", R)) / _output_scale(system)
    wide = (widest > WIDE * noise.min(axis=1, keepdims=True)).any(axis=1)
    if not wide.any():
        return None
    roots = root(prior.cov.transpose(1, 2, 0)).transpose(2, 0, 1)
    return np.where(wide[:, None, None], roots, np.nan)


def carried(L: np.ndarray) -> np.ndarray:
    """Return the numbers of the rows that are carried by roots L (batch, nx, nx)."""
    return np.flatnonzero(np.isfinite(L).all(axis=(1, 2)))


def compressed(*parts: np.ndarray) -> np.ndarray:
    """Return the lower triangular L (batch, n, n) with LLᵀ = ΣAAᵀ for the given A (batch, n, m)."""
    stacked = np.concatenate([part.swapaxes(1, 2) for part in parts], axis=1)
    R: np.ndarray = np.linalg.qr(stacked)[1]
    return R.swapaxes(1, 2)


def covariance(L: np.ndarray) -> np.ndarray:
    """Return LLᵀ (batch, n, n)."""
    return L @ L.swapaxes(1, 2)


def updated(
    L: np.ndarray, innovation: np.ndarray, H: np.ndarray, R: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the corrections Ke (batch, nx) and the roots of the covariances after the update.

    Args:
        L: roots of the predicted covariances, shape (batch, nx, nx).
        innovation: e = y − h(t, x̂, u), shape (batch, ny).
        H: output Jacobians, shape (batch, ny, nx).
        R: covariances of the output noise, shape (batch, ny, ny).
    """
    ny = H.shape[1]
    # QR of [[√R, HL], [0, L]]ᵀ is [[√S, 0], [K√S, L⁺]]ᵀ.
    noise = root_of(R)
    top = np.concatenate([noise, H @ L], axis=2)
    bottom = np.concatenate([np.zeros((len(L), L.shape[1], ny)), L], axis=2)
    array = compressed(np.concatenate([top, bottom], axis=1))
    whitened = substituted(array[:, :ny, :ny], innovation[..., None])
    return (array[:, ny:, :ny] @ whitened)[..., 0], array[:, ny:, ny:]


def gain(X: np.ndarray, Y: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Return the gains XYᵀ(YYᵀ + R)⁻¹ (batch, nx, ny) without forming YYᵀ.

    Args:
        X: weighted deviations of points, shape (batch, nx, num_points).
        Y: those of their outputs, shape (batch, ny, num_points).
        R: covariances of the output noise, shape (batch, ny, ny).
    """
    stacked = np.concatenate([Y, root_of(R)], axis=2).swapaxes(1, 2)
    Q, T = np.linalg.qr(stacked)  # YYᵀ + R = TᵀT, and Y = Tᵀ times the first rows of Q, transposed
    product = X @ Q[:, : X.shape[2]]
    return substituted(T.swapaxes(1, 2), product.swapaxes(1, 2), transposed=True).swapaxes(1, 2)


def root_of(R: np.ndarray) -> np.ndarray:
    """Return the lower triangular root of a covariance R (batch, n, n) of noise."""
    return cholesky(R.transpose(1, 2, 0), semidefinite=True).transpose(2, 0, 1)


def substituted(L: np.ndarray, b: np.ndarray, transposed: bool = False) -> np.ndarray:
    """Return L⁻¹b or, if transposed, L⁻ᵀb, (batch, n, m) for lower triangular L (batch, n, n). A
    component with a zero pivot is zero, for it has no variance."""
    n, x = L.shape[1], np.zeros(b.shape)
    if transposed:
        L = L.swapaxes(1, 2)
    for j in reversed(range(n)) if transposed else range(n):
        rest = b[:, j] - (L[:, j, None] @ x)[:, 0]
        pivot = L[:, j, j, None]
        x[:, j] = np.where(pivot == 0, 0.0, rest / np.where(pivot == 0, 1.0, pivot))
    return x
