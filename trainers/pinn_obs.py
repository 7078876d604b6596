"""PINN-Obs as its paper trains it: a network and a gain for one record.

Farkane, Boutayeb, Oudani & Ghogho, "PINN-Obs: Physics-Informed Neural Network-Based Observer for
Nonlinear Dynamical Systems". Equation numbers are the paper's.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from torch import Tensor

from pinnobs_gym.estimator import OfflineEstimator
from pinnobs_gym.estimators.pinn_obs import Trained, check_same, identity, read, write
from pinnobs_gym.figures import state_figure
from pinnobs_gym.log import SILENT, Log
from pinnobs_gym.network import Activation, Architecture, Network, Precision
from pinnobs_gym.record import Record
from pinnobs_gym.system import System

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MIN_SAMPLES = 10
"""The shortest record that is trained on."""
_RESTARTS = 3
_FREE = ("iterations", "budget", "checkpoint_every", "log_every")
"""Settings that may change when training is resumed: they decide nothing but when it ends."""


@dataclass(frozen=True)
class Config:
    """The recipe of PINN-Obs; the defaults are those of the paper's "Ablation studies"."""

    depth: int = 9
    """Number of hidden layers."""
    width: int = 20
    """Neurons in each hidden layer."""
    activation: Activation = "tanh"
    """Activation of the hidden layers."""
    w0: float = 1.0
    """Weight of the initial estimate in the loss."""
    w_ode: float = 1.0
    """Weight of the observer's equation in the loss."""
    w_y: float = 1.0
    """Weight of the outputs in the loss."""
    learning_rate: float = 1e-3
    """Step of the optimiser; constant."""
    optimiser: Literal["adam"] = "adam"
    """Method that minimises the loss, on all training samples at once."""
    iterations: int = 200_000
    """Most iterations."""
    patience: int = 20_000
    """Iterations without a lower training loss after which training stops."""
    train_fraction: float = 0.6
    """Part of the samples that is trained on; the others only measure the held-out loss."""
    dtype: Precision = "float32"
    """Precision; that of torch unless told otherwise."""
    seed: int = 0
    """What the initial weights and the training samples are drawn from."""
    budget: float | None = None
    """CPU seconds after which training stops, those before a resumption included."""
    checkpoint_every: int = 1000
    """Iterations from one checkpoint to the next."""
    log_every: int = 100
    """Iterations from one point of the logged curves to the next."""

    def __post_init__(self) -> None:
        Architecture(1, 1, self.depth, self.width, self.activation, self.dtype)
        for name in ("iterations", "patience", "checkpoint_every", "log_every"):
            _expect(self, name, "a whole number of at least 1", lambda v: v == int(v) and v >= 1)
        _expect(self, "seed", "a whole number of at least 0", lambda v: v == int(v) and v >= 0)
        for name in ("w0", "w_ode", "w_y"):
            _expect(self, name, "a number of at least 0", lambda v: 0 <= v < math.inf)
        _expect(self, "learning_rate", "a positive number", lambda v: 0 < v < math.inf)
        _expect(self, "train_fraction", "a number over 0 and at most 1", lambda v: 0 < v <= 1)
        _expect(self, "optimiser", "adam", lambda v: v == "adam")
        _expect(self, "budget", "None or positive seconds", lambda v: v is None or v > 0)


