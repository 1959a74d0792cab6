"""Compiled loops, chosen by dimension. Nothing here knows of ranks, scenes or files."""

from dataclasses import dataclass

from mpipic.kernels import advance, cells
from mpipic.kernels.common import Loop


@dataclass(frozen=True)
class LinearLoops:
    """Holds the loops of the linear basis in one dimension.

    `advance` and `deposit` go over particles (see `kernels.advance`), `gram` and `cross` over cells (`kernels.cells`);
    so does `row_sums`, which is there where the sweep over particles leaves the row sums to it.
    """

    advance: Loop
    deposit: Loop
    gram: Loop
    cross: Loop
    row_sums: Loop | None = None


BY_DIMENSION = {
    1: LinearLoops(advance.advance_1d, advance.deposit_1d, cells.gram_1d, cells.cross_1d),
    2: LinearLoops(advance.advance_2d, advance.deposit_2d, cells.gram_2d, cells.cross_2d),
    3: LinearLoops(advance.advance_3d, advance.deposit_3d, cells.gram_3d, cells.cross_3d, cells.row_sums_3d),
}
"""Dimension to loops."""
