"""The command line: `mpipic VERB`, the same under mpiexec. Rank 0 speaks; all ranks leave with the same code.

Exit codes: 0 done, 2 bad input, 3 unstable, 4 a solver did not converge, 130 interrupted,
1 output that could not be written, and anything unexpected.
"""

from __future__ import annotations

import gc
import os
import re
import shlex
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mpipic import __version__, streams
from mpipic.command_numbers import Number, count, to_output
from mpipic.errors import NotConverged, Refused, WriteFailed
from mpipic.runtime import launched, start

if TYPE_CHECKING:
    from mpi4py import MPI

    from mpipic.console import Rank
    from mpipic.mesh.petsc_options import Solvers
    from mpipic.scene.records import Scene

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

SceneFile = Annotated[
    Path | None, typer.Argument(help="Scene file (TOML); without one, the defaults: the paper's scene.")
]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a key, for example filter.kind=none.")
]

Preset = Annotated[
    str | None, typer.Option(help="Take the scheme by name, for example recommended, in place of the scene's own.")
]

NOT_WRITTEN, BAD_INPUT, NOT_CONVERGED = 1, 2, 4
PETSC_WORD = re.compile(r"-\w*(?:ksp|pc|svd|eps)_\w")
"""Matches an option of PETSc's."""


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"mpipic {__version__}")
        raise typer.Exit


@app.callback()
def before_the_verb(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and end.")
    ] = False,
) -> None:
    """Distributed particle-in-cell solver with null-space filters."""


def _load(
    path: Path | None,
    overrides: list[str] | None,
    comm: MPI.Comm,
    preset: str | None = None,
    compared: str = "",
    solvers: Solvers | None = None,
) -> Scene:
    """Read the scene on rank 0 and give it, or the refusal, to all; point out what nothing in it uses.

    `compared`: a section whose keys the verb hands to other choices than the scene's; `solvers`: the verb's own.
    """
    import mpipic.run.parts  # noqa: F401  all that scenes can name
    from mpipic.console import Console
    from mpipic.run.ranks import check_ranks
    from mpipic.scene.records import Scene, SceneError

    scene: Scene | SceneError | None = None
    if comm.rank == 0:
        try:
            scene = Scene.load(path, overrides or (), preset)
            check_ranks(scene, comm.size)
        except SceneError as error:
            scene = error
    scene = comm.bcast(scene)
    if isinstance(scene, SceneError):
        raise scene
    assert scene is not None
    console = Console(comm)
    for unused in scene.unused:
        if unused.key.split(".")[0] != compared:
            console.warning(str(unused))
    from mpipic.run.solver_options import unread_options

    for text in unread_options(scene, comm, compared == "filter", solvers):
        console.warning(text)
    return scene


def _refuse(text: str, comm: Rank, code: int = BAD_INPUT) -> typer.Exit:
    """Say what is wrong, once, and return what ends the verb."""
    from mpipic.console import Console

    console = Console(comm)
    for line in text.splitlines():
        console.fail(line)
    return typer.Exit(code)


@contextmanager
def _stating(comm: Rank, solves: bool = True) -> Iterator[None]:
    """Leave a verb that cannot go on with the error's own words, said once, and its exit code; no traceback.

    All ranks must raise the error together; one rank's alone would leave the others waiting. After a verb that solves,
    say which PETSc options nothing has read.
    """
    try:
        yield
    except WriteFailed as error:
        raise _refuse(str(error), comm, NOT_WRITTEN) from None
    except Refused as error:
        raise _refuse(str(error), comm) from None
    except NotConverged as error:
        raise _refuse(str(error), comm, NOT_CONVERGED) from None
    if solves:
        from mpipic.console import Console
        from mpipic.run.solver_options import left_over

        for text in left_over():
            Console(comm).warning(text)


@app.command()
def run(
    scene: SceneFile = None,
    set_: Overrides = None,
    preset: Preset = None,
    output: Annotated[Path | None, to_output("Run directory; default runs/<scene name>-<time>.")] = None,
    overwrite: Annotated[bool, typer.Option(help="Replace the results of an earlier run in --output.")] = False,
    plots: Annotated[bool, typer.Option(help="Draw error.png and solution.png at the end.")] = True,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print warnings and errors only.")] = False,
) -> None:
    """Run a scene: errors, times and pictures go to a run directory."""
    comm = start()
    with _stating(comm):
        loaded = _load(scene, set_, comm, preset)
        from mpipic.console import Console
        from mpipic.run import verb

        code = verb.run(loaded, comm, output, overwrite, Console(comm, quiet), plots)
    raise typer.Exit(code)


