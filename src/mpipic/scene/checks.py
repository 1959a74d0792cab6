"""Checking a scene against the registered parts: what exists, what is chosen, what goes together, what is unused.

`check` collects every problem, so that a user repairs a scene in one go. A rule whose keys are themselves wrong is left
out: it would only repeat what is already said. What the parts are, and their rules, is theirs to say; see
`mpipic.parts`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from pydantic import ValidationError

from mpipic import parts
from mpipic.keys import ByScene, Key, plain
from mpipic.parts import Part, Values
from mpipic.scene.text import Problem, SceneError, Unused
from mpipic.wording import closest, listed, show, show_key

INTEGER_LIMIT = 2**63  # TOML's integers have 64 bits
PHYSICS = "physics.kind"


def check(data: Mapping[str, Any], problems: list[Problem]) -> tuple[dict[str, Any], list[Unused]]:
    """Return every value of the scene by dotted key, of the chosen parts alone, and what is given beside.

    Parameters
    ----------
    data : mapping of section to mapping of key to value
        As parsed from TOML; anything may be wrong with it.
    problems : list
        What is already known to be wrong.

    Raises
    ------
    SceneError
        With `problems` and everything found here.
    """
    draft = Draft(problems)
    draft.read(data)
    chosen = draft.choose()
    for part in chosen:
        draft.fill(part)
    unused = draft.unused()
    for part in chosen:
        for rule in part.rules():
            if all(key in draft.values and key not in draft.bad for key in rule.keys):
                broken = rule.broken(Values(draft.values))
                if broken:
                    draft.refuse(*broken)
    if problems:
        known = list(parts.sections())
        problems.sort(key=lambda p: known.index(s) if (s := p.key.split(".")[0]) in known else -1)
        raise SceneError(problems)
    order = [key for part in chosen for key in (part.slot, *(one.dotted for one in part.keys().values()))]
    return {key: draft.values[key] for key in order if key in draft.values}, unused


@dataclass
class Draft:
    """A scene while it is being checked.

    Attributes
    ----------
    problems
        What is wrong so far.
    given
        What the scene says, by dotted key, of keys that there are.
    values
        Values of the chosen parts by dotted key, given or default.
    bad
        Keys whose value is wrong or unknown.
    """

    problems: list[Problem]
    given: dict[str, Any] = field(default_factory=dict)
    values: dict[str, Any] = field(default_factory=dict)
    bad: set[str] = field(default_factory=set)

    def refuse(self, key: str, rule: str, choices: Iterable[str] = (), suggestion: str | None = None) -> None:
        """Record that `key` breaks `rule`; rules that need `key` will be left out."""
        value = self.values.get(key, self.given.get(key))
        self.problems.append(Problem(key, value, rule, tuple(choices), suggestion))
        self.bad.add(key)

    # ------------------------------------------------------------ what is there

    def read(self, data: Mapping[str, Any]) -> None:
        """Take what is given for keys that there are; refuse sections and keys that there are not."""
        known = parts.sections()
        for name, table in data.items():
            if name not in known:
                value = None if isinstance(table, Mapping) else table
                rule = "there is no such section; the sections are " + ", ".join(known)
                near = _home(name, known) or closest(name, list(known))
                self.problems.append(Problem(show_key(str(name)), value, rule, tuple(known), near))
            elif not isinstance(table, Mapping):
                rule = f"must be a section, [{name}], with {', '.join(known[name])}"
                self.problems.append(Problem(name, table, rule))
                self.bad.update(f"{name}.{key}" for key in known[name])
            else:
                self._read_keys(name, table, known)

    def _read_keys(self, section: str, table: Mapping[str, Any], known: Mapping[str, list[str]]) -> None:
        names = known[section]
        for name, value in table.items():
            if name in names:
                self.given[f"{section}.{name}"] = plain(value)
                continue
            near = closest(name, names)
            suggestion = f"{section}.{near}" if near else _home(name, known)
            rule = f"there is no such key; [{section}] has {', '.join(names)}"
            self.problems.append(Problem(show_key(section, str(name)), value, rule, tuple(names), suggestion))

    # ------------------------------------------------------------ what is chosen

    def choose(self) -> list[type[Part]]:
        """Return the parts that the scene names, in its order; refuse names that there are not."""
        self._choose(PHYSICS, None)
        physics = None if PHYSICS in self.bad else self.values[PHYSICS]
        found = []
        for slot in parts.slots(physics):
            kind = self._choose(slot, physics) if "." in slot else ""
            if kind is not None:
                found.append(parts.choices(slot, physics)[kind])
        return found

    def _choose(self, slot: str, physics: str | None) -> str | None:
        """Return the kind of a slot, None if it is wrong."""
        if slot in self.values and slot not in self.bad:
            return str(self.values[slot])
        kinds = list(parts.choices(slot, physics))
        value = self.values[slot] = self.given.get(slot, parts.default_of(slot, physics))
        if isinstance(value, str) and value in kinds and slot not in self.bad:
            return value
        if slot not in self.bad:
            self.refuse(slot, f"must be {'one of ' * (len(kinds) > 1)}{', '.join(kinds)}", kinds, closest(value, kinds))
        return None

    # ------------------------------------------------------------ values

    def fill(self, part: type[Part]) -> None:
        """Put a part's values, given or default, into the draft; refuse those of the wrong type or range."""
        keys = part.keys()
        given = {name: self.given[one.dotted] for name, one in keys.items() if one.dotted in self.given}
        wrong = _wrong(part, given)
        parsed = part.Settings.model_validate({name: value for name, value in given.items() if name not in wrong})
        for name, one in keys.items():
            self.values[one.dotted] = given[name] if name in wrong else getattr(parsed, name)
            if name in wrong:
                self.refuse(one.dotted, _rule(one, given[name]))
            elif name in given:
                self._count_axes(one)
            else:
                self._default(one)
        self._choose_either(part, [name for name in part.either if name in given])
        if not any(one.dotted in self.bad for one in keys.values()):
            for name in part.idle(Values(self.values)):
                del self.values[keys[name].dotted]

    def _default(self, key: Key) -> None:
        default = key.default
        if isinstance(default, ByScene):
            known = self.bad.isdisjoint(default.needs) or (default.needs == ("grid.cells",) and self._dim is not None)
            default = default.of(Values(self.values)) if known else None
            if not known:
                self.bad.add(key.dotted)
        self.values[key.dotted] = default

    def _count_axes(self, key: Key) -> None:
        count = len(self.values[key.dotted]) if key.per_axis else 0
        if key.per_axis and self._dim not in (None, count):
            self.refuse(key.dotted, f"must have as many entries as grid.cells, {self._dim}; it has {count}")

    @property
    def _dim(self) -> int | None:
        """Number of entries of grid.cells even if an entry is wrong, or None if that says nothing."""
        cells = self.values.get("grid.cells")
        return len(cells) if isinstance(cells, tuple) and 1 <= len(cells) <= 3 else None

    def _choose_either(self, part: type[Part], given: list[str]) -> None:
        """Keep, where keys say one thing in several ways, the one that is given; without any, the first."""
        dotted = [f"{part.section()}.{name}" for name in given or part.either[:1]]
        for other in dotted[1:] if self.bad.isdisjoint(dotted) else ():
            rule = f"give either {' or '.join(dotted)}, not both; {dotted[0]} is {show(self.values[dotted[0]])}"
            self.refuse(other, rule)
        for name in part.either:
            if f"{part.section()}.{name}" not in dotted:
                self.values[f"{part.section()}.{name}"] = None

    # ------------------------------------------------------------ what is left

    def unused(self) -> list[Unused]:
        """Return what is given for keys that no chosen part uses; refuse values that no part could use either."""
        found = []
        for dotted in self.given:
            if dotted in self.values:
                continue
            owners = {part: part.keys()[name] for part in parts.registered() if (name := _name_in(part, dotted))}
            if not owners:  # it chooses a part, of a physics that there is not
                continue
            value, first = self.given[dotted], next(iter(owners.values()))
            if all(_wrong(part, {dotted.split(".")[1]: value}) for part in owners):
                self.refuse(dotted, _rule(first, value))
            elif self.bad.isdisjoint({PHYSICS, *(part.slot for part in owners), *_siblings(owners)}):
                found.append(Unused(dotted, value, self._reason(dotted, list(owners))))
        return found

    def _reason(self, dotted: str, owners: list[type[Part]]) -> str:
        """Return why nothing uses a key, and what would."""
        physics, name = self.values[PHYSICS], dotted.split(".")[1]
        own = [part for part in owners if part.physics in (None, physics)]
        if not own:
            return f"{PHYSICS} = {show(physics)} has no {dotted}"
        slot = own[0].slot
        if not own[0].kind:
            return own[0].idle(Values(self.values))[name]
        kinds = [part.kind for part in own]
        return (
            f"{slot} = {show(self.values[slot])} takes no {name}; {listed(kinds)} {'do' * (len(kinds) > 1) or 'does'}"
        )


