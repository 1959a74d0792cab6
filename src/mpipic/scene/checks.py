"""Checking a scene: what exists, what is available, which keys a choice uses. What holds between keys: `scene_rules`.

`check` does it all and collects every problem, so that a user repairs a scene in one go. A rule whose keys are
themselves wrong is left out: it would only repeat what is already said.

To make a choice available, turn its False into True in `CHOICES`, or remove its line from `FIXED_FOR_NOW`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from pydantic import BaseModel, ValidationError

from mpipic.scene.rules import RULES, Values
from mpipic.scene.text import Problem, SceneError, closest, show, show_key

# Every name of every choice; True: can be used now.
CHOICES: dict[str, dict[str, bool]] = {
    "particles.layout": {"lattice": True, "jittered": True, "random": True, "clustered": False, "file": True},
    "initial.profile": {
        "gaussian": True,
        "plane-gaussian": True,
        "plane-wave": True,
        "standing-wave": True,
        "file": True,
    },
    "mapping.basis": {"linear": True, "quadratic": True, "cubic": True},
    "mapping.mass": {"lumped": True, "consistent": True, "penalised": True},
    "mapping.gradient": {"direct": True, "grid": True, "skew": True},
    "filter.kind": {"none": True, "local": True, "order": True, "chebyshev": True, "exact": True, "svd": True},
    "time.integrator": {"symplectic": True, "rk4": True, "midpoint": True},
}

# Keys that can only have one value until what they control is available.
FIXED_FOR_NOW: dict[str, int] = {"output.checkpoint_every": 0}

ABOVE_ZERO = "above 0"

# Keys that matter only to some choices: key -> alternatives (the key that chooses, the choices that use it).
USED_WITH: dict[str, tuple[tuple[str, tuple[str, ...]], ...]] = {
    "particles.per_cell": (("particles.layout", ("lattice", "jittered", "random", "clustered")),),
    "particles.jitter": (("particles.layout", ("jittered",)),),
    "particles.seed": (("particles.layout", ("jittered", "random", "clustered")),),
    "particles.path": (("particles.layout", ("file",)),),
    "initial.center": (("initial.profile", ("gaussian", "plane-gaussian")),),
    "initial.sharpness": (("initial.profile", ("gaussian", "plane-gaussian")),),
    "initial.wave": (("initial.profile", ("plane-gaussian", "plane-wave", "standing-wave")),),
    "mapping.penalty": (("mapping.mass", ("penalised",)),),
    "mapping.penalty_order": (("mapping.mass", ("penalised",)),),
    "mapping.gradient_order": (("mapping.gradient", ("grid",)),),
    "filter.order": (("filter.kind", ("order", "chebyshev")),),
    "filter.tolerance": (
        ("filter.kind", ("exact",)),
        ("mapping.mass", ("consistent", "penalised")),
        ("time.integrator", ("midpoint",)),
    ),
    "damping.strength": (("damping.order", (ABOVE_ZERO,)),),
}

INTEGER_LIMIT = 2**63  # TOML's integers have 64 bits

Sections = Mapping[str, type[BaseModel]]


@dataclass
class Draft:
    """A scene while it is being checked: values by dotted key, which were given, which are wrong."""

    values: Values = field(default_factory=dict)
    defaults: Values = field(default_factory=dict)
    given: set[str] = field(default_factory=set)
    bad: set[str] = field(default_factory=set)
    problems: list[Problem] = field(default_factory=list)

    def good(self, *keys: str) -> bool:
        """Whether none of `keys` is wrong."""
        return self.bad.isdisjoint(keys)

    def refuse(self, key: str, rule: str, choices: Iterable[str] = (), suggestion: str | None = None) -> None:
        """Record that `key` breaks `rule`; rules that need `key` will be left out."""
        self.problems.append(Problem(key, self.values.get(key), rule, tuple(choices), suggestion))
        self.bad.add(key)


def check(data: Mapping[str, Any], sections: Sections, problems: list[Problem]) -> Values:
    """Return every value of the scene by dotted key, defaults filled in for its dimension and choices.

    Parameters
    ----------
    data : mapping of section to mapping of key to value
        As parsed from TOML; anything may be wrong with it.
    sections : mapping of section name to record
        Their fields say which keys exist; a field's description says in words what its values must be.
    problems : list
        What is already known to be wrong.

    Raises
    ------
    SceneError
        With `problems` and everything found here.
    """
    draft = Draft(problems=problems)
    _read_sections(draft, data, sections)
    _check_choices(draft)
    _fill_axes(draft)
    _check_unused(draft)
    _choose_time_step(draft)
    for keys, rule in RULES:
        broken = rule(draft.values) if draft.good(*keys) else None
        if broken:
            draft.refuse(*broken)
    if draft.problems:
        order = list(sections)
        draft.problems.sort(key=lambda p: order.index(s) if (s := p.key.split(".")[0]) in order else -1)
        raise SceneError(draft.problems)
    return draft.values


def available(key: str) -> tuple[str, ...]:
    """Return the values of the choice `key` that can be used now, in the order of documentation."""
    return tuple(name for name, usable in CHOICES[key].items() if usable)


def _read_sections(draft: Draft, data: Mapping[str, Any], sections: Sections) -> None:
    names = tuple(sections)
    for name in data:
        if name not in sections:
            homes = [f"{section}.{name}" for section, model in sections.items() if name in model.model_fields]
            suggestion = homes[0] if homes else closest(name, names)
            rule = "there is no such section; the sections are " + ", ".join(names)
            value = None if isinstance(data[name], Mapping) else data[name]
            draft.problems.append(Problem(show_key(str(name)), value, rule, names, suggestion))
    for name, model in sections.items():
        table = data.get(name, {})
        if not isinstance(table, Mapping):
            draft.problems.append(Problem(name, table, f"must be a section, [{name}], with {_fields(model)}"))
            draft.bad.update(f"{name}.{key}" for key in model.model_fields)
            table = {}
        _report_unknown_keys(draft, name, table, sections)
        _read_section(draft, name, {key: table[key] for key in table if key in model.model_fields}, model)


def _fields(model: type[BaseModel]) -> str:
    return ", ".join(model.model_fields)


def _report_unknown_keys(draft: Draft, name: str, table: Mapping[str, Any], sections: Sections) -> None:
    keys = tuple(sections[name].model_fields)
    for key in table:
        if key in keys:
            continue
        near = closest(key, keys)
        homes = [f"{section}.{key}" for section, model in sections.items() if key in model.model_fields]
        suggestion = f"{name}.{near}" if near else homes[0] if homes else None
        rule = f"there is no such key; [{name}] has {', '.join(keys)}"
        draft.problems.append(Problem(show_key(name, str(key)), table[key], rule, keys, suggestion))


def _read_section(draft: Draft, name: str, table: dict[str, Any], model: type[BaseModel]) -> None:
    """Put the section's values, given or default, into the draft; refuse those of the wrong type or range."""
    values = {key: tuple(value) if isinstance(value, list) else value for key, value in table.items()}
    wrong = {key for key, value in values.items() if value is None or _is_oversized(value)}
    try:
        model.model_validate({key: value for key, value in values.items() if key not in wrong})
    except ValidationError as error:
        wrong.update(str(item["loc"][0]) for item in error.errors(include_url=False, include_input=False))
    parsed = model.model_validate({key: value for key, value in values.items() if key not in wrong})
    for key, info in model.model_fields.items():
        dotted = f"{name}.{key}"
        draft.defaults[dotted] = info.default
        draft.values[dotted] = values[key] if key in wrong else getattr(parsed, key)
        if key in values:
            draft.given.add(dotted)
        if key in wrong and dotted not in CHOICES:
            rule = f"must be {info.description}"
            if _is_oversized(values[key]):
                rule += "; a whole number must fit in 64 bits"
            draft.refuse(dotted, rule + _number_hint(values[key]))


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


