"""The KKL observer whose maps are fitted to the equation of T alone."""

from __future__ import annotations

from dataclasses import dataclass

from pinnobs_gym.kkl.observer import KKL


@dataclass(frozen=True)
class KKLAutoencoder(KKL):
    """A KKL observer, ż = A_z z + B_z y and x̂ = T*(z), whose T is fitted to its own equation over
    several samples, and T* to T, without simulated z (Peralez & Nadri 2021)."""

    name = "kkl_autoencoder"
    needs_training = "kkl_autoencoder"
