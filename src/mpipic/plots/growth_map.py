"""Pictures of stability: maps of growth per step over two keys."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mpipic.plots.pictures import _figure

FLOOR = 1e-9
"""Growth below this is drawn as none: eigenvalues are no more accurate."""


def draw_map(path: Path | str, axes: Sequence[Any], points: Sequence[Any], scene: Any, border: float) -> None:
    """Growth per step as colour, the line where it is `border`, one panel a filter; crosses where none was found."""
    from matplotlib.colors import LogNorm

    labels = list(dict.fromkeys(point.filter for point in points))
    largest = max([point.growth for point in points if point.growth is not None] + [10 * FLOOR])
    norm = LogNorm(FLOOR, max(largest, 10 * FLOOR))
    with _figure(path, (2.2 + 3.1 * len(labels), 3.9)) as figure:
        panels = figure.subplots(1, len(labels), sharey=True, squeeze=False)[0]
        for panel, label in zip(panels, labels, strict=True):
            x, y, growth, missing = _grid(axes, [point for point in points if point.filter == label])
            drawn = panel.pcolormesh(x, y, np.maximum(growth, FLOOR).T, norm=norm, cmap="cividis", shading="nearest")
            if min(growth.shape) > 1 and np.nanmin(growth) < border < np.nanmax(growth):
                decades = np.log10(np.maximum(growth, FLOOR)).T
                panel.contour(x, y, decades, levels=[np.log10(border)], colors="#D55E00", linewidths=2)
            panel.plot(*missing, "x", color="#CC79A7", ms=6)
            panel.set(title=label, xlabel=axes[0].key)
            panel.grid(visible=False)
        panels[0].set_ylabel(axes[1].key)
        figure.colorbar(drawn, ax=list(panels), label=f"growth per step; line at {border:g}")
        figure.suptitle(f"{scene.name}: growth per step", fontsize=10)


def _grid(axes: Sequence[Any], points: Sequence[Any]) -> tuple[Any, Any, Any, Any]:
    x, y = np.array(axes[0].values), np.array(axes[1].values)
    growth = np.full((len(x), len(y)), np.nan)
    missing: tuple[list[float], list[float]] = ([], [])
    for point in points:
        i, j = int(np.argmin(np.abs(x - point.x))), int(np.argmin(np.abs(y - point.y)))
        if point.growth is None:
            missing[0].append(point.x)
            missing[1].append(point.y)
        else:
            growth[i, j] = point.growth
    return x, y, growth, missing
