"""Scene files as text: problems and their wording, reading and writing TOML, command-line overrides."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import tomli_w

from mpipic.errors import Refused
from mpipic.parts import alternatives
from mpipic.wording import escape, shorten, show

_PLACE = re.compile(r"(?P<what>.*) \(at (?:line (?P<line>\d+), column (?P<column>\d+)|end of document)\)", re.DOTALL)
_LONG_NUMBER = re.compile(r"\d[\d_]{1000,}")


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong with a scene; `str()` is the sentence shown to the user.

    Attributes
    ----------
    key : str
        Dotted name such as ``filter.kind``, a section, a file, or the text of an override.
    value : object
        What was found there; None when there is no value to show.
    rule : str
        What the value has to satisfy, in plain words.
    choices : tuple of str
        The accepted values (or keys, or sections) where there is a list of them.
    suggestion : str or None
        The accepted name closest to what was written.
    """

    key: str
    value: object
    rule: str
    choices: tuple[str, ...] = ()
    suggestion: str | None = None

    def __str__(self) -> str:
        """Key, value, rule and suggestion on one line, free of control characters."""
        head = self.key if self.value is None else f"{self.key} = {show(self.value)}"
        text = f"{head}: {self.rule}"
        return text if self.suggestion is None else f'{text}. Did you mean "{escape(self.suggestion)}"?'


@dataclass(frozen=True)
class Unused:
    """A key that a scene gives and that nothing in it uses; `str()` is the sentence shown to the user."""

    key: str
    value: object
    why: str

    def __str__(self) -> str:
        """Key, value and reason on one line."""
        return f"{self.key} = {show(self.value)} is not used: {self.why}"


class SceneError(Refused):
    """A scene that cannot be used. `problems` holds everything found; `str()` gives them all, one per line.

    Can be pickled, so that one rank can read the scene and tell the others.
    """

    def __init__(self, problems: Sequence[Problem]) -> None:
        """Keep `problems`, at least one, in the order in which they are shown."""
        self.problems: tuple[Problem, ...] = tuple(problems)
        super().__init__(self.problems)

    def __str__(self) -> str:
        """Return every problem, one per line."""
        return "\n".join(str(problem) for problem in self.problems)


def parse_toml(text: str, source: str) -> dict[str, Any]:
    """Parse a scene file's text.

    Raises
    ------
    SceneError
        One problem, naming `source`, line and column.
    """
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        rule = _syntax_rule(str(error), text)
    except RecursionError:
        rule = "not usable: lists or tables are nested too deeply"
    except ValueError:  # Python refuses to convert integers of thousands of digits
        found = _LONG_NUMBER.search(text)
        rule = f"not usable{_position(text, found.start()) if found else ''}: a number has too many digits"
    raise SceneError([Problem(escape(source), None, rule)])


def apply_overrides(data: Mapping[str, Any], overrides: Sequence[str], problems: list[Problem]) -> dict[str, Any]:
    """Return a copy of `data` with every ``section.key=value`` of `overrides` set; the last one wins.

    A value is read as TOML; a bare word that is not TOML is a string. Setting one of several ways of saying one thing
    (``time.dt``, ``time.cfl``) takes the others out of `data`. Overrides that cannot be read are added to `problems`.
    """
    result = {section: dict(table) if isinstance(table, Mapping) else table for section, table in data.items()}
    changes: dict[str, Any] = {}
    for text in overrides:
        parsed = _parse_override(text)
        if isinstance(parsed, Problem):
            problems.append(parsed)
        else:
            changes[parsed[0]] = parsed[1]
    for name, value in changes.items():
        section, key = name.split(".")
        table = result.setdefault(section, {})
        if isinstance(table, dict):
            table[key] = value
            for other in alternatives(name):
                if other not in changes:
                    table.pop(other.split(".")[1], None)
    return result


def write_toml(data: Mapping[str, Mapping[str, Any]]) -> str:
    """Return sections of numbers, strings and lists as TOML that reads back to the same values, bit for bit."""
    blocks = []
    for section, table in data.items():
        blocks.append("\n".join([f"[{section}]", *(f"{key} = {_literal(value)}" for key, value in table.items())]))
    return "\n\n".join(blocks) + "\n"


def _literal(value: object) -> str:
    """Return a value as TOML, lists on one line, which the library would spread over many."""
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_literal(item) for item in value) + "]"
    return tomli_w.dumps({"value": value}).removeprefix("value = ").rstrip("\n")


def _parse_override(text: str) -> tuple[str, Any] | Problem:
    name, equals, value_text = text.partition("=")
    parts = [part.strip() for part in name.split(".")]
    shown = f"--set {escape(shorten(text))}"
    if not equals or len(parts) != 2 or not all(re.fullmatch(r"[A-Za-z0-9_-]+", part) for part in parts):
        return Problem(shown, None, "must have the form section.key=value, for example filter.kind=none")
    word = value_text.strip()
    try:
        parsed = tomllib.loads(f"value = {word}")
    except (ValueError, RecursionError):
        parsed = {}
    if set(parsed) == {"value"}:
        return ".".join(parts), parsed["value"]
    if word.startswith(("[", "{", '"', "'")) or any(ord(ch) < 32 for ch in word):
        return Problem(shown, None, "the value is not valid TOML")
    return ".".join(parts), word


def _syntax_rule(message: str, text: str) -> str:
    found = _PLACE.fullmatch(message)
    if found is None:
        return f"not valid TOML: {escape(message)}"
    lines = text.split("\n")
    if found["line"]:
        line, column = int(found["line"]), int(found["column"])
    else:
        line, column = len(lines), len(lines[-1]) + 1
    what = found["what"][0].lower() + found["what"][1:]
    if what == "cannot overwrite a value":
        what = "this key is set a second time"
    elif what.startswith("cannot declare"):
        what = "this section appears a second time"
    source = lines[line - 1].strip() if line <= len(lines) else ""
    return f"not valid TOML at line {line}, column {column}: {escape(what)}" + (
        f", in {show(source)}" if source else ""
    )


def _position(text: str, offset: int) -> str:
    before = text[:offset]
    return f" at line {before.count(chr(10)) + 1}, column {offset - before.rfind(chr(10))}"
