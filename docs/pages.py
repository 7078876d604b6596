"""The pages that are made from the code: one per system, estimator and trainer, the Python API, the
commands, the suites, and the tables.

Nothing here knows any of them by name: what discovery finds gets a page.
"""

from __future__ import annotations

import inspect
import re
import sys
import types
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from api import api_pages, in_markdown
from commands import commands_page
from moving import moving_picture
from published import scores_of_estimator, scores_on_system

from pinnobs_gym.cli.output import write_figure
from pinnobs_gym.cli.system_page import field_docs, page, variable_docs
from pinnobs_gym.envs.game import Game
from pinnobs_gym.envs.registration import env_id
from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.leaderboard import suites
from pinnobs_gym.leaderboard.grid import markdown_table
from pinnobs_gym.registry import TRAINERS
from pinnobs_gym.scoring import consistency, metrics, row_format
from pinnobs_gym.scoring.playing import Played, play
from pinnobs_gym.scoring.tuned_file import path_of, read
from pinnobs_gym.simulation.conditions import CONDITIONS
from pinnobs_gym.simulation.symbolic import Equations, aligned, latex, name_in_latex, rates, trace
from pinnobs_gym.simulation.system import System
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.training.trainer import Trainer

CHOICE = "When to choose it: "
"""How the paragraph of an estimator's docstring begins that says when to choose it."""


def write(folder: Path) -> None:
    """Write all of them below a folder; those of what is no longer there go."""
    made = pages()
    for path in folder.rglob("*.md"):
        if path.relative_to(folder).as_posix() not in made:
            path.unlink()
    for name, text in made.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
    for cls in SYSTEMS.classes().values():
        played, title = _episode(cls)
        place = folder / "systems" / cls.__name__
        write_figure(place.with_suffix(".png"), played.figure(title))
        place.with_suffix(".svg").write_text(moving_picture(played, title), encoding="utf-8")


def pages() -> dict[str, str]:
    """Their texts by file name."""
    systems, estimators = SYSTEMS.classes(), ESTIMATORS.classes()
    trainers = TRAINERS.classes()
    return {
        **{f"systems/{name}.md": system_page(cls) for name, cls in systems.items()},
        "systems/index.md": _systems(systems),
        **{f"estimators/{name}.md": estimator_page(name, cls) for name, cls in estimators.items()},
        "estimators/index.md": _estimators(estimators),
        **{f"trainers/{name}.md": trainer_page(name, m) for name, m in trainers.items()},
        "trainers/index.md": _trainers(trainers),
        **{f"api/{name}": page for name, page in api_pages().items()},
        "commands.md": commands_page(),
        "suites.md": _suites(),
        "conditions.md": _conditions(),
        "metrics.md": _metrics(),
        "row_schema.txt": variable_docs(row_format)["Row"] + "\n",
    }


def system_page(cls: type[System]) -> str:
    """What `pinnobs systems NAME` prints, with its equations as the code has them."""
    head, _, rest = page(cls, env_id(cls)).partition("\n## ")
    name, ekf = cls.__name__, "the [EKF](../estimators/ekf.md)"
    moving = f"![{name}: the EKF finds the state from the first guess on]({name}.svg)"
    told = f"Truth and estimate of {ekf}, from the first guess on:\n\n{moving}\n"
    whole = f"## An Episode\n\nWhole, with {ekf}:\n\n![EKF on {name}]({name}.png)\n"
    parts = [head, told, _equations(cls), whole, f"## {rest}", scores_on_system(cls)]
    return "\n".join(parts)


def _equations(cls: type[System]) -> str:
    try:
        found = trace(cls())
    except ValueError as error:
        return f"## Equations\n\nThose of the text above: {error}.\n"
    outputs = [name_in_latex(name) for name in cls().output_names]
    whole = [
        *zip(rates(found), found.f.flat(), strict=True),
        *zip(outputs, found.h.flat(), strict=True),
    ]
    parts = ["## Equations\n", "The code that is simulated, run on symbols, gives\n", _math(whole)]
    if found.definitions:
        parts += ["where\n", _math((latex(s), e) for s, e in found.definitions.items())]
    if found.u:
        parts += [
            "with the input\n",
            _math(zip(map(latex, found.u), found.input.flat(), strict=True)),
        ]
    parts += ["and linearised\n", _math(_jacobians(found)), _symbols(cls, found)]
    return "\n".join(parts)


def _jacobians(found: Equations) -> Sequence[tuple[str, Any]]:
    f, h = found.f_jacobian().applyfunc(lambda e: e.simplify()), found.h_jacobian()
    return [(r"\frac{\partial f}{\partial x}", f), (r"\frac{\partial h}{\partial x}", h)]


