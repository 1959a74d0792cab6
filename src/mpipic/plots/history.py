"""The picture of a run's history: errors and growth against time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from mpipic.arrays import FloatArray
from mpipic.plots.style import BLACK, HUGE, PINK, LineStyle, Subject, decades, finite, line_style, picture, short

if TYPE_CHECKING:
    from matplotlib.axes import Axes

HistoryRow = Mapping[str, float | None]


def draw_error(
    path: Path | str, rows: Sequence[HistoryRow], subject: Subject | None = None, unstable: bool = False
) -> None:
    """Draw the l2 errors at the report steps and the watched field's peak in every row against time, on a log axis.

    Parameters
    ----------
    path : PNG file, replaced whole
    rows : history rows: `step`, `time`, `max_<field>`, `<field>_l2` for any fields; missing or None where not recorded
    subject : named in the title where given, and gives symbols
    unstable : mark the last row as the end of an unstable run
    """
    step, time = (rows[-1]["step"] or 0, rows[-1]["time"] or 0.0) if rows else (0, 0.0)
    with picture(path, (7.2, 4.2)) as figure:
        axes = figure.add_subplot()
        peaks = _draw_curves(axes, rows, subject)
        axes.set_xlabel("time t")
        axes.set_ylabel(";  ".join(["error", *peaks]))
        if unstable:
            axes.axvline(finite(time), color=PINK, lw=1.5, ls=":", label=f"unstable at step {step}")
        if axes.get_legend_handles_labels()[0]:
            axes.legend(loc="best")
        _step_axis(axes, step, time)
        ending = f"{'unstable end' if unstable else 'end'} at step {step}, t = {short(time)}"
        axes.set_title(subject.title(ending) if subject else ending)


def _draw_curves(axes: Axes, rows: Sequence[HistoryRow], subject: Subject | None) -> list[str]:
    """Draw peaks in black and errors in colours; return what the peaks are called."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    peaks = [key for key in columns if key.startswith("max_")]
    errors = [key for key in columns if key.endswith("_l2")]
    values = {key: _column(rows, key) for key in (*peaks, *errors)}
    bottom, top = decades(np.concatenate([*values.values(), np.empty(0)]))
    time = _column(rows, "time")

    def draw(key: str, label: str, style: LineStyle) -> None:
        drawn = np.isfinite(values[key])
        if drawn.any():
            axes.plot(time[drawn], np.clip(values[key][drawn], bottom, top), label=label, **style)

    names = []
    for key in peaks:
        name = key.removeprefix("max_")
        names.append(f"largest |{subject.symbol(name) if subject else name}|")
        draw(key, names[-1], {"color": BLACK, "ls": "-", "marker": "", "ms": 0.0, "lw": 1.2})
    for number, key in enumerate(errors):
        draw(key, f"{key.removesuffix('_l2')} error, l2", line_style(number, "os^vD", 5.0))
    axes.set_yscale("log")
    axes.set_ylim(bottom, top)
    return names


def _step_axis(axes: Axes, step: float, time: float) -> None:
    """Draw the step as a second scale on top, when time grows with the step."""
    dt = finite(time) / step if step else 0.0
    if dt > 0.0:
        top = axes.secondary_xaxis("top", functions=(_scale(1.0 / dt), _scale(dt)))
        top.set_xlabel("step")


def _scale(factor: float) -> Callable[[ArrayLike], FloatArray]:
    return lambda values: np.asarray(values, dtype=np.float64) * factor


def _column(rows: Sequence[HistoryRow], key: str) -> FloatArray:
    """Return one column of the history; nan where it is missing or not finite."""
    given = (row.get(key) for row in rows)
    values = np.array([np.nan if value is None else value for value in given], dtype=np.float64)
    return np.where(np.isfinite(values), np.clip(values, -HUGE, HUGE), np.nan)
