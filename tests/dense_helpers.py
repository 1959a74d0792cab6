"""The method in plain NumPy, as dense matrices built straight from the definitions: what the package is held to.

Nothing here uses the package. Particles p, nodes i of a periodic grid of spacing h_a, linear basis:

    φ_i(x) = Π_a Σ_k max(0, 1 - |x_a/h_a - i_a - k N_a|),    Φ_pi = φ_i(x_p),    D^a_pi = ∂φ_i/∂x_a (x_p),
    d = Φᵀ1,    S = diag(d)⁻¹ Φᵀ (rows of nodes that no particle sees are zero),    G = ΦᵀΦ,

or, with V = diag(V_p) what the particles count, d = ΦᵀV1, S = diag(d)⁻¹ ΦᵀV and G = ΦᵀVΦ. The projection on what the
nodes see, orthogonal in the inner product Σ_p V_p q_p r_p, is P = Φ G⁺ ΦᵀV = V^-½ U Uᵀ V^½, the columns of U being the
left singular vectors of V^½ Φ that have singular values above zero.

A particle on a node, or less than 1e-10 cells to its left, takes its slopes from the cell to the right of the node.
Nodes are numbered as an array of shape `cells` in C order: the last axis runs fastest.
"""

from __future__ import annotations

from functools import cached_property, reduce
from itertools import product

import numpy as np

from covering_helpers import cover

ON_NODE = 1e-10


def hat_matrices(n, h, x):
    """Values and slopes of the n periodic hat functions of one axis at positions x: two (particles, n) arrays."""
    cells = np.asarray(x, dtype=float)[:, None] / h
    left = np.floor(cells + ON_NODE)
    inside = np.maximum(cells - left, 0.0)
    left = np.mod(left, n)
    cells, node = left + inside, np.arange(n)
    images = [node + k * n for k in (-1, 0, 1)]
    values = sum(np.maximum(0.0, 1.0 - np.abs(cells - i)) for i in images)
    slopes = sum((left == i - 1).astype(float) - (left == i) for i in images) / h
    return values, slopes


def tensor(factors):
    """Row by row the tensor product of (particles, n_a) arrays, last axis fastest: (particles, Π n_a)."""
    return reduce(lambda a, b: (a[:, :, None] * b[:, None, :]).reshape(len(a), a.shape[1] * b.shape[1]), factors)


class Dense:
    """Φ, D^a, d, S and G at positions (n, d) in the box, of particles that count 1 each or have weights (n,)."""

    def __init__(self, cells, length, position, weight=None):
        position = np.asarray(position, dtype=float).reshape(-1, len(cells))
        axes = [hat_matrices(n, box / n, x) for n, box, x in zip(cells, length, position.T)]
        self.phi = tensor([values for values, _ in axes])
        self.D = [
            tensor([slopes if b == a else values for b, (values, slopes) in enumerate(axes)]) for a in range(len(cells))
        ]
        self.weight = np.ones(len(position)) if weight is None else np.asarray(weight, dtype=float)
        transposed = self.phi.T * self.weight
        self.d = transposed.sum(axis=1)
        self.seen = self.d > 0
        self.S = np.zeros(transposed.shape)
        self.S[self.seen] = transposed[self.seen] / self.d[self.seen, None]
        self.G = transposed @ self.phi

    def gradient(self, nodal):
        """D nodal: (m,) to (n, d)."""
        return np.stack([D @ nodal for D in self.D], axis=1)

    def divergence(self, nodal):
        """Σ_a D^a nodal_a: (m, d) to (n,)."""
        return sum(D @ u for D, u in zip(self.D, nodal.T))

    def filter(self, kind):
        """The filter as a matrix (n, n)."""
        if kind == "none":
            return np.eye(len(self.phi))
        if kind == "local":
            return self.phi @ self.S
        if kind == "order":
            return self.order(2)
        if kind == "chebyshev":
            return self.chebyshev(2)
        if kind in ("exact", "svd"):
            return self.projection()
        raise AssertionError(f"write out the filter {kind} here")

    def order(self, k):
        """Φ [Σ_{j<k} (1 - SΦ)^j] S as a matrix."""
        smooth = self.S @ self.phi
        terms = [np.linalg.matrix_power(np.eye(len(smooth)) - smooth, j) for j in range(k)]
        return self.phi @ sum(terms) @ self.S

    def chebyshev(self, k):
        """Φ p(SΦ) S with 1 - λ p(λ) = (1 - λ) T(λ), T the Chebyshev polynomial scaled to [3^-d, 1] and T(0) = 1.

        By the eigenvalues of the symmetric diag(d)^-1/2 G diag(d)^-1/2, which are those of SΦ.
        """
        low = 3.0 ** -len(self.D)
        chebyshev = np.polynomial.chebyshev.Chebyshev.basis(k - 1)

        def scaled(x):
            return chebyshev((1.0 + low - 2.0 * x) / (1.0 - low)) / chebyshev((1.0 + low) / (1.0 - low))

        root = np.zeros(len(self.d))
        root[self.seen] = self.d[self.seen] ** -0.5
        values, vectors = np.linalg.eigh(root[:, None] * self.G * root)
        kept = values > 1e-12
        gain = np.zeros(len(values))
        gain[kept] = (1.0 - (1.0 - values[kept]) * scaled(values[kept])) / values[kept]
        nodal = (vectors * gain) @ vectors.T
        return self.phi @ (root[:, None] * nodal * root) @ (self.phi.T * self.weight)

    @cached_property
    def range(self):
        """Orthonormal basis of the range of V^½ Φ, (n, rank), by its singular values."""
        u, s, _ = np.linalg.svd(np.sqrt(self.weight)[:, None] * self.phi, full_matrices=False)
        return u[:, s > 1e-10 * s[0]]

    def projection(self):
        """P = Φ G⁺ ΦᵀV, the orthogonal projection on what the nodes see, by singular values of V^½ Φ."""
        root = np.sqrt(self.weight)
        return self.range @ self.range.T * root / root[:, None]

    def null_space_share(self, q):
        """‖(I - P) q‖ / ‖q‖, in the norm of the particles' inner product."""
        seen = q * np.sqrt(self.weight)
        return np.linalg.norm(seen - self.range @ (self.range.T @ seen)) / np.linalg.norm(seen)

    def euler_step(self, density, velocity, rates, kind):
        """Formulation 2 at these positions: new density (n,) and velocity (n, d). rates = (dt ρ₀, dt c²/ρ₀)."""
        F = self.filter(kind)
        density = density - rates[0] * F @ self.divergence(self.S @ velocity)
        velocity = velocity - rates[1] * F @ self.gradient(self.S @ density)
        return density, velocity