@app.command()
def check(
    scene: SceneFile = None,
    set_: Overrides = None,
    preset: Preset = None,
    keys: Annotated[bool, typer.Option("--keys", help="Print a table of all keys that scenes have, and end.")] = False,
) -> None:
    """Say what a scene builds, what it leaves out, and the memory it takes, without running it."""
    comm = start()
    if keys:
        import mpipic.run.parts  # noqa: F401  all that scenes can name
        from mpipic.scene.table import keys_as_markdown

        if comm.rank == 0:
            typer.echo(keys_as_markdown(), nl=False)
        return
    with _stating(comm, solves=False):
        loaded = _load(scene, set_, comm, preset)
        from mpipic.console import Console
        from mpipic.run.build import check_filter, check_particles, solution_of
        from mpipic.run.describe import describe

        solution_of(loaded)
        check_particles(loaded, comm)
        check_filter(loaded, loaded.particle_count or 0, comm)
        Console(comm).banner(describe(loaded, comm))


FilterNames = Annotated[
    list[str] | None,
    typer.Option("--filters", help="Which, for example local,order:5,exact; repeatable. Default: all that are quick."),
]


@app.command()
def spectrum(
    scene: SceneFile = None,
    set_: Overrides = None,
    names: FilterNames = None,
    output: Annotated[Path | None, to_output("Folder for spectrum.csv and .png; default runs/...")] = None,
    plots: Annotated[bool, typer.Option(help="Draw spectrum.png.")] = True,
    phase: Annotated[float, typer.Option(parser=Number(), help="Phase of the waves on node 0, in radians.")] = 0.3,
) -> None:
    """Say what one application of each filter keeps of every wave, on a scene's particles."""
    comm = start()
    with _stating(comm):
        loaded = _load(scene, set_, comm, compared="filter")
        from mpipic.analysis import spectrum as verb
        from mpipic.analysis.filter_choice import choose
        from mpipic.console import Console
        from mpipic.io.run_directory import RunDirectory

        choices = choose(names or (), loaded, loaded.particle_count or 0)
        folder = output or RunDirectory.default(f"{loaded.name}-spectrum", comm)
        verb.run(loaded, choices, comm, Console(comm), folder, plots, phase)


@app.command()
def filters(
    scene: SceneFile = None,
    set_: Overrides = None,
    names: FilterNames = None,
    output: Annotated[Path | None, to_output("Write the table as JSON too.")] = None,
) -> None:
    """Compare the filters on a scene's particles: cost, and distance from the exact projection."""
    comm = start()
    with _stating(comm):
        loaded = _load(scene, set_, comm, compared="filter")
        from mpipic.analysis import comparison
        from mpipic.analysis.filter_choice import choose
        from mpipic.console import Console

        choices = choose(names or (), loaded, loaded.particle_count or 0)
        comparison.run(loaded, choices, comm, Console(comm), output)


@app.command()
def study(
    file: Annotated[Path, typer.Argument(metavar="STUDY", help="Study file (TOML), such as configs/studies/*.toml.")],
    output: Annotated[Path | None, to_output("Folder of the results; default runs/<study name>.")] = None,
    aims: Annotated[
        list[str] | None,
        typer.Option("--recommend", metavar="AIM", help="error=1e-4: the cheapest setting; seconds=10: the best one."),
    ] = None,
    fresh: Annotated[bool, typer.Option("--fresh", help="Run everything again, whatever was run before.")] = False,
    retry: Annotated[
        bool, typer.Option("--retry", help="Run again what crashed, was refused or ran out of time.")
    ] = False,
) -> None:
    """Sweep settings of a scene: error against run time in a table, a picture and a page. Goes on where it stopped."""
    here = launched()
    if here.size > 1:
        raise _refuse("a study runs on one process and starts the ranks of its points itself: leave out mpiexec", here)
    from mpipic.console import Console
    from mpipic.study import verb

    words = ["mpipic", "study", str(file), *(["--output", str(output)] if output else [])]
    words += [word for aim in aims or () for word in ("--recommend", aim)]
    with _stating(here, solves=False):
        code = verb.run(file, output, aims or (), fresh, retry, shlex.join(words), Console(here))
    raise typer.Exit(code)


@app.command()
def stability(
    scene: SceneFile = None,
    set_: Overrides = None,
    preset: Preset = None,
    max_period: Annotated[
        int, typer.Option(parser=count(1_000_000), help="Most steps after which the pattern must recur.")
    ] = 1000,
    round_flow: Annotated[bool, typer.Option("--round-flow", help="Take the nearest flow that recurs.")] = False,
    maps: Annotated[
        list[str] | None, typer.Option("--map", help="KEY=FROM:TO:COUNT; give two for a map of growth.")
    ] = None,
    names: Annotated[
        list[str] | None, typer.Option("--filters", help="Panels of the map, for example local,order:2,exact.")
    ] = None,
    output: Annotated[Path | None, to_output("Folder for stability.json, or the map; default runs/...")] = None,
) -> None:
    """Compute by how much a scene's scheme grows per step, and when rounding noise blows it up."""
    comm = start()
    with _stating(comm):
        from mpipic.analysis import growth, growth_map

        loaded = _load(scene, set_, comm, preset, "filter" if maps else "", growth.solver_classes())
        from mpipic.analysis.filter_choice import choose
        from mpipic.console import Console
        from mpipic.io.run_directory import RunDirectory

        if maps:
            axes = [growth_map.parse_axis(text) for text in maps]
            own = loaded.filter.kind
            choices = choose(names or [own], loaded, loaded.particle_count or 0, unfiltered=True)
            growth_map.check_axes(loaded, axes, len(choices))
            folder = output or RunDirectory.default(f"{loaded.name}-stability", comm)
            growth_map.run(loaded, axes, choices, comm, Console(comm), folder, max_period)
        else:
            if round_flow:
                loaded = growth_map.with_flow(loaded, max_period)
            growth.run(loaded, comm, Console(comm), output, max_period)


