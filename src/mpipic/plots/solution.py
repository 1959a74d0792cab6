"""Pictures of a run: errors and growth against time, and the particles against the exact solution.

matplotlib is imported when a picture is drawn. Data may hold anything that a run that blew up leaves behind: values
that are not finite are left out and counted, huge ones are clipped at `HUGE`, those below `TINY` are drawn as 0.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpipic.draws import golden_turns
from mpipic.files import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FloatArray = NDArray[np.float64]
Exact = Callable[[FloatArray, float], tuple[FloatArray, FloatArray]]

# Okabe and Ito: told apart with any colour vision, and by lightness in print.
BLUE, ORANGE, PINK, BLACK = "#0072B2", "#D55E00", "#CC79A7", "#222222"
SIGNED_MAP, SIZE_MAP = "PuOr_r", "cividis"
MAP_POINTS = 190.0  # width of a map in points
HUGE, TINY = 1e150, 1e-150
DECADES = 16
SAMPLE = 20_000
STYLE = {
    "font.size": 10, "axes.grid": True, "grid.color": "#DDDDDD", "grid.linewidth": 0.6, "axes.axisbelow": True,
    "axes.spines.top": False, "axes.spines.right": False, "legend.frameon": False, "axes.titlesize": 10,
    "figure.dpi": 120, "figure.constrained_layout.use": True,
}  # fmt: skip


def gather_sample(particles: Any, comm: Any, at_most: int = SAMPLE) -> dict[str, NDArray[Any]] | None:
    """Bring at most `at_most` particles to rank 0, the same ones on any number of ranks.

    All particles when they are no more than that. Otherwise a particle is taken when the fractional part of (golden
    ratio × id) is below at_most / n: even in id, and never in step with the rows of a lattice as every k-th id can be.

    Parameters
    ----------
    particles : has `ids` (n_local,), `position` (n_local, d), `fields`, name -> (n_local,) or (n_local, k)
    comm : mpi4py communicator

    Returns
    -------
    dict on rank 0, None elsewhere
        `ids`, `position` and every field, in the order of the ids.

    Notes
    -----
    Collective. Rank 0 receives about `at_most` particles, in all.
    """
    total = comm.allreduce(len(particles.ids))
    ids = np.asarray(particles.ids)
    columns = {"ids": ids, "position": particles.position, **particles.fields}
    keep = np.arange(len(ids))
    if total > at_most:
        keep = np.flatnonzero(golden_turns(ids) < np.uint64(int(at_most / total * 2**64)))
    parts = comm.gather({name: np.asarray(values)[keep] for name, values in columns.items()})
    if parts is None:
        return None
    sample = {name: np.concatenate([part[name] for part in parts]) for name in columns}
    first = np.argsort(golden_turns(sample["ids"]), kind="stable")[:at_most]
    order = first[np.argsort(sample["ids"][first], kind="stable")]
    return {name: values[order] for name, values in sample.items()}


def draw_error(path: Path | str, rows: Sequence[Mapping[str, Any]], scene: Any = None, unstable: bool = False) -> None:
    """Draw the l2 errors at the report steps and the largest |density| of every row against time, on a log axis.

    Parameters
    ----------
    path : PNG file, replaced whole
    rows : history rows: `step`, `time`, `max_density`, `density_l2`, `velocity_l2`; missing or None where not recorded
    scene : named in the title; may be None
    unstable : mark the last row as the end of an unstable run
    """
    last = rows[-1] if rows else {"step": 0, "time": 0.0}
    with _figure(path, (7.2, 4.2)) as figure:
        axes = figure.add_subplot()
        curves: tuple[tuple[str, str, dict[str, Any]], ...] = (
            ("max_density", "largest |ρ|", {"color": BLACK, "lw": 1.2}),
            ("density_l2", "density error, l2", {"color": BLUE, "marker": "o", "ms": 5, "lw": 1.0}),
            ("velocity_l2", "velocity error, l2", {"color": ORANGE, "marker": "s", "ms": 5, "lw": 1.0, "ls": "--"}),
        )
        values = {key: _column(rows, key) for key, _, _ in curves}
        bottom, top = _decades(np.concatenate(list(values.values())))
        for key, label, style in curves:
            drawn = np.isfinite(values[key])
            if drawn.any():
                axes.plot(_column(rows, "time")[drawn], np.clip(values[key][drawn], bottom, top), label=label, **style)
        axes.set_yscale("log")
        axes.set_ylim(bottom, top)
        axes.set_xlabel("time t")
        axes.set_ylabel("error;  largest |ρ|")
        if unstable:
            axes.axvline(_finite(last["time"]), color=PINK, lw=1.5, ls=":", label=f"unstable at step {last['step']}")
        if axes.get_legend_handles_labels()[0]:
            axes.legend(loc="best")
        _step_axis(axes, last)
        ending = "unstable end" if unstable else "end"
        axes.set_title(_title(scene, f"{ending} at step {last['step']}, t = {_short(last['time'])}"))


def draw_spectrum(path: Path | str, points: Sequence[Any], scene: Any = None) -> None:
    """Draw what each filter keeps of waves against their length in nodes, one panel a direction.

    Parameters
    ----------
    path : PNG file, replaced whole
    points : have `direction`, `lambda_over_h`, `filter`, `kept`
    scene : named in the title; may be None
    """
    names = list(dict.fromkeys(point.direction for point in points))
    labels = list(dict.fromkeys(point.filter for point in points))
    with _figure(path, (3.6 + 3.2 * len(names), 4.4)) as figure:
        panels = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
        for axes, name in zip(panels, names, strict=True):
            for number, label in enumerate(labels):
                mine = sorted((p.lambda_over_h, p.kept) for p in points if p.direction == name and p.filter == label)
                axes.plot(*zip(*mine, strict=True), label=label, **_line(number))
            axes.set_xscale("log", base=2)
            axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
            axes.set_xlabel("wave length in nodes, λ/h" + (" along every axis" if name == "diagonal" else ""))
            axes.set_title(f"along {name}" if len(names) > 1 else "")
        panels[0].set_ylabel("share kept of cos(k·x)")
        panels[-1].legend(loc="lower right")
        figure.suptitle(f"{scene.name}: what one application keeps" if scene else "", fontsize=10)


def draw_work_precision(path: Path | str, points: Sequence[Any], title: str, error: str, note: str = "") -> None:
    """Draw error against stepping time on log axes: a line a scheme, the Pareto front, unstable points on top.

    Parameters
    ----------
    path : PNG file, replaced whole
    points : have `scheme`, `line` (points of one line are joined), `seconds`, `spread` (least and largest seconds),
        `error` (None where unstable), `on_front`
    title, error, note : title, name of the error, and what to say below the picture
    """
    with _figure(path, (9.6, 5.4)) as figure:
        axes = figure.add_subplot(xscale="log", yscale="log", ylabel=error)
        axes.set_title(title.replace("$", r"\$"), pad=14)
        axes.set_xlabel("seconds of stepping" + (f"\n{note}" if note else ""))
        front = sorted((p.seconds, p.error) for p in points if p.on_front)
        if front:
            band: dict[str, Any] = {"color": "#D9D9D9", "lw": 7, "solid_capstyle": "round", "zorder": 1}
            axes.plot(*zip(*front), drawstyle="steps-post", label="Pareto front:\nfilled markers", **band)
        cross: dict[str, Any] = {"ls": "", "marker": "X", "ms": 10, "mec": "white"}
        for number, scheme in enumerate(dict.fromkeys(p.scheme for p in points)):
            style = {**_line(number), "marker": "osv^D<>p"[number % 8], "ms": 6.0}
            color = style["color"]
            axes.plot([], [], label=scheme.replace("$", r"\$"), **style)
            mine = [p for p in points if p.scheme == scheme]
            for line in dict.fromkeys(p.line for p in mine):
                known = [(p.seconds, p.error) for p in mine if p.line == line and p.error]
                axes.plot(*(zip(*known) if known else ([], [])), color=color, ls=style["ls"], lw=1.3)
            for p in mine:
                if not p.error:
                    axes.plot(p.seconds, 1.0, transform=axes.get_xaxis_transform(), color=color, clip_on=False, **cross)
                    continue
                axes.plot(p.spread, (p.error, p.error), color=color, lw=0.8, alpha=0.6)
                fill = color if p.on_front else "white"
                axes.plot(p.seconds, p.error, color=color, marker=style["marker"], ms=6.0, mfc=fill, zorder=3)
        if any(not p.error for p in points):
            axes.plot([], [], label="unstable, at the time\nthat all steps would take", color="#777777", **cross)
        if points:
            figure.legend(loc="outside right upper", fontsize=9)


def _line(number: int) -> dict[str, Any]:
    """Colour, dashes and marker of the curve with this number: neighbours differ in all three."""
    colours = (BLUE, ORANGE, "#009E73", PINK, "#E69F00", BLACK, "#56B4E9")
    dashes, markers = ("-", "--", "-.", ":"), "osv^Dx+"
    return {
        "color": colours[number % len(colours)], "ls": dashes[number % len(dashes)],
        "marker": markers[number % len(markers)], "ms": 3.5, "lw": 1.3,
    }  # fmt: skip


def draw_solution(
    path: Path | str, scene: Any, time: float, step: int, sample: Mapping[str, ArrayLike], exact: Exact | None = None
) -> None:
    """Draw the particles against the exact solution at one time.

    1D: density and velocity against x. 2D: maps of the density at the particles, of the exact density and of the
    difference. 3D: density in a slab through the middle, along the first axis near the centre line, and particle
    against exact values.

    Parameters
    ----------
    path : PNG file, replaced whole
    scene : has `name`, `dim`, `grid.length`, `grid.cells`, `h`, `filter.kind`
    time, step : of the sample
    sample : `position` (n, d), `density` (n,), `velocity` (n, d), as from `gather_sample`
    exact : called with points (n, d) and the time, returns density (n,) and velocity (n, d); None when not known
    """
    position = np.asarray(sample["position"], dtype=np.float64)
    density, velocity = (np.asarray(sample[name], dtype=np.float64) for name in ("density", "velocity"))
    whole = np.isfinite(position).all(axis=1) & np.isfinite(density) & np.isfinite(velocity).all(axis=1)
    x, rho, u = (_drawable(values[whole]) for values in (position, density, velocity))
    draw = {1: _draw_1d, 2: _draw_2d, 3: _draw_3d}[scene.dim]
    size = (7.2, 5.6) if scene.dim == 1 else (12.6 if exact else 8.6, 4.0)
    title = _title(scene, f"step {step}, t = {_short(time)}")
    if not whole.all():
        title += f"\n{np.count_nonzero(~whole)} of {len(whole)} particles not finite, not shown"
    with _figure(path, size) as figure:
        figure.suptitle(title, fontsize=11)
        draw(figure, scene, x, rho, u, (lambda x: exact(x, time)) if exact else None)


def _draw_1d(figure: Figure, scene: Any, x: FloatArray, density: FloatArray, velocity: FloatArray, exact: Any) -> None:
    length = scene.grid.length[0]
    points = np.linspace(0.0, length, 1001)
    curves = exact(points[:, None]) if exact else (None, None)
    panels = figure.subplots(2, 1, sharex=True)
    labels = ("density perturbation ρ", "velocity perturbation u")
    size = float(np.clip(60.0 / np.sqrt(len(x) + 1.0), 0.8, 4.0))
    for axes, values, curve, label in zip(panels, (density, velocity[:, 0]), curves, labels):
        axes.plot(x[:, 0], values, ls="", marker="o", ms=size, mew=0, color=BLUE, label=f"particles ({len(x)})")
        if curve is not None:
            axes.plot(points, np.reshape(curve, -1), color=ORANGE, lw=1.2, label="exact")
        axes.set_ylabel(label)
        axes.set_ylim(*_limits(values, curve))
    panels[0].legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, markerscale=max(1.0, 4.0 / size))
    panels[1].set_xlabel("position x")
    panels[1].set_xlim(0.0, length)


def _draw_2d(figure: Figure, scene: Any, x: FloatArray, density: FloatArray, velocity: FloatArray, exact: Any) -> None:
    panels = figure.subplots(1, 3 if exact else 2, sharex=True, sharey=True)
    if not exact:
        _map(panels[0], scene, x, density, _bound(density), f"density ρ, particles ({len(x)})")
        speed = np.hypot(*velocity.T)
        _map(panels[1], scene, x, speed, _bound(speed), "speed |u|, particles", signed=False)
        return
    axes_points = [(np.arange(120) + 0.5) / 120 * length for length in scene.grid.length]
    grid = np.stack(np.meshgrid(*axes_points, indexing="ij"), axis=-1)
    truth = np.reshape(exact(grid.reshape(-1, 2))[0], grid.shape[:2])
    error = density - exact(x)[0]
    bound = _bound(density, truth)
    _map(panels[0], scene, x, density, bound, f"density ρ, particles ({len(x)})")
    _frame(panels[1], scene, "density ρ, exact")
    image = panels[1].pcolormesh(*axes_points, truth.T, cmap=SIGNED_MAP, vmin=-bound, vmax=bound, rasterized=True)
    figure.colorbar(image, ax=panels[1], shrink=0.85)
    _map(panels[2], scene, x, error, _bound(error), "error: particles - exact")


def _draw_3d(figure: Figure, scene: Any, x: FloatArray, density: FloatArray, velocity: FloatArray, exact: Any) -> None:
    panels = figure.subplots(1, 3 if exact else 2)
    length = np.array(scene.grid.length, dtype=np.float64)
    away: FloatArray = np.abs(x - 0.5 * length)
    slab = away[:, 2] <= _half_width(away[:, 2], scene.h[2], 2000)
    _map(panels[0], scene, x[slab], density[slab], _bound(density[slab]), f"density ρ near z = {_short(length[2] / 2)}")
    across = np.asarray((away[:, 1:] / length[1:]).max(axis=1))
    tube = across <= _half_width(across, max(scene.h[1] / length[1], scene.h[2] / length[2]), 100)
    axes = panels[1]
    axes.plot(x[tube, 0], density[tube], ls="", marker="o", ms=3, mew=0, color=BLUE, label="particles near it")
    curve = None
    if exact:
        points = np.tile(0.5 * length, (401, 1))
        points[:, 0] = np.linspace(0.0, length[0], 401)
        curve = exact(points)[0]
        axes.plot(points[:, 0], curve, color=ORANGE, lw=1.2, label="exact, on the line")
        _parity(panels[2], density, exact(x)[0])
    axes.set(xlim=(0.0, length[0]), ylim=_limits(density[tube], curve), xlabel="position x", ylabel="density ρ")
    axes.set_title("along the centre line")
    axes.legend(loc="upper right", fontsize=8)


def _parity(axes: Axes, density: FloatArray, truth: FloatArray) -> None:
    """Particle values against exact ones: noise is the spread about the diagonal, damping its slope."""
    low, high = _limits(truth, None)
    axes.plot(truth, density, ls="", marker="o", ms=2, mew=0, alpha=0.5, color=BLUE, rasterized=True)
    axes.axline((low, low), (high, high), color=ORANGE, lw=1.2)
    axes.set(xlim=(low, high), ylim=_limits(density, truth), xlabel="exact density", ylabel="density at the particles")
    axes.set_title(f"particles ({len(density)}) against exact")


def _map(
    axes: Axes, scene: Any, x: FloatArray, values: FloatArray, bound: float, title: str, signed: bool = True
) -> None:
    """Particles in the plane of the first two axes, coloured by value and as large as the space between them."""
    _frame(axes, scene, title)
    size = float(np.clip((1.2 * MAP_POINTS) ** 2 / max(len(x), 1), 1.5, 60.0))
    low, colours = (-bound, SIGNED_MAP) if signed else (0.0, SIZE_MAP)
    dots = axes.scatter(
        x[:, 0], x[:, 1], c=values, s=size, marker="s", lw=0, cmap=colours, vmin=low, vmax=bound, rasterized=True
    )
    axes.figure.colorbar(dots, ax=axes, shrink=0.85)


def _frame(axes: Axes, scene: Any, title: str) -> None:
    width, height = scene.grid.length[:2]
    axes.set(xlim=(0.0, width), ylim=(0.0, height), xlabel="x", ylabel="y", title=title)
    axes.set_aspect("equal" if 0.2 <= height / width <= 5.0 else "auto")
    axes.set_facecolor("#F2F2F2")
    axes.grid(visible=False)


def _step_axis(axes: Axes, last: Mapping[str, Any]) -> None:
    """The step as a second scale on top, when time grows with the step."""
    dt = _finite(last["time"]) / last["step"] if last["step"] else 0.0
    if dt > 0.0:
        top = axes.secondary_xaxis("top", functions=(_scale(1.0 / dt), _scale(dt)))
        top.set_xlabel("step")


def _scale(factor: float) -> Callable[[Any], Any]:
    return lambda values: values * factor


@contextmanager
def _figure(path: Path | str, size: tuple[float, float]) -> Iterator[Figure]:
    """A figure without a window, saved as PNG in one piece when the block ends well."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        figure = Figure(figsize=size)
        FigureCanvasAgg(figure)
        yield figure
        with replacing(Path(path)) as temporary:
            figure.savefig(temporary, format="png", dpi=150)


