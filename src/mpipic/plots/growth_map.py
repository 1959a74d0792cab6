"""The picture of growth: a map of growth per step over two keys of a scene, a panel for each filter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mpipic.arrays import FloatArray
from mpipic.plots.style import ORANGE, PINK, picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh
    from matplotlib.colors import Normalize

FLOOR, LARGEST = 1e-9, 1e9
"""Growth below is drawn as none, as eigenvalues are no more accurate; growth above, like this."""


@dataclass(frozen=True)
class Scale:
    """An axis of a map: a key and its values."""

    key: str
    values: FloatArray


def draw_map(
    path: Path | str, x: Scale, y: Scale, growth: Mapping[str, FloatArray], border: float, title: str = ""
) -> None:
    """Draw growth per step as colour, and the line where it is `border`; crosses where none was found.

    Parameters
    ----------
    path : PNG file, replaced whole
    x, y : the two keys, with nx and ny values
    growth : name of a panel to (nx, ny), nan where none was found
    """
    from matplotlib.colors import LogNorm

    largest = max([float(np.max(values, where=~np.isnan(values), initial=0.0)) for values in growth.values()])
    norm = LogNorm(FLOOR, min(max(largest, 10 * FLOOR), LARGEST))
    with picture(path, (2.2 + 3.1 * len(growth), 3.9)) as figure:
        panels = figure.subplots(1, len(growth), sharey=True, squeeze=False)[0]
        for panel, (label, values) in zip(panels, growth.items(), strict=True):
            drawn = _draw_panel(panel, x, y, values, norm, border)
            panel.set(title=label, xlabel=x.key)
        panels[0].set_ylabel(y.key)
        figure.colorbar(drawn, ax=list(panels), label=f"growth per step; line at {border:g}")
        figure.suptitle(title, fontsize=10)


def _draw_panel(panel: Axes, x: Scale, y: Scale, growth: FloatArray, norm: Normalize, border: float) -> QuadMesh:
    shown = np.clip(growth, FLOOR, LARGEST)
    known = shown[~np.isnan(shown)]
    drawn = panel.pcolormesh(x.values, y.values, shown.T, norm=norm, cmap="cividis", shading="nearest")
    if min(growth.shape) > 1 and known.size and known.min() < border < known.max():
        levels = [float(np.log10(border))]
        panel.contour(x.values, y.values, np.log10(shown).T, levels=levels, colors=ORANGE, linewidths=2)
    i, j = np.nonzero(np.isnan(growth))
    panel.plot(x.values[i], y.values[j], "x", color=PINK, ms=6)
    panel.grid(visible=False)
    return drawn