@app.command()
def paper(
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Folder of the page; default runs/...")] = None,
    long: Annotated[bool, typer.Option("--long", help="Run the local filter until it fails, too.")] = False,
    overwrite: Annotated[bool, typer.Option(help="Replace an earlier paper.html and its figures.")] = False,
) -> None:
    """Draw the paper's figures anew, and hold its claims against numbers, on one page."""
    comm = start()
    with _stating(comm):
        from mpipic.analysis.growth import analyse
        from mpipic.console import Console
        from mpipic.figures import verb

        scene = _load(None, ["filter.kind=none"], comm)
        verb.run(verb.plan_of(scene, long), analyse, comm, Console(comm), output, overwrite)


@app.command()
def trials(
    short: Annotated[bool, typer.Option("--short", help="Only the cases that take no time.")] = False,
    only: Annotated[list[str] | None, typer.Option(help="Cases whose name contains this; repeatable.")] = None,
    output: Annotated[Path | None, to_output("Write the table as JSON too.")] = None,
) -> None:
    """Run stiff and extreme cases, and judge each: a right answer, a stated end, or a refusal with a reason."""
    comm = start()
    from mpipic.analysis import trials as verb
    from mpipic.console import Console

    with _stating(comm):
        judged = verb.run(comm, Console(comm), output, short, only)
    raise typer.Exit(1 if any(item.verdict != "good" for item in judged) else 0)


@app.command()
def bench(
    dim: Annotated[
        list[int] | None, typer.Option(parser=count(3), help="Dimension to time; repeatable. Default: 1 2 3.")
    ] = None,
    particles: Annotated[int, typer.Option(parser=count(10**11), help="Particles, about.")] = 10_000_000,
    per_cell: Annotated[int, typer.Option(parser=count(10_000), help="Particles per cell, about.")] = 4,
    kind: Annotated[list[str] | None, typer.Option("--filter", help="Repeatable. Default: local.")] = None,
    layout: Annotated[str, typer.Option(help="lattice, jittered or random.")] = "jittered",
    steps: Annotated[int, typer.Option(parser=count(1_000_000), help="Steps per sample.")] = 5,
    repeats: Annotated[int, typer.Option(parser=count(1000), help="Samples; the median counts.")] = 5,
    tolerance: Annotated[
        float, typer.Option(parser=Number(0, 1, open=True), help="Relative residual of the exact filter.")
    ] = 1e-8,
    basis: Annotated[str, typer.Option(help="linear, quadratic or cubic.")] = "linear",
    preset: Annotated[str | None, typer.Option(help="A scheme by name, in place of basis and filters.")] = None,
    output: Annotated[Path | None, to_output("Write the numbers as JSON too.")] = None,
) -> None:
    """Time steps against the memory bandwidth of this machine, measured in the same run."""
    comm = start()
    from mpipic.analysis import bench as benchmark
    from mpipic.console import Console

    with _stating(comm):
        plan = benchmark.Plan(
            tuple(dim or (1, 2, 3)),
            particles,
            per_cell,
            (preset,) if preset else tuple(kind or ("local",)),
            layout,
            steps,
            repeats,
            tolerance,
            basis,
            preset,
        )
        benchmark.run(plan, comm, Console(comm), output)


def main() -> None:
    """Run the command line, as `mpipic` and `python -m mpipic`. Help and usage errors appear once, not once a rank."""
    streams.settle()
    first = launched().rank == 0
    if not first:
        warnings.simplefilter("ignore", RuntimeWarning)
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115  for the life of the process
    try:
        code = app(standalone_mode=False)
    except Exception as error:
        if not hasattr(error, "exit_code"):
            raise
        if first and hasattr(error, "show"):
            error.show()
            if any(PETSC_WORD.match(word) for word in sys.argv):
                sys.stderr.write('Options of PETSc go into a variable: PETSC_OPTIONS="-filter_ksp_monitor"\n')
        code = error.exit_code
    if code:
        gc.collect()  # of what an error kept alive: PETSc waits for the other ranks as it frees its objects
    sys.exit(code)
