"""A study as one HTML page that opens from disk: picture and script are in it, and nothing is fetched."""

from __future__ import annotations

import base64
import tomllib
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from mpipic.scene.text import write_toml
from mpipic.study.file import Study
from mpipic.study.points import differing
from mpipic.study.results import Row, columns, orders

REPORT = "report.html"
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; background: #fff;
  max-width: 75rem; margin: 2rem auto; padding: 0 1rem }
h1 { font-size: 1.5rem; margin-bottom: .2rem } h2 { font-size: 1.15rem; margin-top: 2rem }
img { max-width: 100%; height: auto } pre { background: #f4f4f4; padding: .8rem; overflow-x: auto; font-size: 13px }
.wide { overflow-x: auto } table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 13px }
th, td { padding: .25rem .6rem; border-bottom: 1px solid #ddd; text-align: left; white-space: nowrap }
td.number { text-align: right } tr.front { background: #eaf2f8 } tr.failed td { color: #888 }
td.message { white-space: normal }
th button { all: unset; cursor: pointer; font-weight: 600 } th button:focus-visible { outline: 2px solid #0072B2 }
th[aria-sort=ascending] button::after { content: " \\25B2" }
th[aria-sort=descending] button::after { content: " \\25BC" }
"""
SCRIPT = """
for (const button of document.querySelectorAll("table.sortable th button")) button.onclick = () => {
  const head = button.parentElement, body = head.closest("table").tBodies[0], column = head.cellIndex;
  const down = head.getAttribute("aria-sort") === "ascending";
  for (const other of head.parentElement.cells) other.removeAttribute("aria-sort");
  head.setAttribute("aria-sort", down ? "descending" : "ascending");
  const key = row => row.cells[column].dataset.value ?? row.cells[column].textContent;
  const order = (a, b) => {
    if (a === "" || b === "") return (a === "") - (b === "");
    const by = isNaN(a) || isNaN(b) ? a.localeCompare(b, undefined, {numeric: true}) : a - b;
    return down ? -by : by;
  };
  body.append(...[...body.rows].sort((a, b) => order(key(a), key(b))));
};
"""
SHOWN = {
    "scheme": "scheme", "resolution": "resolution", "status": "status", "ranks": "ranks", "particles": "particles",
    "steps": "steps", "dt": "dt", "cfl": "CFL",
    "density_l1": "density l1", "density_l2": "density l2", "density_linf": "density l∞",
    "velocity_l1": "velocity l1", "velocity_l2": "velocity l2", "velocity_linf": "velocity l∞",
    "seconds": "seconds of stepping", "seconds_min": "least", "seconds_max": "largest",
    "total_seconds": "total seconds",
    "particle_steps_per_second": "particle-steps/s", "peak_memory": "peak MB", "repeats": "runs", "id": "id",
    "message": "remark",
}  # fmt: skip


def page(study: Study, rows: Sequence[Row], facts: Mapping[str, Any], picture: Path) -> str:
    """The page; everything that a file or a user names is escaped."""
    image = base64.b64encode(picture.read_bytes()).decode()
    norm = study.settings.error.replace(".", " ")
    repeats = study.settings.repeats
    return f"""<!DOCTYPE html>
<html lang="en">
<head><meta charset="utf-8"><title>{escape(study.title)}</title><style>{STYLE}</style></head>
<body>
<h1>{escape(study.title)}</h1>
<p>{len(rows)} points to t = {study.settings.until:g}, each run {repeats} time{"s" if repeats > 1 else ""}: medians.
Errors are those at the end, {escape(norm)} in the picture.</p>
<img alt="{escape(norm)} error against seconds of stepping, a line a scheme" src="data:image/png;base64,{image}">
<h2>Points</h2>
<p>On the Pareto front (shaded) nothing is both faster and as accurate, or as fast and more accurate. The times of an
unstable point end where it blew up. Peak memory is that of the largest process. A heading sorts.</p>
<div class="wide">{_points(rows)}</div>
{_orders(rows)}
<h2>Reproduce</h2>
<pre>{escape(facts["command"])}</pre>
<p>One point: <code>mpipic run scenes/ID.toml</code> in this folder; its first line says on what ranks.</p>
<h2>Machine and versions</h2>
{_facts({**facts["machine"], **facts["versions"]})}
<h2>Settings</h2>
<p>The study file:</p>
<pre>{escape(study.source)}</pre>
<p>Resolved, what all points share; they differ in {escape(", ".join(differing(study.points)) or "nothing")}:</p>
<pre>{escape(_shared(study))}</pre>
<script>{SCRIPT}</script>
</body>
</html>
"""


def _points(rows: Sequence[Row]) -> str:
    measured = [columns(row) for row in rows]
    shown = {key: name for key, name in SHOWN.items() if any(one[key] not in (None, "") for one in measured)}
    body = []
    for row, one in zip(rows, measured, strict=True):
        kind = "front" if row.on_front else "" if row.is_stable else "failed"
        body.append(f'<tr class="{kind}">' + "".join(_cell(key, one[key]) for key in shown) + "</tr>")
    return _table(shown.values(), body, "sortable")


def _orders(rows: Sequence[Row]) -> str:
    found = orders(rows)
    if not found:
        return ""
    body = [
        "<tr>"
        + f"<td>{escape(order.label)}</td>"
        + _cell("order", round(order.fit.order, 3))
        + _cell("residual", order.fit.residual)
        + _cell("count", order.fit.count)
        + _cell("left_out", order.left_out)
        + "</tr>"
        for order in found
    ]
    header = ("scheme", "order", "residual", "points", "left out")
    return f"""<h2>Observed order of convergence</h2>
<p>Slope of ln error against ln h by least squares over points that differ only in grid.cells; the residual is the root
mean square distance of ln error from the line. Points below ten times the floor, 2.2e-16 times the steps plus
filter.tolerance where a solver is used, are left out.</p>
{_table(header, body, "sortable")}"""


def _table(header: Any, body: Sequence[str], kind: str) -> str:
    heads = "".join(f"<th><button>{escape(name)}</button></th>" for name in header)
    return f'<table class="{kind}"><thead><tr>{heads}</tr></thead><tbody>{"".join(body)}</tbody></table>'


def _cell(key: str, value: Any) -> str:
    if value is None or value == "":
        return '<td data-value=""></td>'
    if isinstance(value, str):
        return f'<td class="{"message" if key == "message" else "text"}">{escape(value)}</td>'
    shown = f"{value / 1e6:.0f}" if key == "peak_memory" else f"{value:,}" if isinstance(value, int) else f"{value:.4g}"
    return f'<td class="number" data-value="{value!r}">{shown}</td>'


def _facts(facts: Mapping[str, Any]) -> str:
    rows = (f"<tr><th>{escape(str(name))}</th><td>{escape(str(value))}</td></tr>" for name, value in facts.items())
    return f"<table>{''.join(rows)}</table>"


def _shared(study: Study) -> str:
    """The resolved settings that all points have in common, as a scene file."""
    apart = set(differing(study.points))
    scene = tomllib.loads(study.points[0].scene.to_toml())
    tables = {s: {k: v for k, v in table.items() if f"{s}.{k}" not in apart} for s, table in scene.items()}
    return write_toml({section: table for section, table in tables.items() if table})