def _check_choices(draft: Draft) -> None:
    for key, names in CHOICES.items():
        value, now = draft.values[key], available(key)
        if not draft.good(key) or (isinstance(value, str) and names.get(value)):
            continue
        rule = f"must be {'one of ' if len(now) > 1 else ''}{', '.join(now)}"
        later = [name for name in names if name not in now]
        if isinstance(value, str) and value in names:
            draft.refuse(key, f"not available yet; {rule}", now)
        else:
            waiting = f" ({', '.join(later)} {'is' if len(later) == 1 else 'are'} not available yet)" if later else ""
            draft.refuse(key, rule + waiting, now, closest(value, now))
    for key, only in FIXED_FOR_NOW.items():
        if draft.good(key) and draft.values[key] != only:
            draft.refuse(key, f"not available yet; must be {only}", (str(only),))


def _dimension(draft: Draft) -> int | None:
    """Return the number of entries of grid.cells even if an entry is wrong, or None if that says nothing."""
    cells = draft.values["grid.cells"]
    return len(cells) if isinstance(cells, tuple) and 1 <= len(cells) <= 3 else None


def _along_x(first: Any, rest: Any, dim: int) -> tuple[Any, ...]:
    return (first, *[rest] * (dim - 1))


def _default_wave(v: Values, dim: int) -> tuple[int, ...]:
    return (1,) * dim if v["initial.profile"] == "standing-wave" else _along_x(1, 0, dim)


