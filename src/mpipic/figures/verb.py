"""The verb `paper`: figures 1 to 8 of the paper, the numbers behind each, and a page that judges its claims."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

from mpi4py import MPI

from mpipic.agreement import on_first
from mpipic.arrays import FloatArray
from mpipic.console import Console
from mpipic.errors import OutputError
from mpipic.figures.claims import Claim
from mpipic.figures.costs import TIMED, exponent
from mpipic.figures.gradients import COLUMNS
from mpipic.figures.map_files import ERRORS, STEPS, tables, write_maps
from mpipic.figures.plan import Analyse, Plan
from mpipic.figures.results import Results, compute, judge, scene_text
from mpipic.files import write_csv, write_text
from mpipic.io.run_directory import RunDirectory
from mpipic.page import embedded, fill
from mpipic.run.facts import versions

if TYPE_CHECKING:
    from mpipic.scene.records import Scene

PAGE, TEMPLATE = "paper.html", "paper.html.jinja"
LONG_STEPS = 90_000
"""Steps within which the local filter must have failed: it is predicted for 55 000, and rounding may begin lower."""
TITLES = {
    1: "Figure 1: computed against true gradient of g(x) = exp(-60 (x - 1/2)²)",
    2: "Figure 2: null-space part of the computed gradient",
    3: "Figure 3: gradient with the null-space part removed (svd)",
    4: "Figure 4: gradient under the local filter",
}
SHOWN = {1: ("computed", "computed"), 2: ("null_space", "null-space part"), 3: ("svd", "svd"), 4: ("local", "local")}
"""Number of a figure to its column and what the legend calls it."""


@dataclass(frozen=True)
class Shown:
    """A figure as the page shows it: name of its files, title, source of the image, a note, and its claims."""

    name: str
    title: str
    image: str
    note: str
    claims: Sequence[Claim]


def plan_of(scene: Scene, long: bool) -> Plan:
    """Return what the verb computes of a scene."""
    return Plan(scene, long_steps=LONG_STEPS if long else 0)


def run(plan: Plan, analyse: Analyse, comm: MPI.Comm, console: Console, output: Path | None, overwrite: bool) -> None:
    """Compute, draw and judge; write figure-1.png and .csv to figure-8, costs and paper.html. Collective.

    Raises
    ------
    OutputError
        The folder cannot be written, or holds a paper.html that is not to be replaced; on all ranks.
    """
    began = perf_counter()
    folder = output or RunDirectory.default("paper", comm)
    on_first(comm, lambda: _prepare(folder, overwrite))
    results = compute(plan, analyse, comm, console)
    judged = judge(plan, results)
    facts = {"ranks": comm.size, "seconds": f"{perf_counter() - began:.0f}", **versions()}
    on_first(comm, lambda: _write(folder, plan, results, judged, facts))
    rows = [(claim.where, claim.verdict) for claim in judged]
    console.table("claims of the paper", ("of", "verdict"), rows)
    console.message(f"results in {folder}: open {folder / PAGE}")


def _prepare(folder: Path, overwrite: bool) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OutputError(f"folder {folder} cannot be written: permission denied")
    if (folder / PAGE).exists() and not overwrite:
        rule = "name another folder by --output, or replace it by --overwrite"
        raise OutputError(f"output folder {folder} already holds {PAGE}: {rule}")


# ------------------------------------------------------------ writing


def _write(folder: Path, plan: Plan, results: Results, judged: Sequence[Claim], facts: Mapping[str, object]) -> None:
    """Write all files, the page last. Local."""
    shown = [*_write_gradients(folder, results), *_write_waves(folder, plan, results), _write_costs(folder, results)]
    mine = {one.name: [claim for claim in judged if _figure_of(claim) == one.name] for one in shown}
    figures = [replace(one, claims=mine[one.name], image=embedded(folder / f"{one.name}.png")) for one in shown]
    write_maps(folder, plan.survey, results.survey)
    page = fill(
        "mpipic.figures",
        TEMPLATE,
        claims=judged,
        figures=figures,
        others=[claim for claim in judged if _figure_of(claim) not in mine],
        maps=[embedded(folder / f"{name}.png") for name in (STEPS, ERRORS)],
        survey=plan.survey,
        tables=tables(results.survey, plan.last),
        command=_command(plan, int(str(facts["ranks"]))),
        facts=facts,
        scene=scene_text(plan.scene),
    )
    write_text(folder / PAGE, page)


def _figure_of(claim: Claim) -> str:
    """Return the name of the figure that shows a claim; costs have one of their own, which the paper has not."""
    return f"figure-{claim.figure}" if claim.figure else "costs" if "complexity" in claim.quote else ""


def _command(plan: Plan, ranks: int) -> str:
    launch = f"mpiexec -n {ranks} python -m " if ranks > 1 else ""
    return f"{launch}mpipic paper{' --long' if plan.long_steps else ''}"


def _save(folder: Path, name: str, columns: Mapping[str, FloatArray]) -> None:
    write_csv(folder / f"{name}.csv", list(columns), zip(*columns.values(), strict=True))


def _write_gradients(folder: Path, results: Results) -> list[Shown]:
    from mpipic.plots.paper import draw_gradient

    shown = []
    for figure, names in COLUMNS.items():
        columns = {name: results.gradients[name] for name in names}
        column, label = SHOWN[figure]
        draw_gradient(
            folder / f"figure-{figure}.png", TITLES[figure], columns["x"], columns[column], label, columns.get("true")
        )
        _save(folder, f"figure-{figure}", columns)
        shown.append(Shown(f"figure-{figure}", TITLES[figure], "", "", ()))
    return shown


def _write_waves(folder: Path, plan: Plan, results: Results) -> list[Shown]:
    from mpipic.plots.paper import draw_wave

    shown = []
    for figure, step in enumerate(plan.steps, len(COLUMNS) + 1):
        name, columns = f"figure-{figure}", results.waves[step]
        title = f"Figure {figure}: density at step {step:,}, t = {step * plan.scene.dt:g}"
        waves = {label: columns[label] for label in plan.filters}
        draw_wave(folder / f"{name}.png", title, columns["x"], columns["exact"], waves)
        _save(folder, name, columns)
        shown.append(Shown(name, title, "", "Lines that leave the frame are clipped, and the legend says so.", ()))
    return shown


def _write_costs(folder: Path, results: Results) -> Shown:
    from mpipic.plots.paper import draw_costs

    lines = {}
    for kind in TIMED:
        mine = [one for one in results.costs if one.filter == kind]
        note = f"m^{exponent(results.costs, kind):.2f}"
        lines[kind] = [one.nodes for one in mine], [one.seconds for one in mine], note
    title = "Cost of a filter at new positions"
    draw_costs(folder / "costs.png", title, lines)
    rows = ((one.filter, one.nodes, one.seconds) for one in results.costs)
    write_csv(folder / "costs.csv", ("filter", "nodes", "seconds"), rows)
    return Shown("costs", title, "", "Exponents are those of the three largest grids, on one process.", ())
