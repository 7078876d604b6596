"""The KKL observer whose T also satisfies its partial differential equation."""

from __future__ import annotations

from dataclasses import dataclass

from pinnobs_gym.kkl.observer import KKL


@dataclass(frozen=True)
class KKLPinn(KKL):
    """A KKL observer, ż = A_z z + B_z y and x̂ = T*(z), whose T is fitted to simulated pairs and to
    its partial differential equation at other points (Niazi et al. 2023)."""

    name = "kkl_pinn"
    needs_training = "kkl_pinn"