def _symbols(cls: type[System], found: Equations) -> str:
    """The parameters' symbols, values and meanings."""
    docs = field_docs(cls)
    lines = [
        (f"${latex(symbol)}$", f"`{name}`", f"{getattr(cls(), name):.6g}", _line(docs.get(name)))
        for name, symbol in found.parameters.items()
    ]
    return f"\n{markdown_table(('symbol', 'parameter', 'default', 'meaning'), lines)}\n" * bool(
        lines
    )


def _math(equations: Iterable[tuple[Any, Any]] | str) -> str:
    text = equations if isinstance(equations, str) else aligned(list(equations))
    return f"```{{math}}\n\\begin{{aligned}}\n{text.strip()}\n\\end{{aligned}}\n```\n"


def _episode(cls: type[System]) -> tuple[Played, str]:
    """Return an episode as the EKF has played it, and what to call it."""
    game = Game.of(cls, condition=cls.ranked_condition)
    ekf = EKF.for_setup(game.source.system, game.source.setup)
    return play(game, ekf, [0]), f"{cls.__name__}, {game.name.condition}: ekf"


def estimator_page(name: str, cls: type[BaseEstimator]) -> str:
    """What an estimator is, what it knows, its equations and settings."""
    trainer = cls.needs_training or cls.trains_on_record
    told = [
        ("track", _line(f"{cls.track}: {_TRACKS[cls.track]}")),
        ("knows", ", ".join(cls.knows)),
        ("training", f"[`{trainer}`](../trainers/{trainer}.md)" if trainer else "needs none"),
        ("class", f"`{cls.__module__}.{cls.__qualname__}`"),
    ]
    what, choice = split_choice(cls)
    parts = [f"# {name}\n", what, "\n", markdown_table(("", ""), told)]
    if choice:
        parts.append(f"\n## When to choose it\n\n{choice}\n")
    if cls.equations:
        parts += ["\n## Equations\n", _math(cls.equations), _notation(cls.equations)]
    base = {f.name for f in fields(BaseEstimator)}
    lines = _settings(cls, {f.name for f in fields(cls) if f.name not in base and f.repr})
    if lines:
        parts += [
            "\n## Settings\n",
            "On the command line `--set name=value`, a list with commas.\n",
        ]
        parts.append(markdown_table(("name", "default", "meaning"), lines))
    if cls.tunable:
        ranges = [(f"`{n}`", f"{r.low:g} to {r.high:g}") for n, r in cls.tunable.items()]
        parts += [f"\n`pinnobs tune {name}` searches:\n", markdown_table(("name", "range"), ranges)]
        parts += _tuned(name)
    parts.append(scores_of_estimator(name))
    return "\n".join(parts) + "\n"


def split_choice(cls: type[BaseEstimator]) -> tuple[str, str]:
    """Return an estimator's docstring without the paragraph that says when to choose it, and that
    paragraph; empty if there is none."""
    paragraphs = docstring(cls).split("\n\n")
    choices = [each for each in paragraphs if each.startswith(CHOICE)]
    what = "\n\n".join(each for each in paragraphs if each not in choices)
    choice = " ".join(choices).removeprefix(CHOICE)
    return what, choice[:1].upper() + choice[1:]


def _tuned(name: str) -> list[str]:
    """The tuned settings of an estimator that are stored with the systems of the package."""
    entries = [
        entry
        for system in SYSTEMS.sources
        for entry in read(path_of(SYSTEMS.resolve(system)))
        if entry.estimator == name
    ]
    if not entries:
        return []
    header = ("system", "setup", "settings", "default NRMSE", "tuned NRMSE")
    lines = [
        (
            entry.env_id.removeprefix("pinnobs/"),
            entry.setup,
            ", ".join(f"`{setting}={value}`" for setting, value in entry.settings.items()),
            f"{entry.default_error:.4g}",
            f"{entry.error:.4g}",
        )
        for entry in entries
    ]
    said = (
        "\nTuned settings (`pinnobs evaluate --tuned`), with the geometric mean NRMSE over both "
        "ranked windows and the episodes of the search, which are never scored:\n"
    )
    return [said, markdown_table(header, lines)]


_TRACKS = {"online": "x̂(k|k) from y₀..y_k", "offline": "sees the whole record first"}
_NOTATION = (
    (
        r"\\varphi",
        r"$\varphi$ is the flow of the model from the sample before ($\varphi_k$: from the first "
        "state of the record or window)",
    ),
    (r"\^-|\^\{-\}", "a raised minus marks what comes before $y_k$"),
    (r"(?<![A-Za-z])R(?![A-Za-z])", "$R$ is the covariance of the output noise"),
    (r"\\\|_|\\[bB]ig\w*\\\|_|\\\|\^2_", r"$\|v\|_M^2 = v^\top M v$"),
)
"""What signs in the equations of estimators stand for, each with what finds them."""


