"""Tells what a scene builds and leaves out, in words and in bytes, without building it: its parts say it."""

from __future__ import annotations

from typing import Protocol

from mpipic import parts
from mpipic.decomposition import process_grid
from mpipic.scene.records import Scene

MEGA = 1e6
LINES = {
    "grid": ("grid",),
    "particles": ("particles.layout",),
    "mapping": ("mapping.basis", "mapping.mass", "gas"),
    "filter": ("filter.kind",),
    "step": ("physics.kind",),
    "initial": ("initial.profile",),
}
"""Name of a line to the slots whose parts say it; a physics may lack some."""


class Ranks(Protocol):
    """Whoever knows how many ranks there are."""

    @property
    def size(self) -> int:
        """Number of ranks."""
        ...


def particle_bytes(scene: Scene) -> int:
    """Return the resident bytes per particle: coordinate, id, and what the parts carry."""
    values = scene.values
    return 8 * (values.dim + 1 + sum(part.particle_doubles(values) for part in parts.chosen(values)))


def node_bytes(scene: Scene) -> int:
    """Return the resident bytes per node of all parts."""
    return 8 * sum(part.node_doubles(scene.values) for part in parts.chosen(scene.values))


def rank_bytes(scene: Scene, ranks: int, particles: int) -> float:
    """Return the bytes of arrays on one of `ranks` equal ranks, without halos and interpreter (about 150 MB)."""
    return (particles * particle_bytes(scene) + scene.cell_count * node_bytes(scene)) / ranks


def built(scene: Scene) -> list[tuple[str, str]]:
    """Return what the scene builds as (part, description)."""
    values = scene.values

    present = parts.slots(values["physics.kind"])

    def words(*slots: str) -> str:
        here = (slot for slot in slots if slot in present)
        return ", ".join(filter(None, (values.part(slot).describe(values) for slot in here)))

    lines = [(name, words(*slots)) for name, slots in LINES.items()]
    return [(name, text) for name, text in lines if text]


def left_out(scene: Scene) -> list[str]:
    """Return what other scenes bring in and this one does not, and its keys that nothing uses."""
    values = scene.values
    brought = {name for part in parts.chosen(values) for name in part.brings(values)}
    names = dict.fromkeys(name for part in parts.registered() for name in part.brings_in)
    return [*(name for name in names if name not in brought), *(one.key for one in scene.unused)]


def describe(scene: Scene, comm: Ranks) -> list[tuple[str, str]]:
    """Return what `mpipic check` prints, as (name, value) lines. Local."""
    steps = f"{scene.time.steps} of dt = {scene.dt:.6g}, CFL {scene.cfl:.4g}"
    blocks = " x ".join(map(str, process_grid(scene.grid.cells, comm.size) or ()))
    lines = [("scene", scene.name), *built(scene), ("steps", steps)]
    lines += [("ranks", f"{comm.size}, as {blocks} blocks"), ("left out", ", ".join(left_out(scene)))]
    count = scene.particle_count
    each = f"{particle_bytes(scene)} bytes a particle, {node_bytes(scene)} bytes a node"
    if count is None:
        return [*lines, ("memory", each)]
    total = rank_bytes(scene, comm.size, count)
    return [
        *lines,
        ("memory", f"{each}: {total * comm.size / count:.0f} bytes a particle in all"),
        ("per rank", f"{total / MEGA:.1f} MB of arrays, and about 150 MB of libraries"),
    ]
