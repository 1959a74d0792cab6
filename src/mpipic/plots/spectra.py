"""The picture of spectra: what filters keep of waves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mpipic.plots.style import in_legend, line_style, picture


@dataclass(frozen=True)
class Curve:
    """Shares that one filter keeps of waves of these lengths, in nodes, along one direction."""

    direction: str
    filter: str
    lengths: tuple[float, ...]
    kept: tuple[float, ...]


def draw_spectrum(path: Path | str, curves: Sequence[Curve], title: str = "") -> None:
    """Draw what each filter keeps of waves against their length in nodes, one panel a direction.

    `path` is a PNG file, replaced whole. Curves of one filter look alike in all panels.
    """
    names = list(dict.fromkeys(curve.direction for curve in curves))
    filters = list(dict.fromkeys(curve.filter for curve in curves))
    with picture(path, (3.6 + 3.2 * len(names), 4.4)) as figure:
        panels = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
        for axes, name in zip(panels, names, strict=True):
            for curve in (curve for curve in curves if curve.direction == name):
                style = line_style(filters.index(curve.filter))
                axes.plot(curve.lengths, curve.kept, label=in_legend(curve.filter), **style)
            axes.set_xscale("log", base=2)
            axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
            axes.set_xlabel("wave length in nodes, λ/h" + (" along every axis" if name == "diagonal" else ""))
            axes.set_title(f"along {name}" if len(names) > 1 else "")
        panels[0].set_ylabel("share kept of cos(k·x)")
        panels[-1].legend(loc="lower right")
        figure.suptitle(title, fontsize=10)
