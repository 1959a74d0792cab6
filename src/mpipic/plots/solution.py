"""The picture of a solution: the particles against the exact solution at one time."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpipic.arrays import FloatArray, columns_of
from mpipic.plots.style import BLUE, ORANGE, Subject, bound, drawable, limits, picture, short

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Exact = Callable[[FloatArray, float], Mapping[str, FloatArray]]
ExactNow = Callable[[FloatArray], Mapping[str, FloatArray]]

SIGNED_MAP, SIZE_MAP = "PuOr_r", "cividis"
MAP_POINTS = 190.0
"""Width of a map in points."""


@dataclass(frozen=True)
class Shown:
    """The particles that a picture shows: positions (n, d), a scalar (n,), a vector (n, d), and what they should be."""

    subject: Subject
    x: FloatArray
    scalar: FloatArray
    vector: FloatArray | None
    exact: ExactNow | None

    def exact_scalar(self, points: FloatArray) -> FloatArray | None:
        """Return what the scalar should be at points (m, d), or None."""
        return self.exact(points)[self.subject.scalar] if self.exact else None


def draw_solution(
    path: Path | str,
    subject: Subject,
    time: float,
    step: int,
    sample: Mapping[str, ArrayLike],
    exact: Exact | None = None,
) -> None:
    """Draw the particles against the exact solution at one time.

    1D: scalar and vector against x. 2D: maps of the scalar at the particles, of the exact scalar and of the
    difference. 3D: the scalar in a slab through the middle, along the first axis near the centre line, and particle
    against exact values.

    Parameters
    ----------
    path : PNG file, replaced whole
    time, step : of the sample
    subject : says which fields of the sample are drawn
    sample : `position` (n, d) and fields by name, as from `gather_sample`
    exact : called with points (n, d) and the time, returns fields by name; None when not known
    """
    names = [name for name in ("position", subject.scalar, subject.vector) if name is not None]
    values = [np.asarray(sample[name], dtype=np.float64) for name in names]
    whole = np.all([np.isfinite(columns_of(v)).all(axis=1) for v in values], axis=0)
    x, scalar, *vectors = (drawable(v[whole]) for v in values)
    now = (lambda points: exact(points, time)) if exact else None
    shown = Shown(subject, x, scalar, vectors[0] if vectors else None, now)
    dim = len(subject.length)
    title = subject.title(f"step {step}, t = {short(time)}")
    if not whole.all():
        title += f"\n{np.count_nonzero(~whole)} of {len(whole)} particles not finite, not shown"
    with picture(path, (7.2, 5.6) if dim == 1 else (12.6 if exact else 8.6, 4.0)) as figure:
        figure.suptitle(title, fontsize=11)
        {1: _draw_1d, 2: _draw_2d, 3: _draw_3d}[dim](figure, shown)


def _draw_1d(figure: Figure, shown: Shown) -> None:
    x, subject, length = shown.x, shown.subject, shown.subject.length[0]
    points = np.linspace(0.0, length, 1001)
    exact = shown.exact(points[:, None]) if shown.exact else {}
    rows = [(subject.scalar, shown.scalar)]
    if subject.vector is not None and shown.vector is not None:
        rows.append((subject.vector, shown.vector[:, 0]))
    panels = figure.subplots(len(rows), 1, sharex=True, squeeze=False)[:, 0]
    size = float(np.clip(60.0 / np.sqrt(len(x) + 1.0), 0.8, 4.0))
    for axes, (name, values) in zip(panels, rows, strict=True):
        axes.plot(x[:, 0], values, ls="", marker="o", ms=size, mew=0, color=BLUE, label=f"particles ({len(x)})")
        curve = exact.get(name)
        if curve is not None:
            axes.plot(points, np.reshape(curve, -1), color=ORANGE, lw=1.2, label="exact")
        axes.set_ylabel(subject.label(name))
        axes.set_ylim(*limits(values, curve))
    panels[0].legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, markerscale=max(1.0, 4.0 / size))
    panels[-1].set_xlabel("position x")
    panels[-1].set_xlim(0.0, length)


def _draw_2d(figure: Figure, shown: Shown) -> None:
    subject, x, scalar = shown.subject, shown.x, shown.scalar
    panels = figure.subplots(1, 3 if shown.exact else 2, sharex=True, sharey=True)
    count, name = f"particles ({len(x)})", subject.label(subject.scalar)
    truth_here = shown.exact_scalar(x)
    if truth_here is None:
        _map(panels[0], subject, x, scalar, bound(scalar), f"{name}, {count}")
        if subject.vector is not None and shown.vector is not None:
            size = np.hypot(*shown.vector.T)
            _map(
                panels[1], subject, x, size, bound(size), f"|{subject.symbol(subject.vector)}|, particles", signed=False
            )
        return
    axes_points = [(np.arange(120) + 0.5) / 120 * length for length in subject.length]
    grid = np.stack(np.meshgrid(*axes_points, indexing="ij"), axis=-1)
    truth = np.reshape(np.asarray(shown.exact_scalar(grid.reshape(-1, 2))), grid.shape[:2])
    error = scalar - truth_here
    largest = bound(scalar, truth)
    _map(panels[0], subject, x, scalar, largest, f"{name}, {count}")
    _frame(panels[1], subject, f"{name}, exact")
    image = panels[1].pcolormesh(*axes_points, truth.T, cmap=SIGNED_MAP, vmin=-largest, vmax=largest, rasterized=True)
    figure.colorbar(image, ax=panels[1], shrink=0.85)
    _map(panels[2], subject, x, error, bound(error), "error: particles - exact")


def _draw_3d(figure: Figure, shown: Shown) -> None:
    panels = figure.subplots(1, 3 if shown.exact else 2)
    subject, x, scalar = shown.subject, shown.x, shown.scalar
    length = np.array(subject.length, dtype=np.float64)
    away: FloatArray = np.abs(x - 0.5 * length)
    slab = away[:, 2] <= _half_width(away[:, 2], subject.h[2], 2000)
    title = f"{subject.label(subject.scalar)} near z = {short(length[2] / 2)}"
    _map(panels[0], subject, x[slab], scalar[slab], bound(scalar[slab]), title)
    across = np.asarray((away[:, 1:] / length[1:]).max(axis=1))
    tube = across <= _half_width(across, max(subject.h[1] / length[1], subject.h[2] / length[2]), 100)
    _draw_centre_line(panels[1], shown, tube)
    truth = shown.exact_scalar(x)
    if truth is not None:
        _parity(panels[2], subject.scalar, scalar, truth)


def _draw_centre_line(axes: Axes, shown: Shown, near: NDArray[np.bool_]) -> None:
    """Draw the scalar of the particles `near` the line through the middle, and what it should be on the line."""
    length = np.array(shown.subject.length)
    axes.plot(
        shown.x[near, 0], shown.scalar[near], ls="", marker="o", ms=3, mew=0, color=BLUE, label="particles near it"
    )
    points = np.tile(0.5 * length, (401, 1))
    points[:, 0] = np.linspace(0.0, length[0], 401)
    curve = shown.exact_scalar(points)
    if curve is not None:
        axes.plot(points[:, 0], curve, color=ORANGE, lw=1.2, label="exact, on the line")
    span = limits(shown.scalar[near], curve)
    axes.set(xlim=(0.0, length[0]), ylim=span, xlabel="position x", ylabel=shown.subject.label(shown.subject.scalar))
    axes.set_title("along the centre line")
    axes.legend(loc="upper right", fontsize=8)


def _parity(axes: Axes, name: str, values: FloatArray, truth: FloatArray) -> None:
    """Draw particle values against exact ones: noise is the spread about the diagonal, damping its slope."""
    low, high = limits(truth, None)
    axes.plot(truth, values, ls="", marker="o", ms=2, mew=0, alpha=0.5, color=BLUE, rasterized=True)
    axes.axline((low, low), (high, high), color=ORANGE, lw=1.2)
    axes.set(xlim=(low, high), ylim=limits(values, truth), xlabel=f"exact {name}", ylabel=f"{name} at the particles")
    axes.set_title(f"particles ({len(values)}) against exact")


def _map(
    axes: Axes, subject: Subject, x: FloatArray, values: FloatArray, largest: float, title: str, signed: bool = True
) -> None:
    """Draw particles in the plane of the first two axes, coloured by value and as large as the space between them."""
    _frame(axes, subject, title)
    size = float(np.clip((1.2 * MAP_POINTS) ** 2 / max(len(x), 1), 1.5, 60.0))
    low, colours = (-largest, SIGNED_MAP) if signed else (0.0, SIZE_MAP)
    dots = axes.scatter(
        x[:, 0], x[:, 1], c=values, s=size, marker="s", lw=0, cmap=colours, vmin=low, vmax=largest, rasterized=True
    )
    axes.figure.colorbar(dots, ax=axes, shrink=0.85)


def _frame(axes: Axes, subject: Subject, title: str) -> None:
    width, height = subject.length[:2]
    axes.set(xlim=(0.0, width), ylim=(0.0, height), xlabel="x", ylabel="y", title=title)
    axes.set_aspect("equal" if 0.2 <= height / width <= 5.0 else "auto")
    axes.set_facecolor("#F2F2F2")
    axes.grid(visible=False)


def _half_width(distance: FloatArray, at_least: float, count: int) -> float:
    """Return half the thickness of a slab: half a cell, or more when that holds fewer than `count` particles."""
    nearest = np.sort(distance)[:count]
    return max(0.5 * at_least, float(nearest[-1]) if nearest.size else 0.0)
