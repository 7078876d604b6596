"""The KKL observer whose maps are fitted to simulated states."""

from __future__ import annotations

from dataclasses import dataclass

from pinnobs_gym.kkl.observer import KKL


@dataclass(frozen=True)
class KKLSupervised(KKL):
    """A KKL observer, ż = A_z z + B_z y and x̂ = T*(z), whose T* is fitted to simulated pairs of
    states and z (Ramos et al. 2020)."""

    name = "kkl_supervised"
    equations = (
        KKL.equations.rstrip()
        + r""" \\
T &: \; \min \textstyle\sum_i \| T(x_i) - z_i \|^2, \qquad
T^* : \; \min \textstyle\sum_i \| T^*(z_i) - x_i \|^2
"""
    )
    needs_training = "kkl_supervised"
