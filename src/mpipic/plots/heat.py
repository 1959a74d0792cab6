"""Heat maps of numbers over two settings, a row of panels for each pair of settings, a column for each filter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mpipic.arrays import FloatArray
from mpipic.plots.style import picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import LogNorm


@dataclass(frozen=True)
class HeatRow:
    """One row: its title, names and values of both settings, and by filter numbers (ny, nx).

    A number that is nan was not found; an infinite one has a word of its own.
    """

    title: str
    x: str
    x_values: Sequence[float]
    y: str
    y_values: Sequence[float]
    panels: Mapping[str, FloatArray]


def draw_heat(
    path: Path | str, title: str, rows: Sequence[HeatRow], span: tuple[float, float], infinite: str, best_high: bool
) -> None:
    """Draw the rows with one scale of colours, logarithmic over `span`, light for the best; each number is written.

    path : PNG file, replaced whole
    infinite : the word for an infinite number
    """
    from matplotlib.colors import LogNorm

    columns = len(rows[0].panels)
    with picture(path, (0.8 + 3.3 * columns, 0.8 + 2.5 * len(rows))) as figure:
        grid = figure.subplots(len(rows), columns, squeeze=False)
        for row, panels in zip(rows, grid, strict=True):
            for (label, values), panel in zip(row.panels.items(), panels, strict=True):
                _draw_panel(panel, row, values, LogNorm(*span), infinite, "cividis" if best_high else "cividis_r")
                panel.set_title(f"{label}, {row.title}")
            panels[0].set_ylabel(row.y)
        figure.suptitle(title, fontsize=11)


def _draw_panel(panel: Axes, row: HeatRow, values: FloatArray, norm: LogNorm, infinite: str, colours: str) -> None:
    low, high = float(norm.vmin or 0.0), float(norm.vmax or 1.0)
    shown = np.clip(values, low, high)
    panel.imshow(shown, norm=norm, cmap=colours, aspect="auto", origin="lower")
    panel.set_xticks(range(len(row.x_values)), [f"{value:g}" for value in row.x_values])
    panel.set_yticks(range(len(row.y_values)), [f"{value:g}" for value in row.y_values])
    panel.set_xlabel(row.x)
    panel.grid(visible=False)
    for (j, i), value in np.ndenumerate(values):
        share = 0.0 if np.isnan(value) else float(norm(shown[j, i]))
        light = share > 0.5 if colours == "cividis" else share < 0.5
        text = "?" if np.isnan(value) else infinite if np.isinf(value) else _brief(float(value))
        panel.text(i, j, text, ha="center", va="center", fontsize=7.5, color="black" if light else "white")


def _brief(value: float) -> str:
    return f"{value:.0f}" if 10.0 <= value < 1e4 else f"{value:.1e}".replace("e+0", "e").replace("e-0", "e-")
