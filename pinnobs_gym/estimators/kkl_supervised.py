"""The KKL observer whose maps are fitted to simulated states."""

from __future__ import annotations

from dataclasses import dataclass

from pinnobs_gym.kkl.observer import KKL


@dataclass(frozen=True)
class KKLSupervised(KKL):
    """A KKL observer, ż = A_z z + B_z y and x̂ = T*(z), whose T* is fitted to simulated pairs of
    states and z (Ramos et al. 2020)."""

    name = "kkl_supervised"
    needs_training = "kkl_supervised"
