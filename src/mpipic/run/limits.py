"""The largest time step that a scene's scheme takes, from the frequencies of its gradients at frozen positions."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from mpipic.errors import NotConverged, Refused
from mpipic.parts import A_FILTER, NODAL_FILTER
from mpipic.physics.acoustics.integrators import INTEGRATORS
from mpipic.physics.acoustics.slopes import GRADIENTS
from mpipic.physics.acoustics.step import AcousticStep
from mpipic.run.build import build_sweep, place, step_on

if TYPE_CHECKING:
    from mpipic.scene.records import Scene

SAMPLE = {1: 48, 2: 12, 3: 6}
"""Dimension to the cells per axis of the piece of the scene that is looked at."""
PLACES = {1: 16, 2: 6, 3: 2}
"""Dimension to the places, evenly spread over a cell along its diagonal, that the skew gradient is looked at."""
DIGITS = 1e-5
"""To what the frequency is computed, which takes a solve with the Gram matrix for every node."""


def cfl_limit(scene: Scene, comm: MPI.Comm) -> float | None:
    """Return the CFL number that the scheme is stable up to at frozen positions; None if any, or where unknown.

    From the largest frequency of sound that the scheme has on a small periodic piece of the scene, with as many
    particles a cell in the same layout; with the skew gradient, whose frequencies depend much on where the particles
    are in their cells, at several places that the flow takes them to. On disordered particles larger scenes hold rarer
    patterns, so that their limit can be a little lower. Movement of the particles can make a scheme grow below this
    limit: that is what `mpipic.analysis.growth` finds. Collective: rank 0 computes, all know.
    """
    find = LIMITS.get(scene.physics.kind)
    found: float | Refused | None = None
    if find is not None and comm.rank == 0:
        try:
            found = find(scene)
        except Refused as error:
            found = error
    found = comm.bcast(found)
    if isinstance(found, Refused):
        raise found
    return found


def _of_acoustics(scene: Scene) -> float | None:
    reach = INTEGRATORS[scene.time.integrator].reach
    if math.isinf(reach) or scene.particle_count is None:
        return None
    piece = _piece(scene)
    try:
        frequency = _largest_frequency(piece)
    except NotConverged:
        return None
    if not frequency > 0.0:
        return None
    return float(reach * scene.gas.sound_speed / (frequency * min(scene.h)))


def _piece(scene: Scene) -> Scene:
    """Return a smaller box of the same cells and particles, without output."""
    data = scene.to_dict()
    most = SAMPLE[scene.dim]
    cells = [min(n, most) for n in scene.grid.cells]
    data["grid"] = {"cells": cells, "length": [h * n for h, n in zip(scene.h, cells, strict=True)]}
    data["initial"] = {"profile": "plane-wave", "wave": [1, *[0] * (scene.dim - 1)]}
    data["output"] = {}
    keep = scene.part("filter.kind")
    if keep.has(A_FILTER) and not keep.has(NODAL_FILTER):  # the decomposition: the same operator, at less cost
        data["filter"] = {"kind": "exact", "tolerance": DIGITS}
    for section in ("filter", "mapping"):
        if "tolerance" in data[section]:
            data[section]["tolerance"] = max(data[section]["tolerance"], DIGITS)
    data["time"]["steps"] = 0
    return scene.from_dict(data, name=scene.name)


def _largest_frequency(scene: Scene) -> float:
    """Square root of the largest |eigenvalue| of density to velocity to density."""
    grid, particles = place(scene, MPI.COMM_SELF)
    carrier = build_sweep(scene, grid, particles)
    rates = step_on(scene, carrier)
    shifting = GRADIENTS[scene.mapping.gradient].transposed and carrier.moving
    places = PLACES[scene.dim] if shifting else 1
    squares = 0.0
    for _ in range(places):
        squares = max(squares, _largest_square(rates))
        if shifting:
            particles.coordinate[...] = grid.wrapped(particles.coordinate + 1.0 / places)
            rates.restart()
    carrier.close()
    return float(np.sqrt(squares))


def _largest_square(rates: AcousticStep) -> float:
    nodes = rates.grid.node_count
    columns = np.empty((nodes, nodes))
    for node in range(nodes):
        unit = np.zeros(nodes)
        unit[node] = 1.0
        u = rates.factors[1] * rates.gained(rates.velocity(rates.spread(unit), 0))
        columns[:, node] = rates.own(rates.factors[0] * rates.gained(rates.density(u, 0)))
    return float(np.abs(np.linalg.eigvals(columns)).max())


LIMITS: dict[str, Callable[[Scene], float | None]] = {"acoustics": _of_acoustics}
"""Physics to what finds the limit on one rank; others have none that is known."""
