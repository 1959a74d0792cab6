"""All keys that scenes can have as a table in Markdown, made from what the parts say of themselves."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from mpipic import parts
from mpipic.keys import ByScene, Key
from mpipic.parts import Part
from mpipic.wording import show

HEADER = """# Keys of a scene file

Written by `mpipic check --keys`; a test holds this file to the code.

A scene has the keys of the choices that it names. A key that only other choices take is said once as a warning and left
out. Lists have an entry per axis unless their rule says otherwise. Units are any consistent ones.
"""


def keys_as_markdown() -> str:
    """Return a chapter for each section: its keys, and what can be chosen there."""
    return "\n".join([HEADER, *(_section(name) for name in parts.sections())])


def _section(section: str) -> str:
    own = [part for part in parts.registered() if part.section() == section]
    plain = [part for part in own if not part.kind]
    slots = list(dict.fromkeys(part.slot for part in own if part.kind))
    lines = [f"## [{section}]", "", *(f"{part.about.capitalize()}.\n" for part in plain)]
    lines += ["| key | default | must be | taken by | meaning |", "| --- | --- | --- | --- | --- |"]
    for part in plain:
        lines += [_key_row(one, ["always"], _either(part, name)) for name, one in part.keys().items()]
    for slot in slots:
        lines += _slot_rows(slot, [part for part in own if part.slot == slot])
    lines.append("")
    for slot in slots:
        lines += [f"| {slot} | |", "| --- | --- |"]
        lines += [_row(f"`{part.kind}`", part.about) for part in own if part.slot == slot]
        lines.append("")
    return "\n".join(lines)


def _slot_rows(slot: str, choices: Sequence[type[Part]]) -> list[str]:
    """Return the row of what chooses, and of every key of the choices; one row for choices that declare it alike."""
    kinds = [part.kind for part in choices]
    default = next(part.kind for part in choices if vars(part).get("is_default"))
    rule = f"one of {', '.join(kinds)}" if len(kinds) > 1 else kinds[0]
    rows = [_row(f"`{slot}`", f"`{show(default)}`", rule, "always", "see below")]
    takers: dict[tuple[str, str, str], list[str]] = {}
    keys: dict[tuple[str, str, str], Key] = {}
    for part in choices:
        for one in part.keys().values():
            alike = (one.dotted, one.rule, _default(one))
            takers.setdefault(alike, []).append(part.kind)
            keys.setdefault(alike, one)
    return [*rows, *(_key_row(keys[alike], kinds) for alike, kinds in takers.items())]


def _key_row(key: Key, kinds: Iterable[str], default: str | None = None) -> str:
    return _row(f"`{key.dotted}`", default or _default(key), key.rule, ", ".join(kinds), key.meaning)


def _either(part: type[Part], name: str) -> str | None:
    """Return what stands for the default of a key that is given in place of another one."""
    return f"`{part.either[0]}` counts" if name in part.either[1:] else None


def _default(key: Key) -> str:
    return key.default.text if isinstance(key.default, ByScene) else f"`{show(key.default)}`"


def _row(*entries: str) -> str:
    return "| " + " | ".join(entry.replace("|", "\\|") for entry in entries) + " |"
