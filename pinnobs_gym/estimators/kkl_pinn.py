"""The KKL observer whose T also satisfies its partial differential equation."""

from __future__ import annotations

from dataclasses import dataclass

from pinnobs_gym.kkl.observer import KKL


@dataclass(frozen=True)
class KKLPinn(KKL):
    """A KKL observer, ż = A_z z + B_z y and x̂ = T*(z), whose T is fitted to simulated pairs and to
    its partial differential equation at other points (Niazi et al. 2023)."""

    name = "kkl_pinn"
    equations = (
        KKL.equations.rstrip()
        + r""" \\
T &: \; \min \sum_i \| T(x_i) - z_i \|^2 + \frac{w}{\lambda^2} \sum_j
\Bigl\| \tfrac{\partial T}{\partial x}(x_j)\, f(x_j) - A_z T(x_j) - B_z h(x_j) \Bigr\|^2, \qquad
\lambda = \min |\operatorname{Re} \lambda(A_z)| \\
T^* &: \; \min \textstyle\sum_i \| T^*(z_i) - x_i \|^2
"""
    )
    needs_training = "kkl_pinn"
