"""PINN-Obs: a network for the estimates and gains of one record, by the paper's or a fast recipe.

Farkane, Boutayeb, Oudani & Ghogho, "PINN-Obs: Physics-Informed Neural Network-Based Observer for
Nonlinear Dynamical Systems". Equation numbers here and in the settings are the paper's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from pinnobs_gym.estimation.gaussian import checked
from pinnobs_gym.estimators.pinn_obs import PinnObsReplay, TrainedNetwork
from pinnobs_gym.simulation.noise import Level
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System
from pinnobs_gym.training.log import Log
from pinnobs_gym.training.loop import deferred_interrupt, train
from pinnobs_gym.training.trainer import Trainer
from trainers.pinn_obs.config import PinnObsConfig, guided, paper, plain, posterior, transfer
from trainers.pinn_obs.fast_recipe import FastRecipe
from trainers.pinn_obs.minimum import BestIterate, Mark, Minimiser
from trainers.pinn_obs.paper_recipe import PaperRecipe
from trainers.pinn_obs.passes import unflattened
from trainers.pinn_obs.pictures import figures
from trainers.pinn_obs.posterior_recipe import PosteriorRecipe
from trainers.pinn_obs.recipe import Recipe
from trainers.pinn_obs.stacked import advance

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MIN_SAMPLES = 10
"""Fewest samples of a record."""
_RECIPES: dict[str, type[Recipe[Any, Any]]] = {
    "adam": PaperRecipe,
    "ssbroyden": FastRecipe,
    "levenberg_marquardt": PosteriorRecipe,
}
_RESTARTS = 3
_TERMS = ("initial", "equation", "output")


class PinnObsTrainer(Trainer[PinnObsConfig, TrainedNetwork]):
    """Train PINN-Obs on the record of one episode.

    The weights with the least training loss are kept. If the loss is not finite, training is
    restarted from the next seed, at most three times. The paper's recipe does not use the noise.
    """

    name = "pinn_obs"
    takes = PinnObsReplay.takes
    presets = {
        "guided": guided,
        "plain": plain,
        "transfer": transfer,
        "paper": paper,
        "posterior": posterior,
    }

    def __init__(self, *args: Any, recipe: Recipe[Any, Any] | None = None, **options: Any) -> None:
        self._given = recipe  # one of many that were prepared at once
        super().__init__(*args, **options)

    def start(self) -> None:
        _check(self.system, self.record, self.config)
        kind = _RECIPES[self.config.optimiser]
        self.recipe = self._given or kind(self.system, self.config, self.record, self.noise)
        self._kept: BestIterate | None = None  # best of the failed attempts
        self._begin(attempt=0)

    def _begin(self, attempt: int) -> None:
        """Draw the initial weights of an attempt."""
        self.attempt = attempt
        self.best: BestIterate | None = None
        self.mark = Mark(math.inf, self.iteration)
        self.stuck = False
        seed = self.config.seed + attempt
        self._first = self.recipe.draw(torch.Generator().manual_seed(seed))
        self._method: Minimiser | None = None

    @property
    def theta(self) -> np.ndarray:
        """The current weights (n,)."""
        return self._first if self._method is None else self._method.x

    def step(self) -> None:
        """Make one iteration; the first one only evaluates the initial weights."""
        method, lower = self._method, True
        if method is None:
            method = self._method = self.recipe.begin(self._first)
        else:
            lower = method.step(self.recipe.objective)
        self.took(method.f, method.x, lower)

    def took(self, loss: float, theta: np.ndarray, lower: bool = True) -> None:
        """Count an iteration, and keep its weights if their loss is the least.

        Args:
            loss: loss at the iteration's weights.
            theta: the weights, shape (n,).
            lower: False if the minimiser could not find a lower loss.
        """
        self.iteration += 1
        self.stuck = not lower
        if not math.isfinite(loss):
            self._restart()
        elif self.best is None or loss < self.best.loss:
            if loss < (1 - self.config.improvement) * self.mark.loss:
                self.mark = Mark(loss, self.iteration)
            self.best = BestIterate(loss, self.iteration, self.config.seed + self.attempt, theta)

    def reached(self, iteration: int, best: BestIterate, mark: Mark, stuck: bool) -> None:
        """Take the place of a minimisation elsewhere, of this attempt's weights, after so many
        iterations; see `took` for its best iterate, whose seed is left out."""
        self.iteration, self.mark, self.stuck = iteration, mark, stuck
        self.best = replace(best, seed=self.config.seed + self.attempt)

    def _restart(self) -> None:
        """Keep the best weights, and restart from the next seed, or end after the third restart."""
        self._keep()
        if self.attempt == _RESTARTS:
            self.stuck = True
        else:
            self._begin(self.attempt + 1)

    def _keep(self) -> None:
        """Keep the attempt's best weights if they are the best of all attempts."""
        if self.best is not None and (self._kept is None or self.best.loss < self._kept.loss):
            self._kept = self.best

    def finished(self) -> bool:
        """Return whether the iterations or the patience are used up, or no lower loss is found."""
        since = self.iteration - self.mark.iteration
        return (
            self.iteration >= self.config.iterations or since >= self.config.patience or self.stuck
        )

    def progress(self) -> float:
        return self.iteration / self.config.iterations

    def status(self) -> str:
        parts = zip(_TERMS, self._terms(self.theta).tolist(), strict=True)
        text = " ".join(f"{name} {value:.2e}" for name, value in parts)
        best = f"{self.best.loss:.2e}" if self.best else "none"
        return f"{text} best {best}"

    def curves(self) -> Mapping[str, float]:
        terms = self._terms(self.theta)
        curves = {f"loss/{name}": float(term) for name, term in zip(_TERMS, terms, strict=True)}
        curves["loss/total"] = self._total(terms)
        if self.best is not None:
            curves["loss/best"] = self.best.loss
        if (loss := self.recipe.held_out(self.theta)) is not None:
            curves["loss/held_out"] = loss
        return curves

    def _terms(self, theta: np.ndarray) -> np.ndarray:
        """Return the three unweighted terms of the loss (3,) at weights theta (n,), in the system's
        units."""
        return self.recipe.objective.terms(theta)

    def _total(self, terms: np.ndarray) -> float:
        """Return the paper's loss from its terms (3,)."""
        return float(terms @ [self.config.w0, self.config.w_ode, self.config.w_y])

    def state(self) -> dict[str, Any]:
        # The attempt replaces the state of the random generator: nothing is drawn after the initial
        # weights. Right after a restart there are no best weights and no minimiser.
        return {
            "attempt": self.attempt,
            "stuck": self.stuck,
            "mark": asdict(self.mark),
            "best": None if self.best is None else asdict(self.best),
            "kept": None if self._kept is None else asdict(self._kept),
            "method": None if self.best is None else self._method_state(),
        }

    def _method_state(self) -> dict[str, Any]:
        assert self._method is not None
        return self.recipe.method_state(self._method)

    def load_state(self, state: Mapping[str, Any]) -> None:
        self._begin(state["attempt"])
        self.mark, self.stuck = Mark(**state["mark"]), state["stuck"]
        if state["kept"] is not None:
            self._kept = BestIterate(**state["kept"])
        if state["best"] is not None:
            self.best = BestIterate(**state["best"])
            best = self.best.theta, self.best.loss
            self._method = self.recipe.load_method(state["method"], best)

    def result(self) -> TrainedNetwork:
        """Return the network with the least loss of all attempts.

        Raises:
            FloatingPointError: in one line, if no loss was finite.
        """
        self._keep()
        best = self._kept
        if best is None:
            advice = "; try a lower learning_rate" if self.config.optimiser == "adam" else ""
            raise FloatingPointError(
                f"the loss of PINN-Obs on {type(self.system).__name__} left the finite numbers from"
                f" seed {self.config.seed} and the {self.attempt} after it{advice}"
            )
        trained = TrainedNetwork(
            **self.facts(loss=self._total(self._terms(best.theta)), seed=best.seed),
            architecture=self.recipe.architecture,
            layers=unflattened(self.recipe.architecture, best.theta),
            t=self.record.t.copy(),
            y=self.record.y[0].copy(),
            covariance=self.recipe.covariance(best.theta),
            recipe=self.config.recipe,
            knows=self.config.knows,
        )
        return replace(self.recipe.completed(trained), seconds=self.seconds)

    def figures(self, trained: TrainedNetwork) -> dict[str, Figure]:
        return figures(self.system, trained)

    @classmethod
    def train_rows(
        cls,
        system: System,
        config: PinnObsConfig,
        *,
        record: Record,
        noise_std: Level | None = None,
        process_noise: Level | None = None,
        folder: Path | None = None,
    ) -> list[TrainedNetwork]:
        """Train one network per row of a record, each row being one episode.

        On a GPU, and without a folder, the fast recipe trains all rows at once. Each row ends by
        its own patience or iterations, or by the budget, which then counts the CPU seconds of all
        rows; see `PinnObsConfig.device`. Otherwise the rows are trained one after another, as by
        `train`, which is fastest on a CPU. After Ctrl-C every row returns its best weights so far,
        after at least one iteration.

        Args:
            system: the model.
            config: the settings; every row has their seed.
            record: the samples of all episodes.
            noise_std: see `Trainer`.
            process_noise: see `Trainer`.
            folder: folder in which each row gets a folder ``row-<i>`` with its log, checkpoint and
                trained network; nothing is written if None.
        """
        rows = [record.rows(slice(i, i + 1)) for i in range(record.batch)]
        for row in rows:
            _check(system, row, config)
        device = _device(config)

        def new_trainer(row: Record, recipe: FastRecipe | None = None) -> PinnObsTrainer:
            noise = {"noise_std": noise_std, "process_noise": process_noise}
            return cls(system, config, record=row, **noise, recipe=recipe)

        with deferred_interrupt() as interrupt:
            if folder is None and device != "cpu" and config.optimiser == "ssbroyden":
                noise = system.noise(noise_std, process_noise)
                recipes = FastRecipe.many(system, config, rows, noise)
                trainers = [new_trainer(*pair) for pair in zip(rows, recipes, strict=True)]
                advance(trainers, device, interrupt)
                return [trainer.result() for trainer in trainers]
            if folder is None:
                return [train(new_trainer(row)) for row in rows]
            networks = []
            for i, row in enumerate(rows):
                row_folder = folder / f"row-{i}"
                with Log(row_folder) as log:
                    trained = train(
                        new_trainer(row), log=log, checkpoint=row_folder / "checkpoint.pt"
                    )
                trained.save(row_folder / "trained.pt")
                networks.append(trained)
        return networks


