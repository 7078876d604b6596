"""The likelihood of innovations, and Fisher's information about what they depend on."""

from __future__ import annotations

import numpy as np

from pinnobs_gym.simulation.matrices import divide


def minus_two_log_likelihoods(y: np.ndarray, e: np.ndarray, S: np.ndarray) -> np.ndarray:
    """Return Σ(eᵀS⁻¹e + log det 2πS), shape (batch,), over the samples with outputs.

    Args:
        y: outputs, shape (num_samples, ny); NaN marks a missing one.
        e: innovations, shape (batch, num_samples, ny).
        S: their covariances, shape (batch, num_samples, ny, ny).
    """
    total = np.zeros(len(e))
    with np.errstate(all="ignore"):  # what is not finite is found by the caller
        for rows, present in _patterns(y):
            own = S[:, rows][..., present, :][..., present]
            off = e[:, rows][..., present]
            if own.shape[-1] == 1:  # by far the most frequent
                s = own[..., 0, 0]
                total += (off[..., 0] ** 2 / s + np.log(2 * np.pi * s)).sum(axis=1)
                continue
            weighted = _divided(off[..., None, :], own)[..., 0, :]
            sign, size = np.linalg.slogdet(2 * np.pi * own)
            total += ((weighted * off).sum(axis=-1) + np.where(sign > 0, size, np.nan)).sum(axis=1)
    return total


def fisher(y: np.ndarray, S: np.ndarray, de: np.ndarray, dS: np.ndarray) -> np.ndarray:
    """Return Σ(∂eᵀS⁻¹∂e + ½ tr(S⁻¹∂S S⁻¹∂S)), shape (n, n), over the samples with outputs.

    Args:
        y: outputs, shape (num_samples, ny); NaN marks a missing one.
        S: covariances of the innovations, shape (num_samples, ny, ny).
        de: derivatives of the innovations by the unknowns, shape (ny, num_samples, n).
        dS: those of the covariances, shape (ny, ny, num_samples, n).
    """
    n = de.shape[-1]
    total = np.zeros((n, n))
    with np.errstate(all="ignore"):
        for rows, present in _patterns(y):
            own = S[rows][:, present][:, :, present]
            slopes = de[present][:, rows].transpose(1, 2, 0)  # (samples, n, outputs)
            total += np.einsum("kia,kja->ij", _divided(slopes, own), slopes)
            changes = dS[present][:, present][:, :, rows].transpose(2, 3, 0, 1)
            weighted = _divided(changes, own[:, None])
            total += 0.5 * np.einsum("kiab,kjba->ij", weighted, weighted)
    return total


def _divided(A: np.ndarray, S: np.ndarray) -> np.ndarray:
    """Return AS⁻¹ (..., n, m); NaN where S (..., m, m) is singular or not finite."""
    shape = np.broadcast_shapes(A.shape[:-2], S.shape[:-2])
    n, m = A.shape[-2:]
    flat = np.broadcast_to(A, (*shape, n, m)).reshape(-1, n, m).transpose(1, 2, 0)
    own = np.broadcast_to(S, (*shape, m, m)).reshape(-1, m, m).transpose(1, 2, 0)
    return (
        divide(np.ascontiguousarray(flat), np.ascontiguousarray(own))
        .transpose(2, 0, 1)
        .reshape(*shape, n, m)
    )


def _patterns(y: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the samples that have the same outputs, with these outputs."""
    present = ~np.isnan(y)
    found = []
    for pattern in np.unique(present[present.any(axis=1)], axis=0):
        rows = np.flatnonzero((present == pattern).all(axis=1))
        found.append((rows, np.flatnonzero(pattern)))
    return found
