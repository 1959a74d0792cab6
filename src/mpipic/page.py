"""Pages of results share these: one style, and a template filled in that escapes what others have named."""

from __future__ import annotations

import base64
from importlib import resources
from pathlib import Path

STYLE = """\
body { font: 15px/1.5 system-ui, sans-serif; color: #222; background: #fff;
  max-width: 75rem; margin: 2rem auto; padding: 0 1rem }
h1 { font-size: 1.5rem; margin-bottom: .2rem } h2 { font-size: 1.15rem; margin-top: 2rem }
img { max-width: 100%; height: auto } pre { background: #f4f4f4; padding: .8rem; overflow-x: auto; font-size: 13px }
.wide { overflow-x: auto } table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 13px }
th, td { padding: .25rem .6rem; border-bottom: 1px solid #ddd; text-align: left; white-space: nowrap }
td.number { text-align: right } tr.front { background: #eaf2f8 } tr.failed td { color: #888 }
td.message { white-space: normal }
"""


def fill(room: str, template: str, **values: object) -> str:
    """Return the template of a room with these values in it; a value that is missing is an error."""
    from jinja2 import Environment, StrictUndefined

    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    source = resources.files(room).joinpath(template).read_text("utf-8")
    return environment.from_string(source).render(style=STYLE, **values)


def embedded(picture: Path) -> str:
    """Return a PNG file as a page can hold it, the source of an image."""
    return "data:image/png;base64," + base64.b64encode(picture.read_bytes()).decode()
