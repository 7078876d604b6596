"""The command `pinnobs`."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar, get_args, get_type_hints

import numpy as np
import tyro
from rich import box
from rich.console import Console
from rich.markdown import Markdown
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table as RichTable
from threadpoolctl import threadpool_limits

from pinnobs_gym import acceptance, env_id, leaderboard, rows, suite
from pinnobs_gym.estimator import Estimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.evaluation import evaluate, make_vector_env, score_batch
from pinnobs_gym.figures import state_figure
from pinnobs_gym.log import Log
from pinnobs_gym.record import Prior, read_log
from pinnobs_gym.report import page, replacing, write_estimates, write_figure
from pinnobs_gym.systems import SYSTEMS

console = Console() if Console().is_terminal else Console(width=150)


@dataclass(frozen=True)
class Systems:
    """List the systems, or print the page of one."""

    name: Annotated[str | None, tyro.conf.Positional] = None
    """Name or module:Class of a system."""

    def run(self) -> int:
        """Print."""
        if self.name is not None:
            name = env_id(self.name)
            text = page(SYSTEMS.resolve(self.name), name)
            if console.is_terminal:
                console.print(Markdown(text))
            else:
                print(text)
            return 0
        table = RichTable("env id", "states", "measured", "inputs", "setups")
        for cls in SYSTEMS.classes().values():
            system = cls()
            states, outputs = ", ".join(cls.state_names), ", ".join(system.output_names)
            inputs = ", ".join(cls.input_names)
            table.add_row(env_id(cls), states, outputs, inputs, ", ".join(cls.setups))
        console.print(table)
        return 0


@dataclass(frozen=True)
class Estimators:
    """List the estimators, or print what one is."""

    name: Annotated[str | None, tyro.conf.Positional] = None
    """Name or module:Class of an estimator."""

    def run(self) -> int:
        """Print."""
        import inspect

        if self.name is not None:
            console.print(inspect.getdoc(ESTIMATORS.resolve(self.name)), markup=False)
            return 0
        table = RichTable("name", "track", "is told", "what it is")
        for name, cls in ESTIMATORS.classes().items():
            first = (inspect.getdoc(cls) or "").partition("\n\n")[0].replace("\n", " ")
            table.add_row(name, cls.track, ", ".join(cls.knows), first)
        console.print(table)
        return 0


@dataclass(frozen=True)
class Evaluate:
    """Score one estimator on one system, episode by episode."""

    system: str
    """Name or module:Class of the system."""
    estimator: str = "ekf"
    """Name or module:Class of the estimator."""
    checkpoint: Path | None = None
    """Trained estimator to load."""
    set: tuple[str, ...] = ()
    """Settings of the estimator, such as process_noise=1e-3."""
    setup: str = "benchmark"
    """Setup that is played."""
    condition: str = "nominal"
    """Condition, such as load_step, or noise5+dropout10."""
    episodes: int = 100
    """Number of episodes."""
    seed: int = 0
    """Seed of the first."""
    out: Path = Path("runs/evaluate")
    """Folder of rows and TensorBoard log."""

    def run(self) -> int:
        """Evaluate and print."""
        name = env_id(self.system)
        cls = ESTIMATORS.resolve(self.estimator)
        estimator: Estimator | type[Estimator] = cls
        options = parse_settings(cls, self.set)
        source = make_vector_env(name, 1, self.setup, self.condition).source
        if self.checkpoint is not None:
            estimator = suite.load(cls, self.checkpoint, source.system, source.setup)
        episodes = 1 if source.deterministic else self.episodes
        if episodes < self.episodes:
            console.print(f"every episode of setup {self.setup!r} is the same: 1 is run")
        folder = self.out / "tensorboard" / name.removeprefix("pinnobs/") / self.setup
        with Log(folder / self.condition / ESTIMATORS.name_of(cls)) as log, _progress() as bar:
            task = bar.add_task("episodes", total=episodes)
            scored = evaluate(
                estimator,
                name,
                episodes=episodes,
                seed=self.seed,
                setup=self.setup,
                condition=self.condition,
                options=options,
                results=self.out / "rows.jsonl",
                log=log,
                progress=lambda done: bar.advance(task, done),
            )
            bar.update(task, completed=episodes)
        for table in leaderboard.tables(scored):
            print_table(table)
        console.print(f"rows: {self.out / 'rows.jsonl'}; TensorBoard: {self.out / 'tensorboard'}")
        return 0


@dataclass(frozen=True)
class Leaderboard:
    """Run every estimator on every system and print the tables; what is already there is kept."""

    systems: tuple[str, ...] = ()
    """Names or module:Class of systems; all that are known if empty."""
    estimators: tuple[str, ...] = ()
    """Names or module:Class of estimators; all that are known if empty."""
    setup: str = "benchmark"
    """Setup that is played."""
    condition: str | None = None
    """Condition; nominal, and the one that a system is ranked under, if none is given."""
    episodes: int = 100
    """Episodes of each estimator and system."""
    trained_episodes: int = 5
    """Episodes of those that train on every record."""
    budget: float = 45.0
    """CPU seconds of each training."""
    seed: int = 0
    """Seed of the first episode."""
    jobs: int = 2
    """Processes at a time, one thread each."""
    out: Path = Path("runs/leaderboard")
    """Folder of rows, tables, TensorBoard log and trained files."""

    def run(self) -> int:
        """Run what is missing, then print and write the tables."""
        for name, least in (("jobs", 1), ("episodes", 1), ("trained_episodes", 1), ("seed", 0)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}={getattr(self, name)}; expected at least {least}")
        if not self.budget > 0:
            raise ValueError(f"budget={self.budget}; expected a positive number of seconds")
        check_writable(self.out)
        rows.read(self.out / "rows.jsonl")  # a damaged file is refused before anything is run
        jobs = suite.jobs_of(
            self.systems or tuple(SYSTEMS.classes()),
            self.estimators or default_estimators(),
            setup=self.setup,
            condition=self.condition,
            episodes=self.episodes,
            trained_episodes=self.trained_episodes,
            seed=self.seed,
            folder=self.out,
            training={"budget": self.budget},
        )
        failures = []
        with _progress() as bar:
            task = bar.add_task("jobs", total=len(jobs))
            for job, failure in suite.run_jobs(jobs, self.jobs):
                bar.advance(task)
                if failure is not None:
                    failures.append(f"failed: {job.name}: {failure}")
                    bar.console.print(failures[-1], markup=False)
        scored = rows.read(self.out / "rows.jsonl")
        suite.log_summaries(self.out, scored)
        tables = leaderboard.tables(scored)
        for table in tables:
            print_table(table)
        console.print(leaderboard.NOTE)
        path = self.out / "leaderboard.md"
        with replacing(path) as temporary:
            temporary.write_text(leaderboard.markdown(tables), encoding="utf-8")
        for what, where in (
            ("tables", path),
            ("rows", self.out / "rows.jsonl"),
            ("TensorBoard", self.out / "tensorboard"),
            ("trained files", self.out / "trained"),
        ):
            if where.exists():
                console.print(f"{what + ':':14} {where}", soft_wrap=True)
        return 1 if failures else 0


@dataclass(frozen=True)
class Estimate:
    """Estimate the states behind a sensor log: a CSV file with columns t, y1, ... and u1, ..."""

    system: str
    """Name or module:Class of the model."""
    log: Path
    """The CSV file; sample times may be irregular, empty cells are missing outputs."""
    estimator: str = "ekf"
    """Name or module:Class of the estimator."""
    set: tuple[str, ...] = ()
    """Settings of the estimator, such as process_noise=1e-3."""
    xhat0: tuple[float, ...] | None = None
    """Initial estimate; the benchmark's if not given."""
    P0_std: tuple[float, ...] | None = None
    """Its standard deviations; the benchmark's if not given."""
    noise_std: tuple[float, ...] | None = None
    """Standard deviations of the output noise; the benchmark's if not given."""
    out: Path = Path("estimates.csv")
    """Where the estimates go; a picture of the same name and the ending .png lies beside it."""

    def run(self) -> int:
        """Estimate and write."""
        env_id(self.system)  # checks and registers a system of the user's
        cls = SYSTEMS.resolve(self.system)
        system, setup = cls.configured(noise_std=self.noise_std)
        given = {"xhat0": self.xhat0, "P0_std": self.P0_std}
        setup = replace(setup, **{name: value for name, value in given.items() if value})
        prior = Prior.of(system, setup, 1)
        system, record = read_log(self.log, system, prior)
        kind = ESTIMATORS.resolve(self.estimator)
        if kind.needs_training is not None:
            raise ValueError(
                f"estimator {self.estimator!r} is trained beforehand; for a log take one that is "
                f"not, or trains on the record"
            )
        picture = self.out.with_suffix(".png")
        if picture == self.out or self.log.resolve() in (self.out.resolve(), picture.resolve()):
            raise ValueError(f"out={self.out} would overwrite the log or the picture; name a .csv")
        check_writable(self.out.parent)
        estimator = kind.for_setup(system, setup, **parse_settings(kind, self.set))
        estimates = estimator.run(record)
        if not np.isfinite(estimates.xhat).all():
            console.print("warning: the estimates leave the finite numbers", style="yellow")
        write_estimates(self.out, system, record, estimates)
        P = None if estimates.P is None else estimates.P[0]
        title = f"{self.log.name}: {type(system).__name__}, {estimator.label}"
        figure = state_figure(system, record.t, estimates.xhat[0], y=record.y[0], P=P, title=title)
        write_figure(picture, figure)
        last = ", ".join(
            f"{name} = {value:.6g}"
            for name, value in zip(system.state_names, estimates.xhat[0, -1], strict=True)
        )
        console.print(f"{record.num_samples} samples; at t = {record.t[-1]:g} s: {last}")
        console.print(f"estimates: {self.out}; picture: {picture}", soft_wrap=True)
        return 0