def _device(config: PinnObsConfig) -> str:
    """Return the torch device of a config.

    Raises:
        ValueError: in one line, if it is a GPU and torch finds none.
    """
    present = torch.cuda.is_available()
    if config.device == "cuda" and not present:
        raise ValueError("device='cuda'; torch finds no GPU here")
    return "cuda" if present and config.device != "cpu" else "cpu"


def _check(system: System, record: Record, config: PinnObsConfig) -> None:
    """Check that a record can be used for training.

    Raises:
        ValueError: in one line, with the value found and the value expected.
    """
    name = type(system).__name__
    if (np.diff(record.t.astype(config.dtype)) <= 0).any():
        raise ValueError(
            f"sample times from t={record.t[0]} s on are the same in {config.dtype}; subtract the"
            " first, or use dtype float64"
        )
    if record.batch != 1:
        raise ValueError(f"the record holds {record.batch} episodes; PINN-Obs is trained on one")
    if record.num_samples < MIN_SAMPLES:
        raise ValueError(
            f"the record has {record.num_samples} samples; PINN-Obs needs {MIN_SAMPLES} or more"
        )
    record.check_fits(system)
    checked(record.prior)
    y = record.y[0]
    present = [column[~np.isnan(column)] for column in y.T]
    if not any(len(column) and np.ptp(column) > 0 for column in present):
        raise ValueError(f"y of {name} does not vary over the record; there is nothing to learn")