def _expect(config: Config, name: str, expected: str, fits: Callable[[Any], bool]) -> None:
    value = getattr(config, name)
    try:
        good = fits(value)
    except (TypeError, ValueError, OverflowError):
        good = False
    if not good:
        raise ValueError(f"{name}={value!r}; expected {expected}")


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples of a record, as the loss takes them."""

    t: Tensor
    """Times in s, shape (1 + num_samples,): first t₀, then those of the samples."""
    xhat0: Tensor
    """Initial estimate at t₀, shape (nx,)."""
    u: Tensor
    """Inputs, shape (num_samples, nu)."""
    y: Tensor
    """Outputs, shape (num_samples, ny); zero where they are missing."""
    missing: Tensor | None
    """Which outputs are missing, shape (num_samples, ny); None if none is."""

    @staticmethod
    def of(system: System, record: Record, chosen: np.ndarray, dtype: torch.dtype) -> Samples:
        """The chosen samples (num_samples,) of a record of one episode."""
        t, y = record.t[chosen], record.y[0, chosen]
        u = record.u[0, chosen] if system.measured_input else np.asarray(system.input(t))
        missing = np.isnan(y)
        return Samples(
            torch.as_tensor(np.append(record.t[0], t), dtype=dtype),
            torch.as_tensor(record.prior.mean[0], dtype=dtype),
            torch.as_tensor(u, dtype=dtype),
            torch.as_tensor(np.where(missing, 0.0, y), dtype=dtype),
            torch.as_tensor(missing) if missing.any() else None,
        )


def loss_terms(network: Network, system: System, samples: Samples) -> Tensor:
    """The three terms of the loss, (3,), without their weights.

    - MSE₀ = ‖x̂(t₀) − x̂₀‖². Equation (7) writes the norm without the square. The square is taken
      because the paper names it a mean squared error, and because a bare norm has a gradient of
      length one however small the error, so that a constant step never settles on x̂₀.
    - MSE_g = mean ‖dx̂/dt − f(t, x̂, u) − L(t)(y − h(x̂))‖², equations (e55) and (8), with h(x̂) for
      the paper's Cx̂.
    - MSE_y = mean ‖h(x̂) − y‖², equation (9).

    Norms are summed over components, in the system's own units. A missing output counts as a zero
    innovation, and MSE_y is the mean over those that are there, times ny.
    """
    xhat, L, rate = network.with_rate(samples.t)
    initial = xhat[0] - samples.xhat0
    xhat, L, rate = xhat[1:], L[1:], rate[1:]
    innovation = samples.y - system.h(xhat)
    there = float(len(innovation))
    if samples.missing is not None:
        innovation = torch.where(samples.missing, 0.0, innovation)
        there = max(float((~samples.missing).sum()) / samples.y.shape[1], 1e-9)
    correction = (L * innovation[:, None, :]).sum(-1)
    residual = rate - system.f(samples.t[1:], xhat, samples.u) - correction
    return torch.stack(
        [
            (initial * initial).sum(),
            (residual * residual).sum() / len(residual),
            (innovation * innovation).sum() / there,
        ]
    )


@dataclass(frozen=True, eq=False)
class _Best:
    """The weights of the least loss so far."""

    loss: float
    iteration: int
    """The iteration that found it, counted from 1."""
    weights: dict[str, Tensor]


class _Run:
    """A training in progress: all that changes from one iteration to the next."""

    def __init__(self, system: System, config: Config, record: Record) -> None:
        self.config, self.system, self.record = config, system, record
        sizes = (system.nx, system.ny, config.depth, config.width)
        self.architecture = Architecture(*sizes, config.activation, config.dtype)
        self.iteration, self._earlier, self._start = 0, 0.0, time.process_time()
        self._begin(attempt=0)

    def _begin(self, attempt: int) -> None:
        self.attempt = attempt
        generator = torch.Generator().manual_seed(self.seed)
        self.network = Network(self.architecture, generator)
        rate = self.config.learning_rate
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=rate, fused=True)
        self.weights = torch.tensor([self.config.w0, self.config.w_ode, self.config.w_y])
        self.weights = self.weights.to(self.architecture.torch_dtype)
        self.best: _Best | None = None
        self._begun = self.iteration

    @property
    def seed(self) -> int:
        """What the present weights began from."""
        return self.config.seed + self.attempt

    @property
    def seconds(self) -> float:
        """CPU seconds so far."""
        return self._earlier + time.process_time() - self._start

    def step(self, samples: Samples) -> Tensor:
        """One iteration; returns the terms of the loss before it."""
        terms = loss_terms(self.network, self.system, samples)
        loss = (self.weights * terms).sum()
        value = loss.item()
        self.iteration += 1
        if not math.isfinite(value):
            self._restart()
            return terms.detach()
        if self.best is None or value < self.best.loss:
            weights = {k: v.clone() for k, v in self.network.state_dict().items()}
            self.best = _Best(value, self.iteration, weights)  # at once: Ctrl-C finds it whole
        self.optimiser.zero_grad()
        loss.backward()
        self.optimiser.step()
        return terms.detach()

    def _restart(self) -> None:
        if self.attempt == _RESTARTS:
            name = type(self.system).__name__
            raise FloatingPointError(
                f"the loss of PINN-Obs on {name} left the finite numbers from seed"
                f" {self.config.seed} and the {_RESTARTS} after it; try a lower learning_rate"
            )
        self._begin(self.attempt + 1)

    def finished(self) -> bool:
        """Whether the iterations, the patience or the CPU time are used up."""
        config, best = self.config, self.best
        since = self.iteration - (self._begun if best is None else best.iteration)
        spent = config.budget is not None and self.iteration > 0 and self.seconds >= config.budget
        return self.iteration >= config.iterations or since >= config.patience or spent

    def result(self) -> Trained:
        """The network of the least loss."""
        assert self.best is not None
        network = Network(self.architecture)
        network.load_state_dict(self.best.weights)
        about = identity(self.system)
        return Trained(
            network=network,
            t=self.record.t.copy(),
            y=self.record.y[0].copy(),
            system=about["system"],
            parameters=about["parameters"],
            config=asdict(self.config),
            seed=self.seed,
            loss=self.best.loss,
            iterations=self.iteration,
            seconds=self.seconds,
        )

    def save(self, path: Path) -> None:
        """Write all that `restore` needs to go on exactly.

        The seed of the attempt stands for the state of chance: nothing is drawn after the weights.
        """
        assert self.best is not None
        facts = {**self._expected(), "iteration": self.iteration, "seconds": self.seconds}
        facts |= {"attempt": self.attempt, "begun": self._begun}
        facts |= {"best_loss": self.best.loss, "best_iteration": self.best.iteration}
        tensors = {
            "network": self.network.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "best": self.best.weights,
            "record": {k: torch.tensor(v) for k, v in self._record().items()},
        }
        write(path, {"facts": json.dumps(facts), **tensors})

    def restore(self, path: Path) -> None:
        """Take up the training of a checkpoint.

        Raises:
            ValueError: in one line, if it cannot be read or belongs to another training.
        """
        saved = read(path)
        try:
            facts = json.loads(saved["facts"])
            check_same(path, facts, self._expected())
            for name, value in self._record().items():
                if not np.array_equal(saved["record"][name].numpy(), value, equal_nan=True):
                    raise ValueError(f"{path} was trained on another record: its {name} differs")
            self._begin(facts["attempt"])
            self.network.load_state_dict(saved["network"])
            self.optimiser.load_state_dict(saved["optimiser"])
            self.best = _Best(facts["best_loss"], facts["best_iteration"], saved["best"])
            self.iteration, self._begun = facts["iteration"], facts["begun"]
            self._earlier += facts["seconds"]
        except (KeyError, TypeError, AttributeError, RuntimeError) as error:
            reason = str(error).splitlines()[0]
            raise ValueError(f"{path} is not a checkpoint of this trainer: {reason}") from None

    def _expected(self) -> dict[str, Any]:
        config = {k: v for k, v in asdict(self.config).items() if k not in _FREE}
        return {**identity(self.system), "config": config}

    def _record(self) -> dict[str, np.ndarray]:
        record = self.record
        return {"t": record.t, "y": record.y, "u": record.u, "xhat0": record.prior.mean}


def train(
    system: System,
    config: Config,
    *,
    record: Record,
    log: Log = SILENT,
    checkpoint: Path | None = None,
    resume: bool = False,
    progress: bool = False,
) -> Trained:
    """Train PINN-Obs on the record of one episode.

    Full batch, by Adam; the weights of the least training loss are kept. Ctrl-C ends it early and
    keeps them as well. If the loss leaves the finite numbers, it begins again from the next seed,
    three times at most. On a CPU the same seed gives the same weights.

    Args:
        system: the model.
        config: the recipe.
        record: the samples of one episode and the initial estimate; NaN is a missing output.
        log: where curves and figures go.
        checkpoint: a file to keep the training's state in, written again as it goes on.
        resume: go on from that file, exactly.
        progress: show a bar with the terms of the loss in the terminal.

    Raises:
        ValueError: in one line, if the record cannot be trained on, or the checkpoint is missing,
            damaged, or of another system, record or config (`Config` may differ in ``iterations``,
            ``budget``, ``checkpoint_every`` and ``log_every``).
        FloatingPointError: if the loss does not stay finite from any of four seeds.
    """
    _check(system, record)
    if resume and checkpoint is None:
        raise ValueError("resume=True without a checkpoint; name its file")
    run = _Run(system, config, record)
    if resume and checkpoint is not None:
        run.restore(checkpoint)
    samples, held_out = _split(system, config, record)
    try:
        with _bar(config.iterations if progress else None) as show:
            while not run.finished():
                if run.iteration % config.log_every == 0:
                    _log_held_out(log, run, held_out)
                terms = run.step(samples)
                if (run.iteration - 1) % config.log_every == 0:
                    _log_terms(log, run, terms)
                    show(run, terms)
                if checkpoint is not None and run.iteration % config.checkpoint_every == 0:
                    run.save(checkpoint)
        if checkpoint is not None and run.best is not None:
            run.save(checkpoint)
    except KeyboardInterrupt:  # it may come amid a step: the last checkpoint stays as it is
        if run.best is None:
            raise
    trained = run.result()
    _log_end(log, system, trained, run)
    return trained


def _check(system: System, record: Record) -> None:
    """Whether the record can be trained on."""
    name = type(system).__name__
    if record.batch != 1:
        raise ValueError(f"the record holds {record.batch} episodes; PINN-Obs is trained on one")
    if record.num_samples < MIN_SAMPLES:
        raise ValueError(
            f"the record has {record.num_samples} samples; PINN-Obs needs {MIN_SAMPLES} or more"
        )
    sizes = (("y", record.y, system.ny), ("u", record.u, system.nu))
    for symbol, array, size in (*sizes, ("xhat0", record.prior.mean, system.nx)):
        if array.shape[-1] != size:
            raise ValueError(f"{symbol} has {array.shape[-1]} columns; {name} has n={size}")
    y = record.y[0]
    if np.isinf(y).any():
        raise ValueError(
            f"y holds infinite numbers; {name} needs finite ones, or NaN where missing"
        )
    there = [column[~np.isnan(column)] for column in y.T]
    if not any(len(column) and np.ptp(column) > 0 for column in there):
        raise ValueError(f"y of {name} does not vary over the record; there is nothing to learn")


def _split(system: System, config: Config, record: Record) -> tuple[Samples, Samples | None]:
    """A random part of the samples in the order of time, and those left."""
    count = max(1, round(config.train_fraction * record.num_samples))
    order = np.random.default_rng(config.seed).permutation(record.num_samples)
    dtype = Architecture(system.nx, system.ny, dtype=config.dtype).torch_dtype
    chosen, left = np.sort(order[:count]), np.sort(order[count:])
    samples = Samples.of(system, record, chosen, dtype)
    return samples, Samples.of(system, record, left, dtype) if len(left) else None


_TERMS = ("initial", "equation", "output")


def _log_terms(log: Log, run: _Run, terms: Tensor) -> None:
    log.scalar("loss/total", float((run.weights * terms).sum()), run.iteration)
    for name, term in zip(_TERMS, terms.tolist(), strict=True):
        log.scalar(f"loss/{name}", term, run.iteration)
    if run.best is not None:
        log.scalar("loss/best", run.best.loss, run.iteration)


def _held_out_loss(network: Network, run: _Run, held_out: Samples) -> float:
    with torch.no_grad():
        return float((run.weights * loss_terms(network, run.system, held_out)).sum())


def _log_held_out(log: Log, run: _Run, held_out: Samples | None) -> None:
    if held_out is not None and log.active:
        log.scalar("loss/held_out", _held_out_loss(run.network, run, held_out), run.iteration + 1)


def _log_end(log: Log, system: System, trained: Trained, run: _Run) -> None:
    """Figures of what came out, and the row of the HPARAMS table."""
    if not log.active:
        return
    title = f"PINN-Obs on {trained.system}, loss {trained.loss:.3g}"
    states = state_figure(system, trained.t, trained.xhat(trained.t), y=trained.y, title=title)
    log.figure("states", states, run.iteration)
    log.figure("gain", gain_figure(trained.t, trained.gain(trained.t)), run.iteration)
    metrics = {"end/loss": trained.loss, "end/iterations": float(trained.iterations)}
    log.hparams({"system": trained.system, **trained.config}, metrics)


def gain_figure(t: np.ndarray, L: np.ndarray) -> Figure:
    """A picture of gains L (num_samples, nx, ny) over times t (num_samples,) in s: a panel per
    state, a line per output."""
    from matplotlib.figure import Figure

    nx, ny = L.shape[1:]
    figure = Figure(figsize=(8, 1.0 + 1.6 * nx), layout="constrained")
    panels = figure.subplots(nx, 1, sharex=True, squeeze=False)[:, 0]
    for i, panel in enumerate(panels):
        for j in range(ny):
            panel.plot(t, L[:, i, j], lw=1.2, label=f"L{i + 1}{j + 1}")
        panel.legend(loc="upper right", fontsize=8)
        panel.grid(alpha=0.3)
    panels[-1].set_xlabel("t (s)")
    return figure


@contextmanager
def _bar(total: int | None) -> Iterator[Callable[[_Run, Tensor], None]]:
    """A progress bar in the terminal, as a function that renews it; nothing without a total."""
    if total is None:
        yield lambda run, terms: None
        return
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.completed}/{task.total}"),
        BarColumn(bar_width=20),
        TextColumn("{task.description}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns) as bar:
        task = bar.add_task("", total=total)

        def show(run: _Run, terms: Tensor) -> None:
            parts = zip(_TERMS, terms.tolist(), strict=True)
            text = " ".join(f"{name} {value:.2e}" for name, value in parts)
            best = f"{run.best.loss:.2e}" if run.best else "none"
            bar.update(task, completed=run.iteration, description=f"{text} best {best}")

        yield show


@dataclass(frozen=True)
class PinnObs(OfflineEstimator):
    """PINN-Obs trained anew on every record it is given, and its network's x̂(t)."""

    config: Config = field(default_factory=Config)
    """The recipe; its seed is that of every row."""
    folder: Path | None = field(default=None, repr=False)
    """Where a folder ``row-<i>`` per row goes, with its log, checkpoint and trained network; None
    keeps nothing."""

    name = "pinn_obs"
    knows = ("model", "prior")
    trains_on_record = "pinn_obs"

    @property
    def training(self) -> dict[str, Any]:
        facts = {"trainer": "pinn_obs", "seed": self.config.seed, "per_record": True}
        return {**facts, "config": asdict(self.config)}

    def fit(self, record: Record) -> list[Trained]:
        """Train on each row of the record; see `train`."""
        return [self._fit_row(record, i) for i in range(record.batch)]

    def estimate(self, record: Record) -> np.ndarray:
        return np.stack([trained.xhat(record.t) for trained in self.fit(record)])

    def _fit_row(self, record: Record, i: int) -> Trained:
        row = record.rows(slice(i, i + 1))
        if self.folder is None:
            return train(self.system, self.config, record=row)
        folder = self.folder / f"row-{i}"
        with Log(folder) as log:
            checkpoint = folder / "checkpoint.pt"
            trained = train(self.system, self.config, record=row, log=log, checkpoint=checkpoint)
        trained.save(folder / "trained.pt")
        return trained