ConfigType = TypeVar("ConfigType")


@dataclass(frozen=True)
class Train(Generic[ConfigType]):
    """Train an estimator on episodes of a system, as many as its recipe says."""

    system: str
    """Name or module:Class of the system."""
    config: ConfigType
    """The trainer's choices."""
    setup: str = "benchmark"
    """Setup that is played."""
    condition: str = "nominal"
    """Condition, such as load_step."""
    episode: int = suite.TRAINING_SEED
    """Seed of the episode that is learned from, or of the first of several."""
    out: Path = Path("runs/train")
    """Folder of checkpoints, trained files, pictures and TensorBoard log."""
    resume: bool = False
    """Go on from the checkpoint that is there."""


def train(name: str, arguments: Sequence[str]) -> int:
    """Train an estimator with the trainer of that name."""
    module = suite.trainer(name)
    chosen = _chosen_training(name, module.Config, arguments)
    check_writable(chosen.out)
    env = env_id(chosen.system)
    played = (env, chosen.setup, chosen.condition, chosen.episode)
    system, setup, record = suite.record_of(*played, chosen.config.episodes)
    title = f"{env.removeprefix('pinnobs/')}-{chosen.setup}-{chosen.condition}"
    stem = chosen.out / f"{title}-{name}-episode{chosen.episode}-seed{chosen.config.seed}"
    checkpoint = stem.with_name(stem.name + ".checkpoint.pt")
    path = stem.with_name(stem.name + ".pt")
    for earlier in (checkpoint, path):
        if earlier.exists() and not chosen.resume:
            raise ValueError(
                f"{earlier} is there already; --resume goes on with it, --out names another folder"
            )
    with Log(chosen.out / "tensorboard" / stem.name) as log:
        result = module.train(
            system,
            chosen.config,
            record=record,
            noise_std=setup.noise_std,
            log=log,
            checkpoint=checkpoint,
            resume=chosen.resume,
            progress=True,
        )
    result.save(path)
    console.print(
        f"loss {result.loss:.3g} after {result.iterations} iterations, {result.seconds:.1f} CPU s"
    )
    for label, cls in ESTIMATORS.classes().items():
        if cls.needs_training == name:
            estimator = suite.load(cls, path, system, setup)
            example = _report_training(label, estimator, played, result.loss)
            picture = stem.with_name(f"{stem.name}-{label}.png")
            write_figure(picture, state_figure(system, title=f"{label}: {title}", **example))
            console.print(f"picture: {picture}", soft_wrap=True)
    console.print(f"trained file: {path}", soft_wrap=True)
    if checkpoint.exists():
        console.print(f"checkpoint: {checkpoint} (go on with --resume)", soft_wrap=True)
    console.print(f"TensorBoard: {chosen.out / 'tensorboard'}", soft_wrap=True)
    return 0


