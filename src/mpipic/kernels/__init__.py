"""Compiled loops, chosen by dimension. Nothing here knows of ranks, scenes or files."""

from types import SimpleNamespace

from mpipic.kernels import advance, cells

BY_DIMENSION = {
    dim: SimpleNamespace(
        advance=getattr(advance, f"advance_{dim}d"),
        deposit=getattr(advance, f"deposit_{dim}d"),
        gram=getattr(cells, f"gram_{dim}d"),
        cross=getattr(cells, f"cross_{dim}d"),
        row_sums=getattr(cells, f"row_sums_{dim}d"),
    )
    for dim in (1, 2, 3)
}
"""The loops of the linear basis for one, two and three dimensions."""
