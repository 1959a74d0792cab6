"""The picture of a study: error against stepping time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mpipic.plots.style import LineStyle, in_legend, line_style, picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MARKERS = "osv^D<>p"
CROSS: LineStyle = {"color": "#777777", "ls": "", "marker": "X", "ms": 10.0, "lw": 0.0}


@dataclass(frozen=True)
class Mark:
    """A point of the picture.

    Attributes
    ----------
    scheme
        Points of one scheme look alike.
    line
        Points of one scheme and one line are joined.
    seconds, spread
        Median, and least and largest.
    error
        None where unstable.
    on_front
        Whether it is on the Pareto front.
    """

    scheme: str
    line: str
    seconds: float
    spread: tuple[float, float]
    error: float | None
    on_front: bool


def draw_work_precision(path: Path | str, marks: Sequence[Mark], title: str, error: str, note: str = "") -> None:
    """Draw error against stepping time on log axes: a line a scheme, the Pareto front, unstable points on top.

    Parameters
    ----------
    path : PNG file, replaced whole
    marks : the points
    title, error, note : title, name of the error, and what to say below the picture
    """
    with picture(path, (9.6, 5.4)) as figure:
        axes = figure.add_subplot(xscale="log", yscale="log", ylabel=error)
        axes.set_title(title, pad=14)
        axes.set_xlabel("seconds of stepping" + (f"\n{note}" if note else ""))
        front = sorted((mark.seconds, mark.error) for mark in marks if mark.on_front and mark.error)
        if front:
            _draw_front(axes, front)
        for number, scheme in enumerate(dict.fromkeys(mark.scheme for mark in marks)):
            style = line_style(number, MARKERS, 6.0)
            axes.plot([], [], label=in_legend(scheme), **style)
            _draw_scheme(axes, [mark for mark in marks if mark.scheme == scheme], style)
        if any(not mark.error for mark in marks):
            axes.plot([], [], label="unstable, at the time\nthat all steps would take", mec="white", **CROSS)
        if marks:
            figure.legend(loc="outside right upper", fontsize=9)


def _draw_front(axes: Axes, front: Sequence[tuple[float, float]]) -> None:
    """Draw the front as a broad band of steps behind all else."""
    seconds, errors = zip(*front, strict=True)
    axes.plot(
        seconds, errors, drawstyle="steps-post", solid_capstyle="round", color="#D9D9D9", lw=7, zorder=1,
        label="Pareto front:\nfilled markers",
    )  # fmt: skip


def _draw_scheme(axes: Axes, marks: Sequence[Mark], style: LineStyle) -> None:
    color = style["color"]
    for line in dict.fromkeys(mark.line for mark in marks):
        known = [(mark.seconds, mark.error) for mark in marks if mark.line == line and mark.error]
        axes.plot(*(zip(*known, strict=True) if known else ([], [])), color=color, ls=style["ls"], lw=style["lw"])
    for mark in marks:
        if mark.error:
            fill = color if mark.on_front else "white"
            axes.plot(mark.spread, (mark.error, mark.error), color=color, lw=0.8, alpha=0.6)
            axes.plot(mark.seconds, mark.error, color=color, marker=style["marker"], ms=style["ms"], mfc=fill, zorder=3)
        else:
            cross: LineStyle = {**CROSS, "color": color}
            top = axes.get_xaxis_transform()
            axes.plot(mark.seconds, 1.0, transform=top, clip_on=False, mec="white", **cross)