def run_euler(cells, length, position, density, velocity, flow, rates, kind, steps):
    """That many steps of Formulation 2, `flow` (length a step) moving the particles: position, density, velocity."""
    for _ in range(steps):
        density, velocity = Dense(cells, length, position).euler_step(density, velocity, rates, kind)
        position = np.mod(position + np.asarray(flow), length)
    return position, density, velocity


# ---------------------------------------------------------------- particles to try


def _exactly(coordinate):
    """Multiples of 2^-40 cells, which no move by a multiple of 2^-40 cells rounds."""
    return np.floor(coordinate * 2.0**40) * 2.0**-40


def _random(cells, rng):
    return rng.random((4 * int(np.prod(cells)), len(cells))) * cells


def _lattice(cells, rng, offset=0.5):
    axes = [(np.arange(2 * n) + offset) / 2 for n in cells]
    return np.stack([x.ravel() for x in np.meshgrid(*axes)], axis=1)


def _jittered(cells, rng):
    lattice = _lattice(cells, rng)
    return np.mod(lattice + 0.2 * (2 * rng.random(lattice.shape) - 1), cells)


def _few(cells, rng):
    return rng.random((max(1, int(np.prod(cells)) // 6), len(cells))) * cells


def _one_cell(cells, rng):
    return rng.random((20, len(cells))) + np.array(cells) - 1


PATTERNS = {
    "random": _random,
    "jittered": _jittered,
    "lattice": _lattice,
    "on nodes": lambda cells, rng: _lattice(cells, rng, offset=0.0),
    "crowd": lambda cells, rng: rng.random((700, len(cells))) * cells,
    "few": _few,
    "one": lambda cells, rng: rng.random((1, len(cells))) * cells,
    "coincident": lambda cells, rng: np.repeat(rng.random((1, len(cells))) * cells, 7, axis=0),
    "all in one cell": _one_cell,
}
"""Name to function (cells, rng) -> coordinates (n, d) in cells."""


def pattern(name, cells, length, seed=0):
    """Positions (n, d) of a pattern, unit of length."""
    coordinate = _exactly(PATTERNS[name](np.array(cells), np.random.default_rng(seed)))
    return coordinate * (np.array(length) / np.array(cells))


GRIDS = {
    "1D": ((7,), (1.3,)),
    "1D, one cell": ((1,), (0.7,)),
    "1D, two cells": ((2,), (2.0,)),
    "2D": ((5, 4), (1.0, 2.5)),
    "2D, one cell across": ((1, 3), (0.3, 1.0)),
    "2D, two cells by one": ((2, 1), (1.0, 1.0)),
    "2D, aspect 1e6": ((4, 3), (1e-3, 1e3)),
    "3D": ((3, 4, 5), (1.0, 0.8, 1.7)),
    "3D, one and two cells": ((1, 2, 3), (1.0, 0.5, 1.2)),
    "3D, two cells each": ((2, 2, 2), (1.0, 1.0, 3.0)),
    "3D, aspect 1e6": ((3, 2, 4), (1e-3, 1.0, 1e3)),
}
"""Name to (cells, length)."""


def _size(box):
    return "long cells" if "aspect" in box else "small" if min(GRIDS[box][0]) <= 2 else "roomy"


def _meetings(row):
    *others, box, name = row
    dim, size = len(GRIDS[box][0]), _size(box)
    met = {("dimension", dim, name), ("size", size, name), box}
    if name == "random":
        met.add((dim, size))
    for number, other in enumerate(others):
        met |= {(number, other, box), (number, other, name)}
        met |= {(number, other, more, another) for more, another in enumerate(others) if more > number}
    return met


def few_cases(*others, boxes=GRIDS, names=PATTERNS):
    """Few rows (*others, grid, pattern): every pattern in every dimension and on grids of every size, random particles
    on every size in every dimension; and each value of another factor on every grid and with every pattern.
    """
    return cover(list(product(*others, boxes, names)), _meetings)


def close(actual, wanted, tolerance=1e-12, scale=None):
    """Assert that arrays agree to `tolerance`, relative to the largest entry wanted or to `scale`."""
    actual, wanted = np.asarray(actual), np.asarray(wanted)
    assert actual.shape == wanted.shape
    scale = np.abs(wanted).max(initial=0.0) if scale is None else scale
    error = np.abs(actual - wanted).max(initial=0.0)
    assert error <= tolerance * scale, f"differ by {error:.3g}, more than {tolerance:g} of {scale:.3g}"