def _notation(equations: str) -> str:
    """Return a sentence about those of the signs that equations have."""
    found = [told for sign, told in _NOTATION if re.search(sign, equations)]
    return f"\nHere {'; '.join(found)}.\n" if found else ""


def _settings(cls: type, names: Iterable[str]) -> list[tuple[str, str, str]]:
    """Name, default and meaning of some fields of a dataclass."""
    docs, hints = field_docs(cls), get_type_hints(cls)
    return [
        (f"`{f.name}`", _default(f), _line(docs.get(f.name)) + _choices(hints[f.name]))
        for f in fields(cls)
        if f.name in names
    ]


def _default(field: Any) -> str:
    if field.default is not MISSING:
        return _shown(field.default)
    if field.default_factory is MISSING or "<" in field.default_factory.__name__:
        return ""
    return f"`{field.default_factory.__name__}()`"


def _shown(value: Any) -> str:
    return f"`{value}`" if not isinstance(value, float) else f"`{value:g}`"


def _choices(hint: Any) -> str:
    """What a field may be, if that is one of a few."""
    inner = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    found = [choice for kind in inner if get_origin(kind) is Literal for choice in get_args(kind)]
    return f" One of {', '.join(f'`{choice}`' for choice in found)}." if found else ""


def trainer_page(name: str, cls: type[Trainer[Any, Any]]) -> str:
    """A trainer's recipe: its Config's fields, preset by preset."""
    used = [
        f"[`{label}`](../estimators/{label}.md)"
        for label, estimator in ESTIMATORS.classes().items()
        if name in (estimator.needs_training, estimator.trains_on_record)
    ]
    made = {preset: cls.configured({"preset": preset}) for preset in cls.presets}
    config = type(next(iter(made.values())))
    first, *others = made
    lines = [
        (label, _shown(getattr(made[first], label.strip("`"))), meaning)
        for label, _, meaning in _settings(config, {f.name for f in fields(config)})
    ]
    changes = {name: _changes(made[first], made[name]) for name in others}
    call = f"```sh\npinnobs train {name} --system ReverseDuffing\n```\n"
    presets = [
        (f"`{preset}`", first_line(function), changes.get(preset, ""))
        for preset, function in cls.presets.items()
    ]
    about = ("name", "what it is", f"what it changes of `{first}`")
    return "\n".join(
        [
            f"# {name}\n",
            docstring(sys.modules[cls.__module__]),
            "",
            docstring(cls),
            f"\nMakes {', '.join(used)}.\n" if used else "",
            call,
            "## Presets\n",
            _without_empty(about, presets),
            "\n## Config\n",
            docstring(config),
            "",
            markdown_table(("name", f"in `{first}`", "meaning"), lines),
        ]
    )


def _changes(first: Any, other: Any) -> str:
    """Return the settings of a preset that are not those of the first."""
    pairs = [(f.name, getattr(other, f.name)) for f in fields(first)]
    return ", ".join(f"`{n}={_plain(v)}`" for n, v in pairs if v != getattr(first, n))


