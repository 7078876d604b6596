"""The pages of the Python API: every public name of every module, read from the sources.

Modules are not imported, so that also those which need an optional package have their entries.
"""

from __future__ import annotations

import ast
import copy
import inspect
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx import addnodes

import pinnobs_gym
from pinnobs_gym.leaderboard.grid import markdown_table

PACKAGE = Path(pinnobs_gym.__file__).parent
ROOTS = (PACKAGE, PACKAGE.parent / "trainers")
"""The folders whose modules have entries."""
BESIDE = "package"
"""The page of the modules that are in no room."""


@dataclass(frozen=True)
class Module:
    """A module and the room that it is in."""

    name: str
    room: str
    tree: ast.Module

    @property
    def scope(self) -> dict[str, str]:
        """The full names of what this module defines, or imports from these packages."""
        found = {
            each.asname or each.name: f"{node.module}.{each.name}"
            for node in ast.walk(self.tree)
            if isinstance(node, ast.ImportFrom) and node.module is not None and not node.level
            for each in node.names
        }
        return found | {name: f"{self.name}.{name}" for name in public(self)}

    def home(self, name: str) -> str:
        """Return the full name that a name of this module has where it is defined; empty if it is
        none of these packages'."""
        full, seen = self.scope.get(name, ""), set[str]()
        while full and full not in names() and full not in seen:  # it is exported again
            seen.add(full)
            module, _, own = full.rpartition(".")
            full = _scopes().get(module, {}).get(own, "")
        return full


def api_pages() -> dict[str, str]:
    """Return the pages by file name: one of the package's own names, and one per room."""
    rooms: dict[str, list[Module]] = {}
    for module in modules():
        rooms.setdefault(module.room, []).append(module)
    return {**{f"{room}.md": _room(room, rooms[room]) for room in rooms}, "index.md": _index(rooms)}


@lru_cache(maxsize=1)
def modules() -> list[Module]:
    """Return the modules by name, without those that only run as a program."""
    found = []
    for root in ROOTS:
        for path in sorted(root.rglob("*.py")):
            parts = path.relative_to(root.parent).with_suffix("").parts
            if parts[-1] == "__main__":
                continue
            name = ".".join(parts).removesuffix(".__init__")
            own = parts[1:-1] or (BESIDE,)
            room = own[0] if root == PACKAGE else root.name
            found.append(Module(name, room, ast.parse(path.read_text(encoding="utf-8"))))
    return found


@lru_cache(maxsize=1)
def _scopes() -> dict[str, dict[str, str]]:
    return {module.name: module.scope for module in modules()}


@lru_cache(maxsize=1)
def names() -> frozenset[str]:
    """Return the full names of everything that has an entry."""
    return frozenset(name for module in modules() for name in _names_of(module))


def public(module: Module) -> dict[str, ast.stmt]:
    """Return what a module defines under public names: functions, classes, and constants that have
    a docstring."""
    return _public(module.tree.body)


def _public(body: Sequence[ast.stmt]) -> dict[str, ast.stmt]:
    found: dict[str, ast.stmt] = {}
    for i, node in enumerate(body):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            overloaded = isinstance(node, ast.FunctionDef) and _is_marked(node, "overload")
            found |= {} if overloaded else {node.name: node}
        elif (name := _assigned(node)) and _docstring_after(body, i):
            found[name] = node
    return {name: node for name, node in found.items() if not name.startswith("_")}


def _names_of(module: Module) -> Iterator[str]:
    yield module.name
    for name, node in public(module).items():
        yield f"{module.name}.{name}"
        if isinstance(node, ast.ClassDef):
            yield from (f"{module.name}.{name}.{member}" for member in _public(node.body))


def _assigned(node: ast.stmt) -> str:
    """Return the name that a statement gives a value or a type; empty if there is none."""
    target = None
    if isinstance(node, ast.AnnAssign):
        target = node.target
    elif isinstance(node, ast.Assign) and len(node.targets) == 1:
        target = node.targets[0]
    return target.id if isinstance(target, ast.Name) else ""


def _docstring_after(body: Sequence[ast.stmt], i: int) -> str:
    """Return the docstring below a statement; empty if there is none."""
    after = body[i + 1].value if i + 1 < len(body) and isinstance(body[i + 1], ast.Expr) else None  # type: ignore[attr-defined]
    text = after.value if isinstance(after, ast.Constant) else None
    return inspect.cleandoc(text) if isinstance(text, str) else ""


