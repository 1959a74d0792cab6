"""Reads a package with `ast` and holds it to the rules of the house: who imports whom, sizes, private names, sentences.

Every import counts, also one inside a function. One under `if TYPE_CHECKING` names a type and builds nothing: it obeys
the floors like any other, but may name the type of a library, and a scene beside a part.
"""

from __future__ import annotations

import ast
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

PACKAGE = "mpipic"
DOOR = "the door"
GROUND = "ground"
FLOORS = (
    ("__main__",),
    ("cli",),
    ("analysis", "study", "figures"),
    ("run",),
    ("physics",),
    ("filters",),
    ("mapping",),
    ("particles",),
    ("mesh",),
    ("kernels",),
)
"""From top to bottom; below them lies the ground, every module directly in the package that is not named here."""
ASIDE = ("scene", "plots", "io")
"""Rooms below `run` that know neither each other nor a part."""
SEE_ASIDE = FLOORS[: FLOORS.index(("run",)) + 1]
PARTS = tuple(room for floor in FLOORS[len(SEE_ASIDE) :] for room in floor)
BUILDER = "run/build.py"
"""The one file that may import both a scene and the parts."""
ONLY_IN = {"h5py": ("io",), "slepc4py": ("filters", "analysis")}
NEVER_IN = {"physics": ("mpi4py", "petsc4py"), **{room: ("mpi4py", "petsc4py") for room in ASIDE}}
NO_SENTENCE = ("Of", "What", "As", "Nothing")
"""How a docstring begins that is a fragment: no subject, no verb."""
MOST_ROOMS, MOST_FLOORS, LONGEST_FILE, LONGEST_FUNCTION = 13, 10, 400, 40


@dataclass(frozen=True)
class Import:
    """An imported module: its dotted name, its file if it is of the package, `typing` if for type checkers only."""

    line: int
    name: str
    file: str
    typing: bool


@dataclass(frozen=True)
class Broken:
    """A rule that does not hold: which, where, by what."""

    rule: str
    file: str
    what: str
    line: int = 1

    def __str__(self) -> str:
        return f"{self.file}:{self.line}: {self.what}: {self.rule}"


def broken_rules(root: Path) -> list[Broken]:
    """Everything in the package at `root` that breaks a rule."""
    trees = {path.relative_to(root).as_posix(): ast.parse(path.read_text()) for path in sorted(root.rglob("*.py"))}
    found = list(_count_rooms(trees))
    defined = {file: set(_private_names(tree)) for file, tree in trees.items()}
    for file, tree in trees.items():
        for seen in imports_of(tree, file, trees):
            found += [Broken(rule, file, seen.name, seen.line) for rule in _of_import(file, seen)]
        found += _both_sides(file, tree, trees)
        if room_of(file) != DOOR:
            found += _by_name(file, tree)
        found += _sizes(file, tree, (root / file).read_text())
        found += _private_uses(file, tree, defined)
        found += _fragments(file, tree)
    return found


# ---------------------------------------------------------------- imports


def imports_of(tree: ast.Module, file: str, files: Collection[str]) -> Iterator[Import]:
    """Every import of a module: for `from a import b`, a.b where that is a module of the package, else a."""
    typing = {id(node) for block in ast.walk(tree) if _is_typing(block) for node in ast.walk(block)}
    for node in ast.walk(tree):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = _absolute(node, file)
            whole = [f"{base}.{alias.name}" for alias in node.names]
            names = [name if _file_of(name) in files or _package_of(name) in files else base for name in whole]
            names = [name for name, full in zip(names, whole) if full != f"{PACKAGE}.__version__"]  # anybody may say it
        for name in names:
            place = _package_of(name) if _package_of(name) in files else _file_of(name)
            yield Import(node.lineno, name, place, id(node) in typing)


