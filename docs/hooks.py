"""Fills api.md with the docstrings of what `import mpipic` offers, whenever the site is built."""

from __future__ import annotations

import inspect
import itertools
import re

import mpipic

LISTED = ("Parameters", "Attributes", "Returns", "Raises")
"""Headings of docstrings below which each line that is not indented begins an entry."""


def on_page_markdown(markdown: str, page, **_: object) -> str:
    """Return the page, the API in place of its mark."""
    return markdown.replace("<!-- API -->", api()) if page.file.src_uri == "api.md" else markdown


def api() -> str:
    """Return Markdown of all public names, classes with their public members."""
    return "\n".join(_entry(name, getattr(mpipic, name)) for name in mpipic.__all__)


def _entry(name: str, found: object) -> str:
    if not inspect.isclass(found):
        return f"## {name}\n\n{', '.join(f'`{kind}`: {cls.__name__}' for kind, cls in dict(found).items())}\n"
    text = [f"## {name}\n\n{_code(name, found)}{_prose(inspect.getdoc(found) or '')}"]
    for base in reversed(found.__mro__):
        of_ours = base.__module__.startswith("mpipic") and base.__module__ != "mpipic.parts"
        for verb in vars(base) if of_ours else ():
            if not verb.startswith("_"):
                text += _member(name, verb, inspect.getattr_static(found, verb))
    return "\n".join(dict.fromkeys(text))


def _member(name: str, verb: str, member: object) -> list[str]:
    called = member.__func__ if isinstance(member, (classmethod, staticmethod)) else member
    about = inspect.getdoc(called)
    if not about or inspect.isclass(called):
        return []
    if inspect.isfunction(called):
        return [f"### {name}.{verb}\n\n{_code(verb, called)}{_prose(about)}"]
    return [f"### {name}.{verb}\n\n{_prose(about)}"] if isinstance(called, property) else []


def _code(name: str, called: object) -> str:
    try:
        signature = inspect.signature(called)
    except (TypeError, ValueError):
        return ""
    plain = [one.replace(annotation=inspect.Parameter.empty) for one in signature.parameters.values()]
    words = ", ".join(str(one) for one in plain if one.name not in ("self", "cls"))
    return f"```python\n{name}({words})\n```\n\n"


def _prose(doc: str) -> str:
    """Return a docstring with its headings in bold, its definitions as lists, and no other Markdown in it."""
    lines, listing = [], False
    for line, below in itertools.pairwise([*doc.replace("`", "'").splitlines(), ""]):
        words = re.sub(r"([*_<>\\|#\[\]])", r"\\\1", line.strip())
        if re.fullmatch("-{3,}", below):
            listing = line in LISTED
            lines.append(f"\n**{words}**\n")
        elif not re.fullmatch("-{3,}", line):
            first = listing and line and not line.startswith(" ")
            lines.append(f"- {words}" if first else f"  {words}" if listing else words)
    return "\n".join(lines) + "\n"
