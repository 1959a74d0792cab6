"""Distributed particle-in-cell solver with null-space filters.

The library's door, for the particles of other codes: a `Grid`, a `Placement` that brings particles to the ranks that
own their cells, a `Mapping` at their positions, and a filter. Names are imported when first used, so that looking at a
scene does not start MPI.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mpipic.errors import NotConverged
    from mpipic.filters import FILTERS, ChebyshevFilter, ExactFilter, LocalFilter, OrderFilter, SvdFilter
    from mpipic.mapping.mapping import Mapping
    from mpipic.mesh.grid import Grid
    from mpipic.particles.placement import Placement
    from mpipic.run.loop import Simulation
    from mpipic.scene.records import Scene, SceneError

__version__ = "0.1.0"

_HOMES = {
    "FILTERS": "filters",
    "ChebyshevFilter": "filters",
    "ExactFilter": "filters",
    "LocalFilter": "filters",
    "OrderFilter": "filters",
    "SvdFilter": "filters",
    "NotConverged": "errors",
    "Grid": "mesh.grid",
    "Mapping": "mapping.mapping",
    "Placement": "particles.placement",
    "Scene": "scene.records",
    "SceneError": "scene.records",
    "Simulation": "run.loop",
}

__all__ = [
    "FILTERS",
    "ChebyshevFilter",
    "ExactFilter",
    "Grid",
    "LocalFilter",
    "Mapping",
    "NotConverged",
    "OrderFilter",
    "Placement",
    "Scene",
    "SceneError",
    "Simulation",
    "SvdFilter",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        near = import_module("mpipic.wording").closest(name, __all__)
        hint = f"; did you mean {near!r}?" if near else ""
        raise AttributeError(f"module 'mpipic' has no attribute {name!r}{hint}")
    if _HOMES[name] == "scene.records":
        import_module("mpipic.run.parts")  # all that a scene can name
    return getattr(import_module(f"mpipic.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