def _is_typing(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING")


def _absolute(node: ast.ImportFrom, file: str) -> str:
    if not node.level:
        return node.module or ""
    folders = [PACKAGE, *file.split("/")[:-1]]
    return ".".join(folders[: len(folders) - node.level + 1] + ([node.module] if node.module else []))


def _file_of(name: str) -> str:
    first, *rest = name.split(".")
    return "/".join(rest) + ".py" if first == PACKAGE and rest else ""


def _package_of(name: str) -> str:
    first, *rest = name.split(".")
    return "/".join([*rest, "__init__.py"]) if first == PACKAGE else ""


def room_of(file: str) -> str:
    """The room of a file: the folder it is in, the module's own name for `cli` and `__main__`, else ground or door."""
    first, *rest = file.split("/")
    if rest:
        return first
    name = first.removesuffix(".py")
    return DOOR if name == "__init__" else name if (name,) in FLOORS else GROUND


def _of_import(file: str, seen: Import) -> Iterator[str]:
    """The rules that one import breaks."""
    here, library = room_of(file), seen.name.split(".")[0]
    if seen.file:
        yield from _between_rooms(file, seen)
    if library in ONLY_IN and here not in ONLY_IN[library] and not seen.typing:
        yield f"only {' and '.join(ONLY_IN[library])} import {library}"
    if library in NEVER_IN.get(here, ()) and (here == "physics" or not seen.typing):
        yield f"{here} never imports {library}"


def _between_rooms(file: str, seen: Import) -> Iterator[str]:
    here, there = room_of(file), room_of(seen.file)
    if here == DOOR:
        if not seen.typing:
            yield "the door imports when asked, not before"
    elif there == DOOR:
        yield "a room imports from rooms, not through the door"
    elif here == GROUND:
        if there != GROUND:
            yield "ground imports only ground"
    elif here == there:
        if here == "physics" and _kind(seen.file) not in ("", _kind(file)):
            yield "no physics knows another, and what is common knows none"
    elif there != GROUND and not _is_below(there, here):
        yield f"{here} imports no {there}: a room imports from rooms below it"


def _kind(file: str) -> str:
    """The kind of physics that a file belongs to, or nothing."""
    _, *rest = file.split("/")
    return rest[0] if len(rest) > 1 else ""


def _is_below(there: str, here: str) -> bool:
    if here in ASIDE:
        return False
    if there in ASIDE:
        return any(here in floor for floor in SEE_ASIDE)
    height = {room: n for n, floor in enumerate(FLOORS) for room in floor}
    return height.get(there, -1) > height.get(here, len(FLOORS))


def _by_name(file: str, tree: ast.Module) -> Iterator[Broken]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] in ("import_module", "__import__"):
            yield Broken("only the door imports by name, which no test can read", file, "an import", node.lineno)


def _both_sides(file: str, tree: ast.Module, files: Collection[str]) -> Iterator[Broken]:
    """Scene and parts in one file of a room that may see both: an entry for each import of a part."""
    seen = [one for one in imports_of(tree, file, files) if one.file and not one.typing]
    if file == BUILDER or not _is_below("scene", room_of(file)) or "scene" not in {room_of(one.file) for one in seen}:
        return
    for one in seen:
        if room_of(one.file) in PARTS:
            yield Broken(f"only {BUILDER} imports both scene and parts", file, one.name, one.line)


# ---------------------------------------------------------------- sizes


def _count_rooms(files: Collection[str]) -> Iterator[Broken]:
    rooms = sorted({file.split("/")[0] for file in files if "/" in file})
    floors = len([floor for floor in FLOORS if {*floor} & {*rooms, "cli"}])
    if len(rooms) > MOST_ROOMS:
        yield Broken(f"at most {MOST_ROOMS} rooms", "", f"{len(rooms)} rooms")
    if floors + 1 > MOST_FLOORS:  # and the ground
        yield Broken(f"at most {MOST_FLOORS} floors", "", f"{floors + 1} floors")
    for room in rooms:
        if not any(room in floor for floor in (*FLOORS, ASIDE)):
            yield Broken("every room is on a floor", room, "a room that the test does not know")


def _sizes(file: str, tree: ast.Module, text: str) -> Iterator[Broken]:
    if len(text.splitlines()) > LONGEST_FILE:
        yield Broken(f"no file above {LONGEST_FILE} lines", file, "the file")
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            lines = (node.end_lineno or node.lineno) - node.lineno + 1
            if lines > LONGEST_FUNCTION:
                yield Broken(f"no function above {LONGEST_FUNCTION} lines", file, node.name, node.lineno)


# ---------------------------------------------------------------- private names


def _is_private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__") and name != "_"


def _private_names(tree: ast.Module) -> Iterator[str]:
    """Names with an underscore that a file defines: functions, classes, variables, fields, attributes of self."""
    for node in ast.walk(tree):
        name = ""
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            name = node.name
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            name = node.id
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            name = node.attr
        if _is_private(name):
            yield name


def _private_uses(file: str, tree: ast.Module, defined: dict[str, set[str]]) -> Iterator[Broken]:
    """Imports of private names, and attributes that this file does not define and another one does.

    A base class's private attribute, used as self._x in another file, counts too.
    """
    elsewhere = set().union(*(names for other, names in defined.items() if other != file)) - defined[file]
    for node in ast.walk(tree):
        names = []
        if isinstance(node, ast.ImportFrom) and (node.level or (node.module or "").split(".")[0] == PACKAGE):
            names = [alias.name for alias in node.names if _is_private(alias.name)]
        elif isinstance(node, ast.Attribute) and node.attr in elsewhere:
            names = [node.attr]
        for name in names:
            yield Broken("no private name of another file", file, name, node.lineno)


# ---------------------------------------------------------------- docstrings


def _fragments(file: str, tree: ast.Module) -> Iterator[Broken]:
    """Docstrings, those below a variable or field too, that begin like no sentence."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            first = node.value.value.split(maxsplit=1)[:1]
            if first and first[0] in NO_SENTENCE:
                yield Broken("a docstring is a sentence", file, first[0], node.lineno)
