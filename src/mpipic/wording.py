"""How messages show values and names: as a scene file would hold them, short, and free of control characters."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from difflib import get_close_matches

LONGEST_SHOWN = 80
DEEPEST_SHOWN = 3


def escape(text: str) -> str:
    """Return `text` with everything that a terminal would not print plainly written as a backslash escape."""
    return "".join(ch if ch.isprintable() else ch.encode("unicode_escape").decode("ascii") for ch in text)


def shorten(text: str, longest: int = LONGEST_SHOWN) -> str:
    """Return `text`, cut to `longest` characters, the last three of them dots, if it is longer."""
    return text if len(text) <= longest else text[: longest - 3] + "..."


def show(value: object, depth: int = 0) -> str:
    """Return `value` as a scene file would hold it, escaped and shortened for a message."""
    if isinstance(value, bool):
        text = str(value).lower()
    elif isinstance(value, int) and value.bit_length() > 128:
        text = f"a whole number of {value.bit_length()} bits"
    elif isinstance(value, str):
        text = '"' + escape(shorten(value).replace("\\", "\\\\").replace('"', '\\"')) + '"'
    elif isinstance(value, (list, tuple, dict)) and depth >= DEEPEST_SHOWN:
        text = "..."
    elif isinstance(value, (list, tuple)):
        text = "[" + ", ".join(show(item, depth + 1) for item in value[:LONGEST_SHOWN]) + "]"
    elif isinstance(value, dict):
        items = list(value.items())[:LONGEST_SHOWN]
        text = "{" + ", ".join(f"{show_key(str(key))} = {show(item, depth + 1)}" for key, item in items) + "}"
    else:
        text = escape(str(value))
    return shorten(text, 2 * LONGEST_SHOWN)


def show_key(*parts: str) -> str:
    """Return a dotted key, quoting the parts that TOML would quote."""
    return ".".join(part if re.fullmatch(r"[A-Za-z0-9_-]+", part) else show(part) for part in parts)


def closest(word: object, names: Sequence[str]) -> str | None:
    """Return the name most like `word`, or None when nothing is close. Case and ``_``/``-`` do not count."""
    if not isinstance(word, str):
        return None
    plain = {name.lower().replace("_", "-"): name for name in reversed(names)}
    found = get_close_matches(word[:LONGEST_SHOWN].lower().strip().replace("_", "-"), list(plain), n=1)
    return plain[found[0]] if found else None


def listed(names: Iterable[str], last: str = "and") -> str:
    """Return names in words: `a`, `a and b`, `a, b and c`."""
    *first, end = names
    return f"{', '.join(first)} {last} {end}" if first else end
