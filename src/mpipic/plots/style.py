"""All pictures share these: colours, lines, titles, scales that no data can break, and a figure without a window.

matplotlib is imported when a picture is drawn. Data may hold anything that a run that blew up leaves behind: values
that are not finite are left out and counted, huge ones are clipped at `HUGE`, those below `TINY` are drawn as 0.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict
from warnings import catch_warnings, filterwarnings

import numpy as np
from numpy.typing import ArrayLike

from mpipic.arrays import FloatArray
from mpipic.files import replacing
from mpipic.wording import escape

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Okabe and Ito: told apart with any colour vision, and by lightness in print.
BLUE, ORANGE, PINK, BLACK = "#0072B2", "#D55E00", "#CC79A7", "#222222"
COLOURS = (BLUE, ORANGE, "#009E73", PINK, "#E69F00", BLACK, "#56B4E9")
DASHES, MARKERS = ("-", "--", "-.", ":"), "osv^Dx+"
HUGE, TINY = 1e150, 1e-150
DECADES = 16
LONGEST_LINE, LONGEST_LABEL = 120, 40
"""Characters of a line of text, and of a label in a legend."""
STYLE = {
    "font.size": 10, "axes.grid": True, "grid.color": "#DDDDDD", "grid.linewidth": 0.6, "axes.axisbelow": True,
    "axes.spines.top": False, "axes.spines.right": False, "legend.frameon": False, "axes.titlesize": 10,
    "figure.dpi": 120, "figure.constrained_layout.use": True,
}  # fmt: skip


@dataclass(frozen=True)
class Subject:
    """The run that a picture shows.

    Attributes
    ----------
    name, filter
        Named in the title.
    length, h
        The box and the spacing of its nodes on every axis.
    scalar, vector
        Which fields of the particles are drawn; no vector: None.
    symbols
        Name of a field to its symbol.
    """

    name: str
    filter: str
    length: tuple[float, ...]
    h: tuple[float, ...]
    scalar: str = "density"
    vector: str | None = "velocity"
    symbols: Mapping[str, str] = field(default_factory=dict)

    def symbol(self, name: str) -> str:
        """Return the symbol of a field, or else its name."""
        return self.symbols.get(name, name)

    def label(self, name: str) -> str:
        """Return name and symbol of a field."""
        return f"{name} {self.symbols[name]}" if name in self.symbols else name

    def title(self, ending: str) -> str:
        """Return name, filter and `ending` on one line."""
        return f"{self.name}    filter: {self.filter}    {ending}"


class LineStyle(TypedDict):
    """Colour, dashes, marker and sizes of a curve, as matplotlib calls them."""

    color: str
    ls: str
    marker: str
    ms: float
    lw: float


def line_style(number: int, markers: str = MARKERS, size: float = 3.5) -> LineStyle:
    """Return the style of the curve with this number: neighbours differ in colour, dashes and marker."""
    return {
        "color": COLOURS[number % len(COLOURS)], "ls": DASHES[number % len(DASHES)],
        "marker": markers[number % len(markers)], "ms": size, "lw": 1.3,
    }  # fmt: skip


@contextmanager
def picture(path: Path | str, size: tuple[float, float]) -> Iterator[Figure]:
    """Yield a figure without a window, saved as PNG in one piece when the block ends well; `size` in inches.

    Names that users give appear as they are: see `_write_as_it_is`.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        figure = Figure(figsize=size)
        FigureCanvasAgg(figure)
        yield figure
        _write_as_it_is(figure)
        with replacing(Path(path)) as temporary, catch_warnings():
            filterwarnings("ignore", "Glyph .* missing from", UserWarning)  # a box stands for it
            figure.savefig(temporary, format="png", dpi=150)


def _write_as_it_is(figure: Figure) -> None:
    """Have no text taken for mathematics but the numbers along axes; cut and escape what cannot be drawn."""
    from matplotlib.axis import Axis, Tick
    from matplotlib.text import Text

    numbers = {label for tick in figure.findobj(Tick) for label in (tick.label1, tick.label2)}
    numbers |= {axis.offsetText for axis in figure.findobj(Axis)}
    for text in figure.findobj(Text):
        if text not in numbers:
            text.set_parse_math(False)
            text.set_text("\n".join(_without_middle(line, LONGEST_LINE) for line in text.get_text().split("\n")))


def in_legend(label: str) -> str:
    """Return a label that leaves a picture its place, and that a legend shows: none begins with an underscore."""
    label = _without_middle(label, LONGEST_LABEL)
    return f" {label}" if label.startswith("_") else label


def _without_middle(line: str, longest: int) -> str:
    """Return a line of text, cut in the middle if it is long, and with what does not print as escapes."""
    line = escape(line)
    return line if len(line) <= longest else f"{line[: longest // 2]}...{line[3 - longest // 2 :]}"


def short(value: float) -> str:
    """Return a number with six digits at most."""
    return f"{float(value):.6g}"


def drawable(values: FloatArray) -> FloatArray:
    """Return finite values without those that overflow or underflow when matplotlib scales them."""
    return np.where(np.abs(values) < TINY, 0.0, np.clip(values, -HUGE, HUGE))


def finite(value: float) -> float:
    """Return a number that can be drawn in place of any."""
    return float(np.clip(np.nan_to_num(float(value)), -HUGE, HUGE))


def decades(values: FloatArray) -> tuple[float, float]:
    """Return limits of a log axis around the positive values, at most `DECADES` below the largest."""
    positive = values[values > 0.0]
    if not positive.size:
        return 1e-1, 1e1
    top = np.ceil(np.log10(positive.max()) + 0.2)
    bottom = np.floor(np.log10(positive.min()) - 0.2)
    if top - bottom > 2 * DECADES or top < -200:
        bottom = max(bottom, top - DECADES)
    return float(10.0 ** max(bottom, -300.0)), float(10.0 ** max(top, -299.0))


def limits(values: FloatArray, curve: ArrayLike | None) -> tuple[float, float]:
    """Return limits of a linear axis around all values, with a margin; never empty."""
    everything = np.concatenate([np.ravel(values), np.ravel([] if curve is None else curve)])
    if not everything.size:
        return -1.0, 1.0
    low, high = float(everything.min()), float(everything.max())
    margin = max(0.06 * (high - low), 1e-3 * max(abs(low), abs(high)))
    margin = margin if margin > TINY else 1.0
    return low - margin, high + margin


def bound(*arrays: ArrayLike) -> float:
    """Return the largest magnitude, for a colour scale; 1 when all is zero or nothing is there."""
    largest = max(float(np.max(np.abs(values), initial=0.0)) for values in arrays)
    return largest if largest > TINY else 1.0