def _index(rooms: dict[str, list[Module]]) -> str:
    """Return the page of the names that the package itself has, and of its rooms."""
    own = {name: getattr(pinnobs_gym, name) for name in pinnobs_gym.__all__ if name[0] != "_"}
    lines = [
        (f"{{py:obj}}`{name} <{each.__module__}.{each.__qualname__}>`", _first(each.__doc__ or ""))
        for name, each in sorted(own.items(), key=lambda pair: pair[0].lower())
    ]
    listed = [(f"[{room}]({room}.md)", _first(_about_room(room))) for room in rooms]
    tree = "\n".join(
        ["```{toctree}", ":hidden:", "", *(f"{room} <{room}>" for room in rooms), "```"]
    )
    return "\n".join(
        [
            "# Python API\n",
            "What `import pinnobs_gym` has, which is what most programs need:\n",
            markdown_table(("name", "what it is"), lines),
            "\nThe rest is imported from its module. The rooms are described in "
            "[Architecture](../../architecture.md):\n",
            markdown_table(("room", "what is in it"), listed),
            f"\n{tree}\n",
        ]
    )


def _about_room(room: str) -> str:
    told = {module.name: ast.get_docstring(module.tree) for module in modules()}
    return (
        told.get(f"pinnobs_gym.{room}")
        or told.get(room)
        or ("What `pinnobs_gym` itself has, and how classes are found by their names.")
    )


def _room(room: str, those: list[Module]) -> str:
    parts = ["---\ntocdepth: 2\n---\n", f"# {room}\n"]
    for module in those:
        scope = Entries({name: module.home(name) for name in _scopes()[module.name]})
        entries = [scope.of(name, node, module.tree.body) for name, node in public(module).items()]
        about = ast.get_docstring(module.tree) or ""
        if not (entries or about):
            continue
        parts.append(f"## `{module.name}`\n")
        parts.append(f"```{{py:module}} {module.name}\n```\n\n{in_markdown(about)}\n")
        parts += entries
    return "\n".join(parts)


@dataclass(frozen=True)
class Entries:
    """The entries of a module's names."""

    scope: Mapping[str, str]
    """`Module.home` of its names, by which the types in signatures become links."""

    def of(self, name: str, node: ast.stmt, body: Sequence[ast.stmt], fence: int = 6) -> str:
        """Return the entry of a name: its signature, its docstring and, of a class, its members.

        Args:
            name: the name.
            node: the statement that defines it.
            body: the statements that this is one of.
            fence: number of backticks around the entry, of which what is inside has fewer.
        """
        if isinstance(node, ast.ClassDef):
            return self._class(name, node, fence)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            told = in_markdown(ast.get_docstring(node) or "")
            return _directive("py:function", f"{name}{self._call(node)}", told, fence)
        told = in_markdown(_docstring_after(body, body.index(node)))
        return _directive("py:data", name, told, fence, self._typed(node))

    def _class(self, name: str, node: ast.ClassDef, fence: int) -> str:
        parts = [in_markdown(ast.get_docstring(node) or "")]
        if node.bases:
            parts.insert(0, f"Bases: {', '.join(map(self._base, node.bases))}.")
        arguments = ""
        for member, own in _public(node.body).items():
            if isinstance(own, ast.ClassDef):
                parts.append(self._class(member, own, fence - 1))
            elif not isinstance(own, ast.FunctionDef):
                told = in_markdown(_docstring_after(node.body, node.body.index(own)))
                options = self._typed(own)
                parts.append(_directive("py:attribute", member, told, fence - 1, options))
            elif told := ast.get_docstring(own):  # or it overrides what its base describes
                parts.append(self._method(member, own, in_markdown(told), fence - 1))
        for own in node.body:
            if isinstance(own, ast.FunctionDef) and own.name == "__init__":
                arguments = self._call(own, method=True).partition(" -> ")[0]
        return _directive("py:class", f"{name}{arguments}", "\n\n".join(parts), fence)

    def _method(self, name: str, node: ast.FunctionDef, told: str, fence: int) -> str:
        if _is_marked(node, "property") or _is_marked(node, "cached_property"):
            options = f":type: {_quoted(self._linked(node.returns))}" if node.returns else ""
            return _directive("py:property", name, told, fence, options)
        marks = [f":{mark}:" for mark in ("staticmethod", "classmethod") if _is_marked(node, mark)]
        call = self._call(node, method=True)
        return _directive("py:method", f"{name}{call}", told, fence, "\n".join(marks))

    def _base(self, node: ast.expr) -> str:
        shown, full = ast.unparse(node), self.scope.get(ast.unparse(node), "")
        return f"{{py:obj}}`{shown} <{full}>`" if full in names() else f"`{shown}`"

    def _call(self, node: ast.FunctionDef | ast.AsyncFunctionDef, method: bool = False) -> str:
        """Return the arguments of a function in brackets, and what it returns."""
        arguments = ast.unparse(self._with_links(node.args))
        if method and not _is_marked(node, "staticmethod"):
            arguments = re.sub(r"^(self|cls)(: [^,]*)?(, )?", "", arguments)
        return f"({arguments})" + (f" -> {self._linked(node.returns)}" if node.returns else "")

    def _typed(self, node: ast.stmt) -> str:
        """Return the options of a constant or an attribute: its type and its value."""
        annotated = isinstance(node, ast.AnnAssign)
        options = [f":type: {_quoted(self._linked(node.annotation))}"] if annotated else []
        value = node.value if isinstance(node, ast.Assign | ast.AnnAssign) else None
        shown = "" if value is None else ast.unparse(_default(value))
        if shown and shown != "{}" and len(shown) < 80 and "\n" not in shown:
            options.append(f":value: {_quoted(shown)}")
        return "\n".join(options)

    def _linked(self, annotation: ast.expr) -> str:
        """Return a type, in which names of these packages are full ones."""
        return ast.unparse(self._full(annotation))

    def _with_links(self, arguments: ast.arguments) -> ast.arguments:
        """Return arguments with such types."""
        arguments = copy.deepcopy(arguments)
        for node in ast.walk(arguments):
            if isinstance(node, ast.arg) and node.annotation is not None:
                node.annotation = self._full(node.annotation)
        return arguments

    def _full(self, annotation: ast.expr) -> ast.expr:
        annotation = copy.deepcopy(annotation)
        if isinstance(annotation, ast.Subscript) and ast.unparse(annotation.value) == "Annotated":
            annotation = annotation.slice.elts[0]  # type: ignore[attr-defined]
        for node in ast.walk(annotation):
            if isinstance(node, ast.Name) and self.scope.get(node.id) in names():
                node.id = self.scope[node.id]
        return annotation