def _chosen_training(name: str, config: type, arguments: Sequence[str]) -> Train[Any]:
    """The command line of a training; what a preset says is its default."""
    options: dict[str, Any] = {
        "prog": f"pinnobs train {name}",
        "args": arguments,
        "config": (tyro.conf.OmitArgPrefixes,),
    }
    make: Callable[[], Any] = config
    for option, value in pairwise(arguments):
        if option == "--preset":
            make = partial(config, preset=value)
    default = Train(system=tyro.MISSING, config=make())
    return tyro.cli(Train[type(default.config)], default=default, **options)


def _report_training(
    label: str, estimator: Estimator, played: tuple[str, str, str, int], loss: float
) -> dict[str, Any]:
    """Print how a trained estimator does; returns what `state_figure` draws of its own record."""
    if estimator.track == "online":
        found, example = acceptance.replays(estimator, *played)
    else:
        own, example = score_batch(estimator, *played[:-1], [played[-1]])
        found = [acceptance.Replay("own record", own[0])]
    for replay in found:
        row = replay.scores
        console.print(
            f"{label} on {replay.name}: RMSE {row['rmse']:.4g}, NRMSE {row['nrmse']:.4g}, "
            f"last 25 % {row['nrmse_tail']:.4g}",
            highlight=False,
        )
    if estimator.track == "online" and (told := acceptance.warning(loss, found[0].scores)):
        console.print(f"warning: {told}", style="yellow")
    return example


