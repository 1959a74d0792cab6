"""Whether a scene can be divided among ranks."""

from __future__ import annotations

from mpipic.decomposition import process_grid
from mpipic.scene.records import Problem, Scene, SceneError


def check_ranks(scene: Scene, size: int) -> None:
    """Raise SceneError when the cells cannot be divided among `size` ranks; names the nearest count below. Local."""
    cells = scene.grid.cells
    if process_grid(cells, size) is not None:
        return
    rule = "must be at least 1"
    if size > 1:
        fewer = min(size - 1, scene.cell_count)
        while process_grid(cells, fewer) is None:
            fewer -= 1
        rule = f"cannot divide grid.cells = {list(cells)} into blocks; the nearest smaller number that can is {fewer}"
    raise SceneError([Problem("number of ranks", size, rule)])