def _plain(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else f"{value}"


def _without_empty(header: Sequence[str], lines: Sequence[tuple[str, ...]]) -> str:
    """Return a table without the columns that are empty."""
    kept = [i for i in range(len(header)) if any(line[i] for line in lines)]
    return markdown_table([header[i] for i in kept], [[line[i] for i in kept] for line in lines])


def _systems(systems: Mapping[str, type[System]]) -> str:
    lines = [
        (f"[{name}]({name}.md)", f"`{env_id(cls)}`", *_sizes(cls()), first_line(cls))
        for name, cls in systems.items()
    ]
    header = ("system", "env id", "states", "measured", "inputs", "what it is")
    about = "The systems of the paper, each an env; `pinnobs systems NAME` prints its page."
    return _index("Systems", about, header, lines, systems)


def _sizes(system: System) -> tuple[str, str, str]:
    names = system.state_names, system.output_names, system.input_names
    states, outputs, inputs = (", ".join(part) for part in names)
    return states, outputs, inputs


def _estimators(estimators: Mapping[str, type[BaseEstimator]]) -> str:
    lines = [
        (f"[{name}]({name}.md)", cls.track, ", ".join(cls.knows), first_line(cls))
        for name, cls in estimators.items()
    ]
    about = (
        "What `--estimator` takes, and `evaluate` in Python. Each page says when to choose it; "
        "[one of your own](../../guides/add_estimator.md) is a class."
    )
    return _index("Estimators", about, ("name", "track", "knows", "what it is"), lines, estimators)


def _trainers(trainers: Mapping[str, type[Trainer[Any, Any]]]) -> str:
    lines = [
        (f"[{name}]({name}.md)", first_line(sys.modules[cls.__module__]))
        for name, cls in trainers.items()
    ]
    about = "What `pinnobs train NAME` runs; the estimators that need it load its files."
    return _index("Trainers", about, ("name", "what it is"), lines, trainers)


def _index(
    title: str,
    about: str,
    header: Sequence[str],
    lines: list[tuple[str, ...]],
    names: Iterable[str],
) -> str:
    tree = "\n".join(["```{toctree}", ":hidden:", "", *(f"{n} <{n}>" for n in names), "```"])
    return f"# {title}\n\n{about}\n\n{markdown_table(header, lines)}\n\n{tree}\n"


def _conditions() -> str:
    lines = [
        (f"`{name}`", c.summary, c.known_to_estimators, "yes" if c.reference else "no")
        for name, c in CONDITIONS.items()
    ]
    header = ("name", "what changes", "estimators are told", "Cramér–Rao reference")
    kinds = dict.fromkeys(type(c) for c in CONDITIONS.values())
    return "\n".join(
        [
            "# Conditions\n",
            "How episodes depart from their setup: `gym.make(id, condition=...)` and `--condition`;"
            " `a+b` combines two.\n",
            markdown_table(header, lines),
            *(f"\n## {kind.__name__}\n\n{docstring(kind)}" for kind in kinds),
            "",
        ]
    )


def _metrics() -> str:
    docs = variable_docs(metrics)
    limits = [
        (f"`{n}`", f"{getattr(metrics, n):g}", _line(docs[n])) for n in ("DIVERGED", "SETTLED")
    ]
    optional = ", ".join(f"`{name}`" for name in metrics.OPTIONAL_SCORES)
    errors = (inspect.getdoc(metrics.error_scores) or "").partition("Returns:\n")[2]
    return "\n".join(
        [
            "# Metrics\n",
            "What each scored episode has, in its row. "
            "[How scores are made](../guides/scores.md) says what tables make of it: windows, "
            "medians, intervals and ranks. Their µs/step are CPU time per sample and episode, in "
            "batches as they were run.\n",
            "## Errors\n",
            "Infinite where an estimate is not finite:\n",
            in_markdown(inspect.cleandoc(errors).partition("\n\n")[2]),
            "",
            markdown_table(("limit", "value", "meaning"), limits),
            "\n## Consistency\n",
            f"{optional} exist where the estimator gives covariances and innovations, and where "
            "there is a Cramér-Rao reference (`pinnobs_gym.scoring.cramer_rao`).\n",
            docstring(consistency.consistency),
            "",
        ]
    )


def _suites() -> str:
    """The keys of a suite's file, and the files that ship with the package."""
    shown = {
        name: (suites.FOLDER / f"{name}.toml").read_text(encoding="utf-8")
        for name in suites.names()
    }
    return "\n".join(
        [
            "# Suites\n",
            f"{docstring(suites)}\n",
            "Play one with `pinnobs leaderboard --suite NAME`, or `--suite mine.toml`. A key that "
            "is not known, or a value that does not fit, is an error in one line that names it.\n",
            "## Keys\n",
            markdown_table(("key", "default", "expected", "meaning"), _keys(suites.Suite)),
            "\n## Keys of an estimator's table\n",
            markdown_table(
                ("key", "default", "meaning"), _settings(suites.Entry, _names(suites.Entry))
            ),
            "\n## The suites of the package\n",
            *(f"`{name}`:\n\n```toml\n{text}```\n" for name, text in shown.items()),
        ]
    )


def _keys(cls: type) -> list[tuple[str, ...]]:
    """Name, default, what is expected, and meaning of the keys of a suite."""
    lines = []
    for name, default, meaning in _settings(cls, _names(cls)):
        expected = suites.expected(name.strip("`"))
        # As TOML has it: a list in square brackets, and nothing for None.
        shown = re.sub(r"^`\((.*?),?\)`$", r"`[\1]`", default).replace("`None`", "")
        lines.append((name, shown, expected, meaning))
    return lines


def _names(cls: type) -> list[str]:
    return [f.name for f in fields(cls) if not f.kw_only]


def first_line(subject: Any) -> str:
    """The first paragraph of a docstring, in one line."""
    return _line((inspect.getdoc(subject) or "").partition("\n\n")[0])


def _line(text: str | None) -> str:
    return " ".join((text or "").split()).replace("|", "\\|")


def docstring(subject: Any) -> str:
    """Return a docstring in Markdown: its sections (Args and the like) as bold words and lists."""
    return in_markdown(inspect.getdoc(subject) or "")
