"""The KKL observer whose maps are fitted to the equation of T alone."""

from __future__ import annotations

from dataclasses import dataclass

from pinnobs_gym.kkl.observer import KKL


@dataclass(frozen=True)
class KKLAutoencoder(KKL):
    """A KKL observer, ż = A_z z + B_z y and x̂ = T*(z), whose T is fitted to its own equation over
    several samples, and T* to T, without simulated z (Peralez & Nadri 2021)."""

    name = "kkl_autoencoder"
    equations = (
        KKL.equations.rstrip()
        + r""" \\
T &: \; \min \sum_k \Bigl\| T(x_{k+m}) - \Phi^m T(x_k)
- \sum_{j=k}^{k+m-1} \Phi^{k+m-1-j} (\Gamma_0 y_j + \Gamma_1 y_{j+1}) \Bigr\|^2 \\
T^* &: \; \min \textstyle\sum_k \| T^*(z_k) - x_k \|^2, \qquad z_k \text{ as } T \text{ says}
"""
    )
    needs_training = "kkl_autoencoder"
