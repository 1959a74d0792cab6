"""The paper's figures as pictures: gradients at particles, waves that may have blown up, and costs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mpipic.arrays import FloatArray
from mpipic.plots.style import BLACK, BLUE, COLOURS, ORANGE, drawable, line_style, picture, short

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WAVE = (-0.35, 1.25)
"""Limits of the density in figures of waves, whose largest value at the start is 1."""
ZOOM = 0.12
"""Share of the box that the close-up of a gradient shows."""
WAVE_COLOURS = {"unfiltered": "#E69F00", "svd": BLUE, "local": ORANGE}


def draw_gradient(path: Path | str, title: str, x: FloatArray, values: FloatArray, label: str,
                  true: FloatArray | None = None) -> None:  # fmt: skip
    """Draw values at particles, and the true gradient where given: all of them, and a close-up of the steepest part.

    path : PNG file, replaced whole
    """
    with picture(path, (11.0, 4.2)) as figure:
        panels = figure.subplots(1, 2, width_ratios=(2, 1))
        steepest = x[int(np.argmax(np.abs(values)))]
        near = np.abs(x - steepest) <= 0.5 * ZOOM * np.ptp(x)
        for panel, shown, size in ((panels[0], np.full(len(x), True), 3.0), (panels[1], near, 6.0)):
            if true is not None:
                panel.plot(x[shown], true[shown], color=BLACK, lw=1.2, label="true")
            panel.plot(x[shown], values[shown], ls="", marker="o", ms=size, mew=0, color=ORANGE, label=label)
            panel.set_xlabel("position x")
        if true is None:
            panels[1].plot(x[near], values[near], color=ORANGE, lw=0.6)
        panels[0].set_ylabel("∂g/∂x at the particles" if true is not None else "null-space part of ∂g/∂x")
        panels[1].set_title("close-up")
        panels[0].legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
        figure.suptitle(title, fontsize=11)


def draw_wave(path: Path | str, title: str, x: FloatArray, exact: FloatArray, waves: Mapping[str, FloatArray]) -> None:
    """Draw the density under each filter against the exact one; what leaves the frame is clipped, and its size said.

    path : PNG file, replaced whole
    """
    order = np.argsort(x)
    with picture(path, (9.0, 4.6)) as figure:
        panel = figure.subplots()
        panel.plot(x[order], exact[order], color=BLACK, lw=1.4, label="exact", zorder=5)
        for label, values in waves.items():
            colour, dashes = WAVE_COLOURS.get(label, COLOURS[2]), "--" if label == "local" else "-"
            fits = bool(np.all((values >= WAVE[0]) & (values <= WAVE[1])))
            panel.plot(x[order], _clipped(values[order]), color=colour, ls=dashes, lw=1.6 if fits else 0.7,
                       zorder=4 if fits else 2, label=_said(label, values))  # fmt: skip
        panel.set(xlabel="position x", ylabel="density ρ", ylim=WAVE, xlim=(float(x.min()), float(x.max())))
        panel.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
        figure.suptitle(title, fontsize=11)


def _clipped(values: FloatArray) -> FloatArray:
    """Return values that leave the frame just outside of it; those that are no numbers are left out."""
    low, high = WAVE
    return np.clip(values, low - 1.0, high + 1.0)


def _said(label: str, values: FloatArray) -> str:
    """Return the label, and that the line is clipped where it leaves the frame."""
    if not np.isfinite(values).all():
        return f"{label} (blown up, not finite)"
    size = float(np.abs(values).max())
    outside = values.min() < WAVE[0] or values.max() > WAVE[1]
    return f"{label} (blown up, clipped: |ρ| to {short(float(f'{size:.1e}'))})" if outside else label


def draw_costs(path: Path | str, title: str, costs: Mapping[str, tuple[Sequence[int], Sequence[float], str]]) -> None:
    """Draw seconds against nodes, a line a filter: nodes, seconds, and what the legend adds.

    path : PNG file, replaced whole
    """
    with picture(path, (7.2, 4.4)) as figure:
        panel: Axes = figure.subplots()
        for position, (label, (nodes, seconds, note)) in enumerate(costs.items()):
            panel.loglog(nodes, drawable(np.array(seconds)), label=f"{label}: {note}", **line_style(position))
        panel.set(xlabel="nodes m, with 2m particles", ylabel="seconds, one filtering at new positions")
        panel.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)
        figure.suptitle(title, fontsize=11)
