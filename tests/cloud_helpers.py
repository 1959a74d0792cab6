"""Clouds of particles that cover only part of their cells, or lie on lines and shells; and what a projection should be.

The projection is NumPy's, by the singular values of Φ with its columns scaled to norm 1; Φ is read off the mapping.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from mpipic.mapping.mapping import Mapping
from mpipic.mesh.grid import Grid

BASES = ("linear", "quadratic", "cubic")
CELLS = {1: (8, 50), 2: (6, 15), 3: (4, 7)}
"""Dimension to the fewest and most cells along an axis."""
MOST = 700


class Cloud(NamedTuple):
    """Particles in the unit box."""

    kind: str
    basis: str
    cells: tuple[int, ...]
    position: np.ndarray

    @property
    def name(self) -> str:
        return f"{self.kind} of {len(self.position)}, {self.basis}, {self.cells} cells"

    def mapping(self) -> Mapping:
        return Mapping(Grid(self.cells, (1.0,) * len(self.cells), basis=self.basis), self.position)


def lattice(rng, dim, n, a_cell):
    axis = (np.arange(n * a_cell) + 0.5) / (n * a_cell)
    return np.stack(np.meshgrid(*[axis] * dim, indexing="ij"), axis=-1).reshape(-1, dim)


def random(rng, dim, n, a_cell):
    return rng.random((min((a_cell * n) ** dim, 2000), dim))


def disc(x):
    return x[np.linalg.norm(x - 0.5, axis=1) < 0.31]


def ring(x):
    radius = np.linalg.norm(x - 0.5, axis=1)
    return x[(radius < 0.4) & (radius > 0.25)]


def block(rng, dim, n, a_cell):
    """A lattice of the size of half the box, turned in its first two axes."""
    x, angle = 0.5 * lattice(rng, dim, n, a_cell) - 0.24, rng.uniform(0.0, np.pi)
    if dim > 1:
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        x[:, :2] = x[:, :2] @ turn.T
    return x + 0.5


def blobs(rng, dim, n, a_cell):
    return np.concatenate([0.3 + 0.05 * rng.normal(size=(60, dim)), 0.7 + 0.03 * rng.normal(size=(60, dim))])


def line(rng, dim, n, a_cell):
    along = rng.normal(size=dim)
    return 0.5 + 0.4 * (rng.random(80)[:, None] - 0.5) * along / np.abs(along).max()


def shell(rng, dim, n, a_cell):
    x = rng.normal(size=(200, dim))
    return 0.5 + 0.3 * x / np.linalg.norm(x, axis=1)[:, None]


def one_cell(rng, dim, n, a_cell):
    return (n // 2 + rng.random((int(rng.integers(1, 60)), dim))) / n


def corner(rng, dim, n, a_cell):
    """Dense in one corner, with ever fewer particles away from it."""
    return 0.6 * rng.random((min(3 * n**dim, MOST), dim)) ** 3


KINDS = {
    "disc": lambda *a: disc(lattice(*a)),
    "random disc": lambda *a: disc(random(*a)),
    "ring": lambda *a: ring(lattice(*a)),
    "random ring": lambda *a: ring(random(*a)),
    "turned block": block,
    "two blobs": blobs,
    "line": line,
    "shell": shell,
    "one cell": one_cell,
    "corner": corner,
}


def clouds(count: int, seed: int = 0) -> Iterator[Cloud]:
    """As many clouds, of every kind in turn, in 1 to 3 dimensions on all bases, none of more than MOST particles."""
    rng, kinds = np.random.default_rng(seed), list(KINDS)
    made = 0
    while made < count:
        dim, basis = int(rng.integers(1, 4)), BASES[int(rng.integers(3))]
        n, a_cell = int(rng.integers(*CELLS[dim])), int(rng.integers(1, 4))
        kind = kinds[made % len(kinds)]
        position = KINDS[kind](rng, dim, n, a_cell)
        if 0 < len(position) <= MOST:
            made += 1
            yield Cloud(kind, basis, (n,) * dim, np.ascontiguousarray(position))


class Projected(NamedTuple):
    """Left singular vectors of the scaled Φ that count, and their singular values, falling."""

    vectors: np.ndarray
    values: np.ndarray

    def __call__(self, q: np.ndarray) -> np.ndarray:
        return self.vectors @ (self.vectors.T @ q)


def projected(mapping: Mapping) -> Projected:
    """The projection on what nodes see, by singular values; on one rank."""
    grid = mapping.grid
    nodal = np.zeros((grid.local_nodes, grid.node_count))
    own = grid.nodes.own(nodal)
    own[...] = np.eye(grid.node_count).reshape(own.shape)
    grid.fill_halo(nodal)
    phi = mapping.g2p(nodal)
    size = np.linalg.norm(phi, axis=0)
    vectors, values, _ = np.linalg.svd(phi[:, size > 0] / size[size > 0], full_matrices=False)
    count = int(np.sum(values > max(phi.shape) * np.finfo(float).eps * values[0]))
    return Projected(vectors[:, :count], values[:count])