def default_estimators() -> tuple[str, ...]:
    """All that can be scored on episodes they have not seen."""
    return tuple(
        name
        for name, cls in ESTIMATORS.classes().items()
        if cls.needs_training is None or cls.track == "online"
    )


def parse_settings(cls: type[Estimator], settings: Sequence[str]) -> dict[str, Any]:
    """The values of ``name=value`` settings of an estimator, or of the recipe it trains by.

    Raises:
        ValueError: in one line, naming what is unknown and what is known.
    """
    base = {f.name for f in fields(Estimator)}
    own = {f.name: f for f in fields(cls) if f.name not in base and f.repr}
    makers = {name: f.default_factory for name, f in own.items()}
    recipes = {name: maker for name, maker in makers.items() if is_dataclass(maker)}
    hints = {n: h for n, h in get_type_hints(cls).items() if n in own and n not in recipes}
    nested = {
        name: (field_name, hint)
        for field_name, recipe in recipes.items()
        for name, hint in get_type_hints(recipe).items()
    }
    values: dict[str, Any] = {}
    for setting in settings:
        name, equals, text = setting.partition("=")
        if equals and name in hints:
            values[name] = _parsed(setting, text, hints[name])
        elif equals and name in nested:
            field_name, hint = nested[name]
            values.setdefault(field_name, {})[name] = _parsed(setting, text, hint)
        else:
            listed = ", ".join(sorted([*hints, *nested])) or "none"
            raise ValueError(f"setting {setting!r}; expected name=value with a name of: {listed}")
    for name, recipe in recipes.items():
        if name in values:
            make: Any = recipe
            values[name] = make(**values[name])
    return values


def _parsed(setting: str, text: str, hint: Any) -> Any:
    """The text as the number or string that a field is declared to hold."""
    kinds = get_args(hint) or (hint,)
    for kind in (int, float):
        if kind in kinds:
            try:
                return kind(text)
            except ValueError:
                expected = "a whole number" if kind is int else "a number"
                raise ValueError(f"setting {setting!r}; expected {expected}") from None
    return text


