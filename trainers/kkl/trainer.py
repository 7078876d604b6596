"""The base class of the trainers of KKL observers."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np

from pinnobs_gym.estimation.learned.kkl_region import Region
from pinnobs_gym.estimation.learned.trained_file import plain
from pinnobs_gym.estimators.kkl import KKL, TrainedKKL
from pinnobs_gym.training.trainer import Trainer
from trainers.kkl import pictures
from trainers.kkl.config import KKLConfig
from trainers.kkl.fitting import Objective
from trainers.kkl.labels import initial_states
from trainers.kkl.learned_poles import EPISODES, STEPS, PoleSearch
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
SEARCH_SHARE = 0.25
"""Fraction of the budget that the training of the poles may take."""
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

    takes = KKL.takes
    simulates = True
    paced_by_budget = True
    labelled: ClassVar[bool] = True
    """Whether T* is fitted to simulated z, and not to T's own."""
    takes_drawn_inputs: ClassVar[bool] = False
    """Whether T need not fulfil an equation of its own, which a T that does not know the past of
    drawn inputs cannot."""

    @abstractmethod
    def encoding(self, samples: Samples) -> Objective:
        """Return the equations to which T is fitted."""

    @abstractmethod
    def gap(self) -> int:
        """Return the number of samples between the two of each kept pair; 0 without pairs."""

    def start(self) -> None:
        self._check()
        self.sweep: list[dict[str, float]] = []
        """The results at each cut-off so far."""
        self.search: PoleSearch | None = None
        """The training of the poles, if they are learned and not yet known."""
        self.poles: tuple[float, ...] | None = None
        """The learned poles in 1/s; None if they are not learned, or not yet."""
        self.fit: TwoStageFit | None = None
        """The current fit; None while the poles are learned."""
        if self.config.design == "learned":
            self.search = self._search()
        else:
            self.fit = self._next_fit()

    def _check(self) -> None:
        """Check that the system and the record can be trained on."""
        system, name = self.system, type(self.system).__name__
        if system.measured_input and not system.draws_input:
            raise ValueError(
                f"{name} has a measured input; a KKL observer is trained on simulated episodes and "
                f"needs u(t) to be known beforehand, or to be drawn by {name}.draw_input"
            )
        if system.draws_input and not self.takes_drawn_inputs:
            raise ValueError(
                f"{name} draws its inputs, on whose past T depends, which trainer {self.name!r} "
                "has no equation for; expected kkl_supervised"
            )
        if system.draws_input and self.config.start == "prior":
            raise ValueError(
                f"start='prior', but {name} draws its inputs, on whose past T(x̂₀) depends; "
                "expected output or zero"
            )
        if self.record.num_samples < MIN_SAMPLES:
            raise ValueError(
                f"the record has {self.record.num_samples} samples; a KKL observer needs "
                f"{MIN_SAMPLES}"
            )

    def _search(self) -> PoleSearch:
        """Prepare the training of the poles."""
        config, system = self.config, self.system
        x0 = initial_states(system, config.low, config.high, EPISODES, config.seed)
        std = self.noise_std if config.noise else np.zeros(system.ny)
        return PoleSearch(system, config.poles, self.record.t, std, x0, config.seed)

    @property
    def sweeping(self) -> bool:
        """Whether the cut-off is still to be chosen."""
        return self.config.sweep == "cutoff" and len(self.sweep) < len(SWEEP)

    def _next_fit(self, poles: tuple[float, ...] | None = None) -> TwoStageFit:
        """Simulate the samples for the sweep's next fit or for the final one, and prepare it.

        The fits of a sweep share what is left of its part of the budget equally.
        """
        record, config, deadline = self.record, self.config, self.config.budget
        if self.sweeping:
            cutoff = SWEEP[len(self.sweep)] * config.cutoff_for(self.system)
            steps = min(config.iterations, _SWEEP_STEPS)
            config = replace(config, cutoff=cutoff, iterations=steps)
            if deadline is not None:
                left = deadline * SWEEP_SHARE - self.seconds
                deadline = self.seconds + left / (len(SWEEP) - len(self.sweep))
        elif self.sweep:
            best = min(self.sweep, key=lambda point: point["loss"])["cutoff"]
            config = replace(config, cutoff=best)
        samples = Samples(
            self.system,
            config,
            record.t,
            record.prior.mean[:1],
            self.noise_std,
            self.gap(),
            self.labelled,
            poles or self.poles,
        )
        return TwoStageFit(samples, config, self.encoding, lambda: self.seconds, deadline)

    def step(self) -> None:
        self.iteration += 1
        if self.search is not None:
            self.search.step()
            budget = self.config.budget
            spent = budget is not None and self.seconds >= budget * SEARCH_SHARE
            if spent or self.search.finished():
                self.poles, self.search = self.search.poles, None
                self.fit = self._next_fit()
            return
        fit = self._present_fit
        fit.step()
        if self.sweeping and fit.finished():
            cutoff, loss = fit.config.cutoff_for(self.system), fit.best["T*"].error
            self.sweep.append({"cutoff": cutoff, "loss": loss, **fit.traded()})
            self.fit = self._next_fit()

    @property
    def _present_fit(self) -> TwoStageFit:
        """The current fit; while the poles are learned, one with the poles so far."""
        if self.fit is not None:
            return self.fit
        assert self.search is not None
        return self._next_fit(self.search.poles)

    def finished(self) -> bool:
        return self.fit is not None and self.fit.finished() and not self.sweeping

    def progress(self) -> float:
        if self.fit is None:
            assert self.search is not None
            return SEARCH_SHARE * self.search.iteration / STEPS
        first = SEARCH_SHARE if self.poles else 0.0
        part = self.fit.progress()
        if self.sweeping:
            part = SWEEP_SHARE * (len(self.sweep) + part) / len(SWEEP)
        elif self.sweep:
            part = SWEEP_SHARE + (1 - SWEEP_SHARE) * part
        return first + (1 - first) * part

    def status(self) -> str:
        if self.fit is None:
            assert self.search is not None
            return f"poles: loss {self.search.loss:.3g}"
        text = f"{self.fit.stage}: held out {self.fit.latest:.3g}"
        if self.sweeping:
            text = f"cut-off {self.fit.config.cutoff_for(self.system):.3g} Hz, {text}"
        return text

    def curves(self) -> Mapping[str, float]:
        if self.fit is None:
            assert self.search is not None
            return {"loss/poles": self.search.loss}
        if self.sweeping:
            return {f"sweep/{name}": value for name, value in (self.sweep or [{}])[-1].items()}
        name = "T" if self.fit.stage == "T" else "T_star"
        return {f"loss/{name}": self.fit.fit.loss, f"loss/{name}_held_out": self.fit.latest}

    def state(self) -> dict[str, Any]:
        # An unfinished search of the poles and an unfinished fit of a sweep are restarted.
        fit = None if self.sweeping or self.fit is None else self.fit.state()
        return {"sweep": self.sweep, "poles": self.poles, "fit": fit}

    def load_state(self, state: Mapping[str, Any]) -> None:
        self.sweep = list(state["sweep"])
        if state["poles"] is not None:
            self.poles, self.search = tuple(state["poles"]), None
        if self.search is None and (self.sweep or self.poles):
            self.fit = self._next_fit()
        if state["fit"] is not None:
            self._present_fit.load_state(state["fit"])

    def result(self) -> TrainedKKL:
        """Return the observer with the least validation errors."""
        fit = self._present_fit
        samples, decoder = fit.samples, fit.decoder()
        facts = self.facts(loss=decoder.error, seed=self.config.seed)
        trained = TrainedKKL(
            **{**facts, "config": plain(asdict(fit.config))},
            A=samples.dynamics.A,
            B=samples.dynamics.B,
            mode=samples.dynamics.mode,
            start=self.config.start,
            clock=samples.clock,
            activation=self.config.activation,
            encoder=fit.encoder,
            decoder=decoder.layers,
            facts={
                "dropped": samples.data.dropped,
                "drawn": samples.data.drawn,
                "loss_of_T": fit.best["T"].error,
                "low": samples.data.x.min(axis=(0, 1)).tolist(),
                "high": samples.data.x.max(axis=(0, 1)).tolist(),
                "sweep": self.sweep,
            },
        )
        return (
            replace(trained, region=_region(samples, trained)) if fit.config.fallback else trained
        )

    def figures(self, trained: TrainedKKL) -> dict[str, Figure]:
        return pictures.figures(self.system, trained, self.record)


def _region(samples: Samples, trained: TrainedKKL) -> Region:
    """Return the region of the z with noise of all kept samples, and T* of them."""
    data = samples.data
    z = data.z + samples.noise
    xhat = trained.inverse(z, data.t[:, None], data.u)
    z, xhat = (each.reshape(-1, each.shape[-1]) for each in (z, xhat))
    return Region.of(z, xhat, samples.config.seed)
