"""The verb `study`: settings of a scene swept, error against run time in tables, a picture and a page.

Every run is a process of its own, so that none can end the study, and none is slowed down by what came before it.
All points run once before any runs again: a machine that gets slower does so for all of them.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from mpipic.console import Console, duration
from mpipic.errors import OutputError, WriteFailed
from mpipic.files import reason, write_json, write_text
from mpipic.plots.work_precision import draw_work_precision
from mpipic.scene.records import Problem, SceneError
from mpipic.study import report
from mpipic.study.file import Study, load
from mpipic.study.journal import COMPLETED, FAILED, UNSTABLE, Journal, Record
from mpipic.study.pareto import cheapest, most_accurate
from mpipic.study.points import Point, unused, words
from mpipic.study.results import (
    CSV,
    JSON,
    NOT_RUN,
    Origin,
    Row,
    content,
    joined,
    marks,
    orders,
    stable_pairs,
    sum_up,
    write_table,
)
from mpipic.study.runs import SCENES, interruptible, launcher, machine, run_once, scene_file, write_scenes

PICTURE = "work-precision.png"
INTERRUPTED, NOTHING_CAME_OF_IT = 130, 1
AIMS = ("error", "seconds")


def run(
    path: Path, output: Path | None, aims: Sequence[str], fresh: bool, retry: bool, command: str, console: Console
) -> int:
    """Run what is still to be run of a study, and write and print what it amounts to; returns the exit code.

    0 when every point has been run, 1 when none of them gave a result, 130 interrupted.

    Parameters
    ----------
    path : study file
    output : folder; default runs/<name of the study>
    aims : such as error=1e-4 or seconds=10
    fresh, retry : forget every run of before, or those that failed
    command : what reproduces the study, for its page

    Raises SceneError or OutputError before anything runs; WriteFailed when the disk fails, with the runs so far kept.
    """
    wanted = parse_aims(aims)
    study = _load(path, console)
    folder = output or Path("runs") / (study.name.strip(".") or "study")
    journal = _open(folder, fresh)
    with closing(journal):
        journal.forget(study.points, study.settings.timeout, FAILED if retry else ())
        finished = _run_all(study, folder, journal, console)
        runs = [journal.of(point) for point in study.points]
    rows = sum_up(study, runs)
    _say(study, rows, console)
    _warn_of_mixture(runs, console)
    _write(study, folder, rows, runs, command)
    for aim, value in wanted:
        console.message(recommend(rows, aim, value, folder))
    console.message(f"results in {folder}")
    if not finished:
        console.warning("interrupted; the same command goes on from here")
        return INTERRUPTED
    return 0 if any(row.status in (COMPLETED, UNSTABLE) for row in rows) else NOTHING_CAME_OF_IT


def _load(path: Path, console: Console) -> Study:
    """Return the study, once it is known that it can run; point out what its points say and do not use."""
    study = load(path)
    if launcher() is None and any(point.ranks > 1 for point in study.points):
        raise SceneError([Problem("ranks", None, "needs mpiexec, and there is none; name one by MPIPIC_MPIEXEC")])
    for text in unused(study.points):
        console.warning(text)
    return study


def _open(folder: Path, fresh: bool) -> Journal:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"output folder {folder} cannot be created: {error.strerror or error}") from None
    journal = Journal(folder, fresh)
    _clear(folder)
    return journal


def _clear(folder: Path) -> None:
    """Remove what runs were writing whose study was killed, or interrupted as it cleared up."""
    for left in folder.glob(".run-*"):
        shutil.rmtree(left, ignore_errors=True)


# ------------------------------------------------------------ running


def outstanding(study: Study, journal: Journal) -> list[tuple[Point, int]]:
    """Return what is still to be run, (point, repeat): every point once, then again; never what has failed."""
    first: dict[str, Point] = {point.id: point for point in study.points}
    found = []
    for repeat in range(1, study.settings.repeats + 1):
        for point in first.values():
            done = journal.of(point)
            if all(r["status"] == COMPLETED for r in done) and repeat not in {r["repeat"] for r in done}:
                found.append((point, repeat))
    return found


def _run_all(study: Study, folder: Path, journal: Journal, console: Console) -> bool:
    """Run what is outstanding; False if interrupted."""
    due = outstanding(study, journal)
    total = len({point.id for point in study.points}) * study.settings.repeats
    console.message(f"{study.title}: {len(study.points)} points, {len(due)} of {total} runs to do, results in {folder}")
    failed: set[str] = set()
    try:
        write_scenes(folder, study.points)
        with interruptible():
            for number, (point, repeat) in enumerate(due, 1):
                if point.id in failed:
                    continue
                record = run_once(point, scene_file(folder, point), repeat, study.settings.timeout)
                journal.add(record)
                if record["status"] != COMPLETED:
                    failed.add(point.id)
                console.message(f"[{number}/{len(due)}] {point.label}, run {repeat}: {_outcome(record, study)}")
    except OSError as error:
        raise WriteFailed(f"{error.filename or folder} cannot be written: {reason(error)}") from error
    except KeyboardInterrupt:
        _clear(folder)
        return False
    return True


def _outcome(record: Record, study: Study) -> str:
    clock, errors = record.get("seconds"), record["errors"]
    if record["status"] != COMPLETED or clock is None or errors is None:
        return f"{record['status']}: {record['message']}"
    quantity, norm = study.settings.error.split(".")
    error = errors[quantity][norm]
    spent = f"{clock['step']:.3g} s of stepping, {duration(record['wall_seconds'])} in all"
    return f"error {'not finite' if error is None else f'{error:.3e}'}, {spent}"


# ------------------------------------------------------------ recommending


def parse_aims(texts: Sequence[str]) -> list[tuple[str, float]]:
    """Read error=NUMBER and seconds=NUMBER; raises SceneError with all that are neither."""
    found, problems = [], []
    for text in texts:
        name, _, number = text.partition("=")
        try:
            value = float(number)
        except ValueError:
            value = 0.0
        if name.strip() not in AIMS or not 0 < value < float("inf"):
            rule = "must be error=NUMBER or seconds=NUMBER, above 0, for example error=1e-4"
            problems.append(Problem(f"--recommend {text}", None, rule, AIMS))
        else:
            found.append((name.strip(), value))
    if problems:
        raise SceneError(problems)
    return found


def recommend(rows: Sequence[Row], aim: str, value: float, folder: Path) -> str:
    """Return in words the cheapest completed point that reaches an error, or the most accurate within the seconds."""
    stable, pairs = stable_pairs(rows)
    wish = f"for an error of at most {value:g}" if aim == "error" else f"within {value:g} s of stepping"
    if not stable:
        return f"{wish}: no point completed"
    choose = cheapest if aim == "error" else most_accurate
    index = choose(pairs, value)
    if index is not None:
        row = stable[index]
        launch = f"mpiexec -n {row.point.ranks} " if row.point.ranks > 1 else ""
        how = f"{launch}python -m mpipic run {folder / SCENES / row.point.id}.toml"
        return f"{wish}: {row.point.label}: {_pair(*pairs[index])}; {how}"
    nearest = min(range(len(pairs)), key=lambda i: pairs[i][1] if aim == "error" else pairs[i][0])
    best = "most accurate" if aim == "error" else "fastest"
    return f"{wish}: no completed point; the {best} is {stable[nearest].point.label}: {_pair(*pairs[nearest])}"


def _pair(seconds: float, error: float) -> str:
    return f"error {error:.3e} in {seconds:.3g} s"


# ------------------------------------------------------------ results


def _write(study: Study, folder: Path, rows: Sequence[Row], runs: Sequence[Sequence[Record]], command: str) -> None:
    every = [record for of_it in runs for record in of_it]
    versions = next((told for record in reversed(every) if (told := record.get("versions"))), {})
    origin = Origin(command, every[-1]["machine"] if every else machine(), versions)
    write_table(folder / CSV, study, rows)
    write_json(folder / JSON, content(study, rows, runs, origin))
    error = f"error, {study.settings.error.replace('.', ' ')} at t = {study.settings.until:g}"
    draw_work_precision(folder / PICTURE, marks(study, rows), study.title, error, _note(study, rows))
    write_text(folder / report.REPORT, report.page(study, rows, origin, folder / PICTURE))


def _note(study: Study, rows: Sequence[Row]) -> str:
    """Return what joined points have in common, and how many points the picture leaves out, and why."""
    axis = joined(study)
    along = [words(axis.name, choice.value) for choice in axis.choices] if axis else []
    along = [*(text.removesuffix(" cells") for text in along[:-1]), *along[-1:]]
    notes = [f"along a line: {', '.join(along)}"] if along else []
    missing = [row.status for row in rows if row.status in (*FAILED, NOT_RUN)]
    counts = [f"{missing.count(status)} {status}" for status in dict.fromkeys(missing)]
    return "; ".join([*notes, *([f"not shown: {', '.join(counts)}"] if counts else [])])


def _say(study: Study, rows: Sequence[Row], console: Console) -> None:
    norm = study.settings.error.replace(".", " ")
    header = ("scheme", "resolution", norm, "seconds", "from..to", "MB", "front")
    console.table(study.title, header, [_entries(row) for row in rows])
    found = orders(rows)
    if found:
        cells = [
            [o.label, f"{o.fit.order:.2f}", f"{o.fit.residual:.2g}", str(o.fit.count), str(o.left_out)] for o in found
        ]
        title = "observed order of convergence in h"
        console.table(title, ("scheme", "order", "residual", "points", "at the floor"), cells)
    for row in rows:
        if row.status in FAILED:
            console.warning(f"{row.point.label}: {row.status}: {row.message}")


def _warn_of_mixture(runs: Sequence[Sequence[Record]], console: Console) -> None:
    """Warn where times of two machines, or of two versions, are compared."""
    every = [record for of_it in runs for record in of_it]
    versions = {str(sorted(told.items())) for record in every if (told := record.get("versions"))}
    places = {(record["machine"]["processor"], record["machine"]["cores"]) for record in every}
    for count, what in ((len(places), "machines"), (len(versions), "sets of versions")):
        if count > 1:
            console.warning(f"these are runs of {count} different {what}; --fresh measures everything again")


def _entries(row: Row) -> list[str]:
    spent, memory, point = row.seconds, row.peak_memory, row.point
    return [
        point.scheme, point.resolution.replace(" x ", "x"), row.status if row.error is None else f"{row.error:.3e}",
        f"{spent.median:.3g}" if spent else "-", f"{spent.least:.3g}..{spent.largest:.3g}" if spent else "-",
        f"{1e-6 * memory:.0f}" if memory else "-", "*" if row.on_front else "",
    ]  # fmt: skip