def _name_in(part: type[Part], dotted: str) -> str | None:
    """Return the name of a key in a part that has it."""
    section, name = dotted.split(".")
    return name if part.section() == section and name in part.Settings.model_fields else None


def _siblings(owners: Iterable[type[Part]]) -> set[str]:
    """Return all keys of plain sections, which what they leave unused depends on."""
    return {one.dotted for part in owners if not part.kind for one in part.keys().values()}


def _home(name: object, known: Mapping[str, list[str]]) -> str | None:
    """Return the dotted key of this name in whatever section has one."""
    return next((f"{section}.{name}" for section, keys in known.items() if name in keys), None)


def _wrong(part: type[Part], given: Mapping[str, Any]) -> set[str]:
    """Return the names of keys whose value is of the wrong type or range."""
    wrong = {name for name, value in given.items() if value is None or _is_oversized(value)}
    try:
        part.Settings.model_validate({name: value for name, value in given.items() if name not in wrong})
    except ValidationError as error:
        wrong.update(str(item["loc"][0]) for item in error.errors(include_url=False, include_input=False))
    return wrong


def _rule(key: Key, value: object) -> str:
    rest = "; a whole number must fit in 64 bits" if _is_oversized(value) else ""
    return f"must be {key.rule}{rest}{_number_hint(value)}"


def _is_oversized(value: object) -> bool:
    items = value if isinstance(value, tuple) else (value,)
    return any(isinstance(item, int) and not -INTEGER_LIMIT <= item < INTEGER_LIMIT for item in items)


def _number_hint(value: object) -> str:
    """Explain a number in quotes, or one such as .5 that TOML does not take for a number."""
    try:
        number = float(value) if isinstance(value, str) else math.nan
    except ValueError:
        return ""
    if not math.isfinite(number):
        return ""
    return f"; this is text, the number is {int(number) if number.is_integer() and abs(number) < 2**53 else number}"
