"""Growth per step of a scheme over many patterns of particles: the largest, and where it is found.

    ./run exec python benchmarks/growth.py [--scheme recommended] [--dim 1] [--cells 16] [--per-cell 1 2 4 8]
        [--seeds 20] [--set KEY=VALUE]

For random and jittered (by up to 0.4 spacings) particles, and flows that move all axes and recur after a few steps. A
step is q ← (1 - α) q + Φ (K + α) W q: W takes particles to nodes, K is the nodal step, α the damping of the null space.
Here these are dense matrices in plain NumPy, so that the monodromy M costs a few products and all its eigenvalues are
found. For one pattern of every group M is held to the steps of a run, and where there are few unknowns its growth to
that of `mpipic.analysis.growth`.
"""

from __future__ import annotations

import argparse
from functools import reduce
from itertools import product
from math import comb, factorial
from time import perf_counter
from typing import Any

from mpipic.runtime import start

COMM = start()

import numpy as np  # noqa: E402  after the settings that start() makes
from numpy.typing import NDArray  # noqa: E402

import mpipic.run.parts  # noqa: E402, F401  all that scenes can name
from mpipic.analysis.growth import Monodromy, analyse  # noqa: E402
from mpipic.analysis.recurrence import find  # noqa: E402
from mpipic.mesh.basis import BASES  # noqa: E402
from mpipic.scene.records import Scene  # noqa: E402

Matrix = NDArray[np.float64]
CELLS = {1: 16, 2: 8, 3: 4}
PER_AXIS = {1: {1: [1], 2: [2], 4: [4], 8: [8]}, 2: {1: [1, 1], 2: [2, 1], 4: [2, 2], 8: [4, 2]},
            3: {1: [1, 1, 1], 2: [2, 1, 1], 4: [2, 2, 1], 8: [2, 2, 2]}}  # fmt: skip
SETTINGS: dict[int, list[tuple[float, int, tuple[int, ...]]]] = {
    1: [(0.4, 20, (1,)), (0.4, 40, (3,)), (0.4, 10, (1,)), (0.4, 40, (1,)), (0.4, 50, (1,)), (0.4, 5, (1,)),
        (0.4, 20, (7,)), (0.4, 5, (2,)), (0.4, 20, (13,)), (0.4, 5, (4,)), (0.1, 80, (1,)), (0.1, 40, (1,)),
        (0.1, 20, (1,)), (0.1, 10, (1,)), (0.1, 5, (1,)), (0.4, 1, (0,))],
    2: [(0.4, 20, (1, 1)), (0.4, 10, (7, 4)), (0.1, 20, (2, 1)), (0.4, 20, (2, 1)), (0.4, 20, (3, 2)),
        (0.4, 20, (7, 4)), (0.1, 20, (1, 1)), (0.1, 20, (4, 1)), (0.4, 1, (0, 0))],
    3: [(0.4, 20, (1, 1, 1)), (0.4, 10, (1, 1, 1)), (0.4, 10, (6, 4, 3)), (0.1, 20, (1, 1, 1)), (0.4, 20, (3, 2, 1)),
        (0.4, 20, (6, 4, 3)), (0.1, 20, (3, 2, 1)), (0.4, 1, (0, 0, 0))],
}  # fmt: skip
"""Dimension to CFL number, period T and the cells that the particles move along each axis in T steps.

The first are the worst: particles hear the grid pass at the frequencies 2π v/h, and where sound of a wave that fits in
the box has one of these, it feeds on what is at rest in the particles and no node sees. That is where v/c is a multiple
of 1/cells along an axis.
"""
SCHEMES = {
    "recommended": ("recommended", []),
    "quadratic": ("recommended", ["mapping.basis=quadratic"]),
    "linear": ("recommended", ["mapping.basis=linear"]),
    "paper": ("paper", []),
}
"""Name to preset and changes."""
MANY = 1000
"""Unknowns above which only the first three settings are taken."""
FEW = 400
"""Unknowns up to which `mpipic.analysis.growth` is asked too."""


# ---------------------------------------------------------------- the scheme as dense matrices; unit cells, c = ρ₀ = 1