def _column(rows: Sequence[Mapping[str, Any]], key: str) -> FloatArray:
    """One column of the history; nan where it is missing or not finite."""
    values = np.array([np.nan if row.get(key) is None else row[key] for row in rows], dtype=np.float64)
    return np.where(np.isfinite(values), np.clip(values, -HUGE, HUGE), np.nan)


def _decades(values: FloatArray) -> tuple[float, float]:
    """Limits of a log axis around the positive values, at most `DECADES` below the largest."""
    positive = values[values > 0.0]
    if not positive.size:
        return 1e-1, 1e1
    top = np.ceil(np.log10(positive.max()) + 0.2)
    bottom = np.floor(np.log10(positive.min()) - 0.2)
    if top - bottom > 2 * DECADES or top < -200:
        bottom = max(bottom, top - DECADES)
    return float(10.0 ** max(bottom, -300.0)), float(10.0 ** max(top, -299.0))


def _limits(values: FloatArray, curve: ArrayLike | None) -> tuple[float, float]:
    """Limits of a linear axis around all values, with a margin; never empty."""
    everything = np.concatenate([np.ravel(values), np.ravel([] if curve is None else curve)])
    if not everything.size:
        return -1.0, 1.0
    low, high = float(everything.min()), float(everything.max())
    margin = max(0.06 * (high - low), 1e-3 * max(abs(low), abs(high)))
    margin = margin if margin > TINY else 1.0
    return low - margin, high + margin


def _bound(*arrays: ArrayLike) -> float:
    """Largest magnitude, for a colour scale; 1 when all is zero or nothing is there."""
    largest = max(float(np.max(np.abs(values), initial=0.0)) for values in arrays)
    return largest if largest > TINY else 1.0


def _half_width(distance: FloatArray, at_least: float, count: int) -> float:
    """Half the thickness of a slab: half a cell, or more when that holds fewer than `count` particles."""
    nearest = np.sort(distance)[:count]
    return max(0.5 * at_least, float(nearest[-1]) if nearest.size else 0.0)


def _drawable(values: FloatArray) -> FloatArray:
    """Finite values without those that overflow or underflow when matplotlib scales them."""
    return np.where(np.abs(values) < TINY, 0.0, np.clip(values, -HUGE, HUGE))


def _finite(value: Any) -> float:
    return float(np.clip(np.nan_to_num(float(value)), -HUGE, HUGE))


def _short(value: Any) -> str:
    return f"{float(value):.6g}"


def _title(scene: Any, ending: str) -> str:
    return ending if scene is None else f"{scene.name}    filter: {scene.filter.kind}    {ending}"