def _default_per_cell(v: Values, dim: int) -> tuple[int, ...]:
    return (4,) if v["particles.layout"] == "random" and dim > 1 else (2,) * dim


# Keys with an entry per axis: the keys that their default depends on, and the default.
AXIS_DEFAULTS: dict[str, tuple[tuple[str, ...], Callable[[Values, int], tuple[Any, ...]]]] = {
    "grid.length": ((), lambda v, dim: (1.0,) * dim),
    "gas.flow": ((), lambda v, dim: _along_x(0.05, 0.0, dim)),
    "initial.center": (("grid.length",), lambda v, dim: tuple(length / 2 for length in v["grid.length"])),
    "initial.wave": (("initial.profile",), _default_wave),
    "particles.per_cell": (("particles.layout",), _default_per_cell),
}


def _fill_axes(draft: Draft) -> None:
    """Set what was not given to its default for this dimension; check the number of entries of what was."""
    dim = _dimension(draft)
    for key, (needs, default) in AXIS_DEFAULTS.items():
        known = dim is not None and draft.good(*needs)
        draft.defaults[key] = default(draft.values, dim) if dim is not None and known else None
        if key not in draft.given:
            draft.values[key] = draft.defaults[key]
            if not known:
                draft.bad.add(key)
        elif known and draft.good(key) and not _unused_rule(draft, key):
            _check_entries(draft, key, dim)


def _check_entries(draft: Draft, key: str, dim: int | None) -> None:
    count = len(draft.values[key])
    if key == "particles.per_cell" and draft.values["particles.layout"] == "random":
        if count != 1:
            draft.refuse(key, 'must have exactly 1 entry with particles.layout = "random", the average per cell')
    elif count != dim:
        draft.refuse(key, f"must have as many entries as grid.cells, {dim}; it has {count}")


def _unused_rule(draft: Draft, key: str) -> str | None:
    """Return why nothing uses `key` with the present choices; None when something does or that is unknown."""
    if key not in USED_WITH:
        return None
    alternatives = USED_WITH[key]
    for chooser, users in alternatives:
        choice = draft.values[chooser]
        if not draft.good(chooser) or choice in users or (ABOVE_ZERO in users and choice > 0):
            return None
    chooser = alternatives[0][0]
    reason = f"has no effect with {chooser} = {show(draft.values[chooser])}"
    return f"{reason}; it is used with " + " or ".join(_named(*alternative) for alternative in alternatives)


def _named(chooser: str, users: tuple[str, ...]) -> str:
    """A chooser and those of its choices that can be used now, or all if none can."""
    now = [name for name in users if CHOICES.get(chooser, {}).get(name, chooser not in FIXED_FOR_NOW)]
    named = f"{chooser} {ABOVE_ZERO}" if ABOVE_ZERO in users else f"{chooser} = {', '.join(now or users)}"
    return named + ("" if now else ", not available yet")


def _check_unused(draft: Draft) -> None:
    """Refuse keys that were set and do nothing, unless they hold their default, as a resolved scene file does."""
    for key in USED_WITH:
        if key in draft.given and draft.good(key) and draft.defaults[key] is not None:
            rule = _unused_rule(draft, key)
            if rule and draft.values[key] != draft.defaults[key]:
                draft.refuse(key, rule)


def _choose_time_step(draft: Draft) -> None:
    """Of time.dt and time.cfl keep the one that was given; the default is a dt."""
    if "time.cfl" in draft.given:
        if "time.dt" in draft.given:
            dt = show(draft.values["time.dt"])
            draft.refuse("time.cfl", f"give either time.dt or time.cfl, not both; time.dt is {dt}")
        draft.values["time.dt"] = None
