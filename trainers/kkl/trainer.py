"""The base class of the trainers of KKL observers."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from pinnobs_gym.estimation.learned.trained_file import plain
from pinnobs_gym.estimators.kkl import TrainedKKL
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System
from pinnobs_gym.training.trainer import Trainer
from trainers.kkl import pictures
from trainers.kkl.config import KKLConfig
from trainers.kkl.fitting import Objective
from trainers.kkl.samples import Samples
from trainers.kkl.two_stages import TwoStageFit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MIN_SAMPLES = 20
"""Fewest samples of a record."""
SWEEP = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""The cut-offs of a sweep, over that of the settings."""
SWEEP_SHARE = 0.5
"""Fraction of the budget that a sweep takes."""
_SWEEP_STEPS = 120
"""Largest number of steps of T* in each fit of a sweep."""

KKLConfigT = TypeVar("KKLConfigT", bound=KKLConfig)


class KKLTrainer(Trainer[KKLConfigT, TrainedKKL]):
    """Train T and T* on simulated episodes of the model; the record gives the sample times and the
    prior.

    With ``sweep`` the cut-off is first chosen by short fits at several cut-offs. The results of
    each fit are its ``cutoff`` in Hz; the ``loss``, by which the cut-off is chosen; the NRMSE in
    the last quarter of an episode without noise (``clean``) and with noise (``noisy``); the root of
    the difference of their squares over the NRMSE of the output noise (``noise_gain``); and the
    time in s after which the noisy error stays below twice that of the last quarter
    (``convergence``).
    """

    paced_by_budget = True
    labelled: ClassVar[bool] = True
    """Whether T* is fitted to simulated z, and not to T's own."""

    @abstractmethod
    def encoding(self, samples: Samples) -> Objective:
        """Return the equations to which T is fitted."""

    @abstractmethod
    def gap(self) -> int:
        """Return the number of samples between the two of each kept pair; 0 without pairs."""

    def start(self) -> None:
        _check(self.system, self.record)
        self.sweep: list[dict[str, float]] = []
        """The results at each cut-off so far."""
        if self.config.sweep == "cutoff":
            self.fit = self._fit(self._swept_config())
        else:
            self.fit = self._fit(self.config)

    @property
    def sweeping(self) -> bool:
        """Whether the cut-off is still to be chosen."""
        return self.config.sweep == "cutoff" and len(self.sweep) < len(SWEEP)

    def _fit(self, config: KKLConfigT) -> TwoStageFit:
        """Simulate the samples for a config, and prepare the fit to them."""
        record = self.record
        prior = record.prior.mean[:1]
        samples = Samples(
            self.system, config, record.t, prior, self.noise_std, self.gap(), self.labelled
        )
        return TwoStageFit(samples, config, self.encoding)

    def _swept_config(self) -> KKLConfigT:
        """Return the config of the sweep's next fit, or of the final fit with the best cut-off."""
        config, budget = self.config, self.config.budget
        if self.sweeping:
            cutoff = SWEEP[len(self.sweep)] * config.cutoff_for(self.system)
            part = None if budget is None else budget * SWEEP_SHARE / len(SWEEP)
            steps = min(config.iterations, _SWEEP_STEPS)
            return replace(config, cutoff=cutoff, iterations=steps, budget=part)
        best = min(self.sweep, key=lambda point: point["loss"])["cutoff"]
        left = None if budget is None else budget * (1 - SWEEP_SHARE)
        return replace(config, cutoff=best, budget=left)

    def step(self) -> None:
        self.fit.step()
        self.iteration += 1
        if self.sweeping and self.fit.finished():
            cutoff = self.fit.config.cutoff_for(self.system)
            loss = self.fit.best["T*"].error
            self.sweep.append({"cutoff": cutoff, "loss": loss, **self.fit.traded()})
            self.fit = self._fit(self._swept_config())

    def finished(self) -> bool:
        return self.fit.finished() and not self.sweeping

    def progress(self) -> float:
        if self.config.sweep == "none":
            return self.fit.progress()
        if self.sweeping:
            return SWEEP_SHARE * (len(self.sweep) + self.fit.progress()) / len(SWEEP)
        return SWEEP_SHARE + (1 - SWEEP_SHARE) * self.fit.progress()

    def status(self) -> str:
        text = f"{self.fit.stage}: held out {self.fit.latest:.3g}"
        if self.sweeping:
            text = f"cut-off {self.fit.config.cutoff_for(self.system):.3g} Hz, {text}"
        return text

    def curves(self) -> Mapping[str, float]:
        if self.sweeping:
            return {f"sweep/{name}": value for name, value in (self.sweep or [{}])[-1].items()}
        name = "T" if self.fit.stage == "T" else "T_star"
        return {f"loss/{name}": self.fit.fit.loss, f"loss/{name}_held_out": self.fit.latest}

    def state(self) -> dict[str, Any]:
        # A fit of an unfinished sweep is restarted.
        return {"sweep": self.sweep, "fit": None if self.sweeping else self.fit.state()}

    def load_state(self, state: Mapping[str, Any]) -> None:
        self.sweep = list(state["sweep"])
        if self.sweep:
            self.fit = self._fit(self._swept_config())
        if state["fit"] is not None:
            self.fit.load_state(state["fit"])

    def result(self) -> TrainedKKL:
        """Return the observer with the least validation errors."""
        fit, samples = self.fit, self.fit.samples
        decoder = fit.decoder
        facts = self.facts(loss=fit.best["T*"].error, seed=self.config.seed)
        return TrainedKKL(
            **{**facts, "config": plain(asdict(fit.config))},
            A=samples.dynamics.A,
            B=samples.dynamics.B,
            mode=samples.dynamics.mode,
            start=self.config.start,
            clock=samples.clock,
            activation=self.config.activation,
            encoder=fit.encoder,
            decoder=decoder,
            facts={
                "dropped": samples.data.dropped,
                "drawn": samples.data.drawn,
                "loss_of_T": fit.best["T"].error,
                "low": samples.data.x.min(axis=(0, 1)).tolist(),
                "high": samples.data.x.max(axis=(0, 1)).tolist(),
                "sweep": self.sweep,
            },
        )

    def figures(self, trained: TrainedKKL) -> dict[str, Figure]:
        return pictures.figures(self.system, trained, self.record)


def _check(system: System, record: Record) -> None:
    """Check that a system and a record can be trained on."""
    if system.measured_input:
        raise ValueError(
            f"{type(system).__name__} has a measured input; a KKL observer is trained on simulated "
            "episodes and needs u(t) to be known beforehand"
        )
    if record.num_samples < MIN_SAMPLES:
        raise ValueError(
            f"the record has {record.num_samples} samples; a KKL observer needs {MIN_SAMPLES}"
        )