def splines(degree: int, n: int, x: Matrix) -> Matrix:
    """Values (particles, n) of the periodic B-splines of an axis at x, in cells."""
    total = np.zeros((len(x), n))
    for image in (-n, 0, n):
        t = 0.5 * (degree + 1) - np.abs(x[:, None] - np.arange(n) + image)
        for j in range(degree // 2 + 1):
            total += (-1) ** j * comb(degree + 1, j) * np.maximum(t - j, 0.0) ** degree / factorial(degree)
    return total


def slopes_of_hats(n: int, x: Matrix) -> Matrix:
    """Derivatives (particles, n) of the linear ones, those of the right-hand cell on nodes."""
    left = np.floor(x + 1e-10)[:, None]
    node = np.arange(n)
    return (np.mod(left + 1 - node, n) == 0).astype(float) - (np.mod(left - node, n) == 0)


def tensor(factors: list[Matrix]) -> Matrix:
    """Row by row the tensor product of (particles, n_a) arrays, last axis fastest."""
    return reduce(lambda a, b: (a[:, :, None] * b[:, None, :]).reshape(len(a), -1), factors)


def along(axis: int, dim: int, matrix: Matrix) -> Matrix:
    """`matrix` on one axis, the identity on the others."""
    return reduce(np.kron, [matrix if a == axis else np.eye(len(matrix)) for a in range(dim)])


def circulant(n: int, weights: dict[int, float]) -> Matrix:
    """Σ_j w_j (v_i to v_{i+j}), periodic."""
    return np.asarray(sum(w * np.roll(np.eye(n), j, axis=1) for j, w in weights.items()))


def entry(dim: int, row: int, column: int) -> Matrix:
    """Of the 1 + d fields, the matrix that takes one to another."""
    return np.outer(np.eye(1 + dim)[row], np.eye(1 + dim)[column])


def difference(n: int, order: int) -> Matrix:
    """The central difference."""
    q = order // 2
    right = {j: -((-1.0) ** j) * factorial(q) ** 2 / (j * factorial(q - j) * factorial(q + j)) for j in range(1, q + 1)}
    upper = circulant(n, right)
    return upper - upper.T


class Steps:
    """The steps of a scene at given positions, in cells: α, W, (m, n), and K on (node, field), node by node."""

    def __init__(self, scene: Scene) -> None:
        self.dim, self.n, self.scene = scene.dim, scene.grid.cells[0], scene
        self.degree, self.share = BASES[scene.mapping.basis].degree, min(1.0, scene.damping.null_space * scene.cfl)
        if scene.mapping.mass != "penalised":
            return
        dim, n, mapping, damping = self.dim, self.n, scene.mapping, scene.damping
        second = circulant(n, {0: 0.5, 1: -0.25, -1: -0.25})
        rough = np.linalg.matrix_power(second, mapping.penalty_order)
        self.penalty = mapping.penalty * sum(along(a, dim, rough) for a in range(dim))
        slope = difference(n, mapping.gradient_order)
        z = np.zeros((n**dim * (1 + dim),) * 2)
        for a in range(dim):
            z -= scene.cfl * np.kron(along(a, dim, slope), entry(dim, 0, a + 1) + entry(dim, a + 1, 0))
        one = np.eye(len(z))
        rk4 = one + z @ (one + z / 2.0 @ (one + z / 3.0 @ (one + z / 4.0)))
        strength = min(1.0, damping.strength * scene.cfl) if damping.order else 0.0
        loss = strength * np.linalg.matrix_power(second, damping.order)
        keep = reduce(np.matmul, [along(a, dim, np.eye(n) - loss) for a in range(dim)])
        self.nodal = np.kron(keep, np.eye(1 + dim)) @ rk4 - one

    def at(self, x: Matrix) -> tuple[Matrix, Matrix, Matrix]:
        """Φ, K and W."""
        values = [splines(self.degree, self.n, x[:, a]) for a in range(self.dim)]
        phi = tensor(values)
        if self.scene.mapping.mass == "penalised":
            gram = phi.T @ phi + len(phi) / phi.shape[1] * self.penalty
            return phi, self.nodal, np.linalg.solve(gram, phi.T)
        count = phi.sum(axis=0)
        mean = phi.T / np.where(count > 0.0, count, 1.0)[:, None]
        to_density, to_velocity = np.zeros((2, phi.shape[1] * (1 + self.dim), phi.shape[1] * (1 + self.dim)))
        for a in range(self.dim):
            slopes = [slopes_of_hats(self.n, x[:, b]) if b == a else values[b] for b in range(self.dim)]
            filtered = -self.scene.cfl * mean @ tensor(slopes)
            to_density += np.kron(filtered, entry(self.dim, 0, a + 1))
            to_velocity += np.kron(filtered, entry(self.dim, a + 1, 0))
        smooth = np.kron(mean @ phi, np.eye(1 + self.dim))
        return phi, to_density + to_velocity + to_velocity @ smooth @ to_density, mean


def monodromy(scene: Scene, x: Matrix, move: Matrix, period: int) -> Matrix:
    """M on (particle, field), particle by particle; x in cells, move in cells a step."""
    steps, width = Steps(scene), 1 + scene.dim
    m = np.eye(len(x) * width)
    for step in range(period):
        phi, nodal, to_nodes = steps.at(np.mod(x + step * move, steps.n))
        fields = (to_nodes @ m.reshape(len(x), -1)).reshape(-1, len(m))
        change = nodal @ fields + steps.share * fields
        m = (1.0 - steps.share) * m + (phi @ change.reshape(phi.shape[1], -1)).reshape(m.shape)
    return m


def growth_of(m: Matrix, period: int) -> float:
    """μ - 1."""
    return float(np.expm1(np.log(np.abs(np.linalg.eigvals(m)).max()) / period))


# ---------------------------------------------------------------- the survey


def scene_of(chosen: argparse.Namespace, layout: str, per_cell: int, seed: int, setting: Any) -> Scene:
    dim, (cfl, period, cells) = chosen.dim, setting
    each = [per_cell] if layout == "random" else PER_AXIS[dim][per_cell]
    preset, changes = SCHEMES[chosen.scheme]
    overrides = [
        f"grid.cells={[chosen.cells or CELLS[dim]] * dim}", f"particles.layout={layout}", f"particles.per_cell={each}",
        f"particles.seed={seed}", f"gas.flow={[float(k / (period * cfl)) for k in cells]}", f"time.cfl={cfl}",
        "initial.profile=plane-wave", *(["particles.jitter=0.4"] if layout == "jittered" else []),
        *changes, *chosen.set,
    ]  # fmt: skip
    return Scene.load(None, overrides, preset)


def examine(scene: Scene, setting: Any, held: bool) -> tuple[float, list[float]]:
    """Growth, and if it is to be held to the package: the largest difference of M q, and that of the growth or none."""
    package = Monodromy(scene, COMM, find(scene, 100))
    period, move = setting[1], np.array(setting[2]) / setting[1]
    m = monodromy(scene, package.position / np.array(scene.h), move, period)
    growth, differences = growth_of(m, period), []
    if held:
        q = np.random.default_rng(0).standard_normal(len(m))
        differences.append(float(np.abs(package.apply(q) - m @ q).max() / np.abs(m @ q).max()))
        if len(m) <= FEW:
            differences.append(abs(analyse(scene, COMM, 100).growth_per_step - growth))
    package.simulation.close()
    return growth, differences


def label(setting: Any) -> str:
    cfl, period, cells = setting
    return f"v/c {np.linalg.norm(cells) / period / cfl:.3g}, CFL {cfl}, T {period}, moves {list(cells)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scheme", choices=SCHEMES, default="recommended")
    parser.add_argument("--dim", type=int, choices=CELLS, default=1)
    parser.add_argument("--cells", type=int, help="per axis; 16, 8 or 4 unless given")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--per-cell", type=int, nargs="+", default=[1, 2, 4, 8])
    parser.add_argument("--set", action="append", default=[], help="KEY=VALUE of the scene")
    chosen = parser.parse_args()
    for per_cell, layout in product(chosen.per_cell, ("random", "jittered")):
        begin, found, differences = perf_counter(), [], []
        unknowns = (chosen.cells or CELLS[chosen.dim]) ** chosen.dim * per_cell * (1 + chosen.dim)
        settings = SETTINGS[chosen.dim][: 3 if unknowns > MANY else None]
        for seed, setting in product(range(chosen.seeds), settings):
            scene = scene_of(chosen, layout, per_cell, seed, setting)
            growth, off = examine(scene, setting, held=(seed, setting) == (0, settings[0]))
            found.append((growth, f"seed {seed}, {label(setting)}"))
            differences += off
        largest = max(found)
        above = sum(growth > 1e-7 for growth, _ in found)
        checks = ", ".join(f"{name} {value:.1e}" for name, value in zip(("step", "growth"), differences))
        print(
            f"{chosen.scheme} {chosen.dim}D {layout:8s} {per_cell} a cell: largest growth {largest[0]:9.2e} "
            f"({largest[1]}); above 1e-7: {above} of {len(found)}; differs from the package: {checks}; "
            f"{perf_counter() - begin:.0f} s", flush=True,
        )  # fmt: skip


if __name__ == "__main__":
    main()
