"""The picture of a run's history: errors and growth against time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from mpipic.arrays import FloatArray
from mpipic.plots.style import BLACK, BLUE, HUGE, ORANGE, PINK, LineStyle, Subject, decades, finite, picture, short

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CURVES: dict[str, tuple[str, LineStyle]] = {
    "max_density": ("largest |ρ|", {"color": BLACK, "ls": "-", "marker": "", "ms": 0.0, "lw": 1.2}),
    "density_l2": ("density error, l2", {"color": BLUE, "ls": "-", "marker": "o", "ms": 5.0, "lw": 1.0}),
    "velocity_l2": ("velocity error, l2", {"color": ORANGE, "ls": "--", "marker": "s", "ms": 5.0, "lw": 1.0}),
}
"""Column of the history to label and style."""

HistoryRow = Mapping[str, float | None]


def draw_error(
    path: Path | str, rows: Sequence[HistoryRow], subject: Subject | None = None, unstable: bool = False
) -> None:
    """Draw the l2 errors at the report steps and the largest |density| of every row against time, on a log axis.

    Parameters
    ----------
    path : PNG file, replaced whole
    rows : history rows: `step`, `time`, `max_density`, `density_l2`, `velocity_l2`; missing or None where not recorded
    subject : named in the title where given
    unstable : mark the last row as the end of an unstable run
    """
    step, time = (rows[-1]["step"] or 0, rows[-1]["time"] or 0.0) if rows else (0, 0.0)
    with picture(path, (7.2, 4.2)) as figure:
        axes = figure.add_subplot()
        _draw_curves(axes, rows)
        axes.set_xlabel("time t")
        axes.set_ylabel("error;  largest |ρ|")
        if unstable:
            axes.axvline(finite(time), color=PINK, lw=1.5, ls=":", label=f"unstable at step {step}")
        if axes.get_legend_handles_labels()[0]:
            axes.legend(loc="best")
        _step_axis(axes, step, time)
        ending = f"{'unstable end' if unstable else 'end'} at step {step}, t = {short(time)}"
        axes.set_title(subject.title(ending) if subject else ending)


def _draw_curves(axes: Axes, rows: Sequence[HistoryRow]) -> None:
    values = {key: _column(rows, key) for key in CURVES}
    bottom, top = decades(np.concatenate(list(values.values())))
    for key, (label, style) in CURVES.items():
        drawn = np.isfinite(values[key])
        if drawn.any():
            axes.plot(_column(rows, "time")[drawn], np.clip(values[key][drawn], bottom, top), label=label, **style)
    axes.set_yscale("log")
    axes.set_ylim(bottom, top)


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