def check_writable(folder: Path) -> None:
    """Make a folder.

    Raises:
        ValueError: in one line, if nothing can be written there.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".write-{os.getpid()}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise ValueError(f"cannot write to folder {folder}: {error}") from None


def print_table(table: leaderboard.Table) -> None:
    """Print a leaderboard's table; a narrow terminal is spared the intervals."""
    wide = console.width >= 145
    shown = RichTable(title=table.title, title_justify="left", title_style="bold", box=box.SIMPLE)
    hidden = {"is told", "training"} | (set() if wide else {"90th pct.", "µs/step"})
    columns = [i for i, name in enumerate(leaderboard.HEADER) if name not in hidden]
    for i in columns:
        name = leaderboard.HEADER[i]
        text = name in ("estimator", "track")
        shown.add_column(name, justify="left" if text else "right", no_wrap=True)
    for line in leaderboard.cells(table, intervals=wide):
        shown.add_row(*(line[i] for i in columns))
    console.print(shown)
    for standing in table.standings:
        trained = f"; trained: {standing.training}" if standing.training else ""
        console.print(f"  {standing.estimator} is told: {standing.knows}{trained}")
    if table.note:
        console.print(f"  {table.note}", style="yellow")


def _progress() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
    )


COMMANDS: Mapping[str, Any] = {
    "systems": Systems,
    "estimators": Estimators,
    "train": train,
    "evaluate": Evaluate,
    "leaderboard": Leaderboard,
    "estimate": Estimate,
}
"""What the command can do."""

USAGE = """usage: pinnobs COMMAND ...

  systems [NAME]        list the systems, or print the page of one
  estimators [NAME]     list the estimators, or print what one is
  train TRAINER ...     train an estimator
  evaluate ...          score one estimator on one system
  leaderboard ...       run every estimator on every system
  estimate ...          estimate the states behind a sensor log

pinnobs COMMAND --help says more. A system or estimator of your own is given as module:Class.
With PINNOBS_TRACEBACK=1 in the environment an error shows where it came from."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status: 0, 1 if a job failed, 2 for bad input."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if not arguments or arguments[0] in ("-h", "--help"):
        print(USAGE)
        return 0 if arguments else 2
    _one_thread()
    sys.path.append(os.getcwd())  # so that module:Class finds the user's own files
    name, rest = arguments[0], list(arguments[1:])
    try:
        if name not in COMMANDS:
            raise ValueError(f"unknown command {name!r}; known are {', '.join(COMMANDS)}")
        if name == "train":
            return _train(rest)
        return tyro.cli(COMMANDS[name], prog=f"pinnobs {name}", args=rest).run()
    except (ValueError, TypeError, FloatingPointError) as error:
        if os.environ.get("PINNOBS_TRACEBACK"):
            raise
        print(f"pinnobs: error: {error}", file=sys.stderr)
        return 2
    except Exception as error:  # of a plug-in, or a fault of ours
        if os.environ.get("PINNOBS_TRACEBACK"):
            raise
        what = f"{type(error).__name__}: {' '.join(str(error).split())}"
        print(f"pinnobs: error: {what} (PINNOBS_TRACEBACK=1 shows where)", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("pinnobs: stopped; what was written is kept", file=sys.stderr)
        return 130


def _one_thread() -> None:
    """Run numerical libraries on one thread unless OMP_NUM_THREADS says otherwise: the arrays are
    so small that several threads mostly wait for each other."""
    if "OMP_NUM_THREADS" not in os.environ:
        os.environ["OMP_NUM_THREADS"] = "1"  # for what is loaded later, torch and workers among it
        threadpool_limits(1)


def _train(arguments: list[str]) -> int:
    if not arguments or arguments[0].startswith("-"):
        raise ValueError(f"name a trainer first: pinnobs train {' | '.join(suite.trainers())}")
    return train(arguments[0], arguments[1:])


if __name__ == "__main__":
    sys.exit(main())