def _directive(kind: str, signature: str, body: str, fence: int, options: str = "") -> str:
    ticks = "`" * fence
    return f"{ticks}{{{kind}}} {signature}\n{options}\n\n{body}\n{ticks}\n"


def _quoted(option: str) -> str:
    """Return the value of an option as YAML, which would else take quotes for its own."""
    return "'" + option.replace("'", "''") + "'"


def _default(value: ast.expr) -> ast.expr:
    """Return the default of a dataclass's field, or what makes it; other values as they are."""
    if not (isinstance(value, ast.Call) and ast.unparse(value.func) == "field"):
        return value
    given = {each.arg: each.value for each in value.keywords}
    made = given.get("default_factory")
    return given.get("default") or (ast.Call(made, [], []) if made else ast.Name(""))


def _is_marked(node: ast.FunctionDef | ast.AsyncFunctionDef, decorator: str) -> bool:
    return any(ast.unparse(each).rpartition(".")[2] == decorator for each in node.decorator_list)


def _first(told: str) -> str:
    """Return the first paragraph of a docstring, for a cell of a table."""
    first = inspect.cleandoc(told).partition("\n\n")[0]
    return " ".join(in_markdown(first).split()).replace("|", "\\|")


def in_markdown(told: str) -> str:
    """Return a docstring in Markdown, in which full names of this package are links."""
    told = re.sub(r"::\n\n(?=    )", ":\n\n", told)
    # What looks like a tag of HTML would not be shown; code has no tags.
    told = re.sub(r"(`[^`]*`|^    .*$)|<(?=[A-Za-z/!])", _without_tag, told, flags=re.MULTILINE)
    parts = re.split(r"^(Args|Returns|Raises|Yields):\n", told, flags=re.MULTILINE)
    found = [parts[0]]
    for title, body in zip(parts[1::2], parts[2::2], strict=True):
        body = inspect.cleandoc(body)
        if title in ("Args", "Raises"):
            body = re.sub(r"^ +", "  ", body, flags=re.MULTILINE)  # below its item of the list
            body = re.sub(r"^(\*{0,2}\w[\w, ]*):", r"- `\1`:", body, flags=re.MULTILINE)
        found.append(f"**{title}**\n\n{body}\n")
    linked = re.compile(r"(?<!`)`((?:pinnobs_gym|trainers)\.[\w.]+)`(?!`)")
    return linked.sub(
        lambda each: f"{{py:obj}}`~{each[1]}`" if each[1] in names() else each[0], "\n".join(found)
    )


def _without_tag(found: re.Match[str]) -> str:
    return found[1] or "\\<"


def unlink_others(app: Any, tree: nodes.document) -> None:
    """Make plain text of the types in signatures that have no entry; Sphinx would take each for
    any name that ends like it."""
    for node in list(tree.findall(addnodes.pending_xref)):
        if node.get("refdomain") == "py" and node["reftarget"] not in names():
            node.replace_self(nodes.Text(node["reftarget"]))
