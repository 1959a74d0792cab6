"""The row space of the mapping matrix S by SLEPc's distributed singular value decomposition: the paper's global filter.

Imports SLEPc; nothing else does. Of its solvers, thick-restart Lanczos (`trlanczos`) is the default: on 1 and 2 ranks
and from 60 × 100 to 1000 × 4000, with full and with deficient rank, its projection agrees with a dense NumPy
decomposition to 4e-15. `cross` is at best a little faster, but where the rank is deficient it cannot tell singular
values below 1e-8 from zero; `randomized` misses triplets; `lapack` computes everything on every rank, `scalapack` takes
4 to 8 times as long. Where nearly all singular values are 0 (coincident particles), Lanczos breaks down, and `lapack`
takes over. ``-filter_svd_type`` chooses another.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from mpipic.arrays import FloatArray
from mpipic.errors import NotConverged
from mpipic.filters.family import TooLarge
from mpipic.kernels import spline
from mpipic.memory import free_bytes
from mpipic.mesh.petsc_options import Solver, configure, refusing

if TYPE_CHECKING:
    from mpipic.mapping.base import NodalMapping

TOLERANCE = 1e-14
"""Relative residual of the triplets."""
MOST_RESTARTS = 30
"""Most restarts of Lanczos, which here has room for all vectors at once and needs no more than a few."""


class RowSpace:
    """An orthonormal basis V_r of the row space of S at the mapping's positions.

    The numerical rank r counts singular values above max(m, n) ε σ_1, with ε the spacing of floating-point numbers:
    what rounding alone can make of a zero.

    Attributes
    ----------
    basis : (n, r)
        Own rows of V_r.
    facts
        rank; cut; the singular values on either side of it, None where there is none; SLEPc's solver.

    Raises
    ------
    TooLarge
    NotConverged
        Not all triplets came out.

    Notes
    -----
    Collective. O(m² n + m³) work over the ranks, memory as in `bytes_needed`.
    """

    def __init__(self, mapping: NodalMapping) -> None:
        self.grid = mapping.grid
        self.each = np.ones(mapping.count) if mapping.weight is None else np.sqrt(mapping.weight)
        nodes, particles = self.grid.node_count, self.grid.comm.allreduce(mapping.count)
        check_memory(nodes, particles, self.grid.comm)
        self._decompose(mapping, min(nodes, particles), max(nodes, particles))

    def _decompose(self, mapping: NodalMapping, triplets: int, longest: int) -> None:
        transposed = _transposed_matrix(mapping, self.each)
        matrix = transposed.transpose(PETSc.Mat())
        solver, values, vectors = "none", np.empty(0), np.empty((0, mapping.count))
        if triplets:
            solver, values, vectors = _all_triplets(matrix, triplets, mapping.count)
        matrix.destroy()
        transposed.destroy()
        self._cut(values, vectors, longest)
        self.facts["solver"] = solver

    def _cut(self, values: FloatArray, vectors: FloatArray, longest: int) -> None:
        order = np.argsort(-values, kind="stable")
        values = values[order]
        cut = longest * np.finfo(float).eps * (values[0] if values.size else 0.0)
        rank = int(np.count_nonzero(values > cut))
        self.basis = np.ascontiguousarray(vectors[order[:rank]].T)
        self.facts: dict[str, Any] = {
            "rank": rank,
            "cut": float(cut),
            "above_cut": float(values[rank - 1]) if rank else None,
            "below_cut": float(values[rank]) if rank < values.size else None,
        }

    @property
    def nbytes(self) -> int:
        """Bytes of own rows."""
        return self.basis.nbytes

    def project(self, columns: FloatArray) -> FloatArray:
        """Return V^-½ V_r V_rᵀ V^½ columns, (n, k). Collective; one reduction of r numbers a column."""
        each = self.each[:, None]
        amounts = np.ascontiguousarray(self.basis.T @ (each * columns))
        self.grid.reduce(amounts)
        return np.asarray((self.basis @ amounts) / each)


def solver_class() -> type[Solver]:
    """Return the class of SLEPc's decomposition, whose options begin with ``-filter_svd_``."""
    from slepc4py import SLEPc

    found: type[Solver] = SLEPc.SVD
    return found


def _all_triplets(matrix: PETSc.Mat, triplets: int, own: int) -> tuple[str, FloatArray, FloatArray]:
    """Solver used, singular values, and own rows of the right singular vectors, (triplets, own). Collective."""
    from slepc4py import SLEPc

    for kind in (SLEPc.SVD.Type.TRLANCZOS, SLEPc.SVD.Type.LAPACK):
        solver = SLEPc.SVD().create(matrix.comm)
        solver.setOptionsPrefix("filter_")
        solver.setOperator(matrix)
        solver.setType(kind)
        solver.setDimensions(triplets)
        solver.setTolerances(TOLERANCE, MOST_RESTARTS)
        configure(solver)
        with refusing("filter_"):
            solver.solve()
        found, iterations, used = solver.getConverged(), solver.getIterationNumber(), solver.getType()
        if found >= triplets:
            values, vectors = _read(solver, matrix, triplets, own)
            solver.destroy()
            if _holds(matrix, values, vectors):
                return used, values, vectors
            continue
        solver.destroy()
    raise NotConverged(
        f"the singular value decomposition ({used}) found {found} of {triplets} triplets after {iterations} iterations"
    )


def _holds(matrix: PETSc.Mat, values: FloatArray, vectors: FloatArray) -> bool:
    """Return whether singular values and vectors can be right: orthonormal, and the squares sum up."""
    kept = vectors[values > vectors.shape[0] * np.finfo(float).eps * values.max()]
    with np.errstate(over="ignore", invalid="ignore"):
        overlap = np.ascontiguousarray(kept @ kept.T)
        matrix.comm.tompi4py().Allreduce(MPI.IN_PLACE, overlap)
        total, norm = np.sum(values**2), matrix.norm(PETSc.NormType.FROBENIUS) ** 2
        return bool(np.abs(overlap - np.eye(len(kept))).max(initial=0.0) < 1e-10 and abs(total - norm) < 1e-10 * norm)


def _read(solver: Any, matrix: PETSc.Mat, triplets: int, own: int) -> tuple[FloatArray, FloatArray]:
    values, vectors = np.empty(triplets), np.empty((triplets, own))
    right, left = matrix.createVecs()
    for i in range(triplets):
        values[i] = solver.getSingularTriplet(i, left, right)
        vectors[i] = right.getArray(readonly=True)
    right.destroy()
    left.destroy()
    return values, vectors


def _transposed_matrix(mapping: NodalMapping, each: FloatArray) -> PETSc.Mat:
    """(S V^-½)ᵀ, n × m: a row a particle, entries V_p^½ φ_i(x_p) / d_i; nodes numbered rank by rank."""
    grid = mapping.grid
    nodes, corners = grid.nodes, (grid.degree + 1) ** grid.dim
    comm: Any = grid.comm
    first = comm.scan(grid.local_cells) - grid.local_cells
    number = np.zeros(nodes.local_nodes)
    block = nodes.own(number)
    block[...] = (first + np.arange(grid.local_cells)).reshape(block.shape)
    nodes.fill(number)
    node = np.empty((mapping.count, corners), dtype=np.int64)
    value = np.empty((mapping.count, corners))
    spline.shape_functions(grid.degree, *mapping.located, grid.padded_shape, grid.layout, node, value)
    value *= each[:, None] * mapping.inverse_row_sums[node]
    sizes = ((mapping.count, comm.allreduce(mapping.count)), (grid.local_cells, grid.node_count))
    matrix = PETSc.Mat().createAIJ(sizes, nnz=corners, comm=comm)
    starts = np.arange(mapping.count + 1) * corners
    matrix.setValuesIJV(
        starts.astype(PETSc.IntType), number[node.ravel()].astype(PETSc.IntType), value.ravel(),
        addv=PETSc.InsertMode.ADD_VALUES,
    )  # fmt: skip
    matrix.assemble()
    return matrix


# ---------------------------------------------------------------- memory


def bytes_needed(nodes: int, particles: int, ranks: int) -> float:
    """Return the bytes on all ranks: both bases twice over while computed, and small dense matrices on every rank."""
    triplets = min(nodes, particles)
    return 8.0 * triplets * (2 * (nodes + particles) + 6 * ranks * triplets)


def check_memory(nodes: int, particles: int, comm: MPI.Comm) -> None:
    """Raise TooLarge on all ranks if the decomposition needs more than what is free. Collective."""
    free = free_bytes(comm)
    needed = bytes_needed(nodes, particles, comm.size)
    if needed > free:
        raise TooLarge(
            f"svd of {nodes} nodes and {particles} particles needs about {1e-9 * needed:.3g} GB on {comm.size} "
            f"rank{'s' if comm.size > 1 else ''}, and {1e-9 * free:.3g} GB are free; "
            'filter.kind = "exact" is the same operator and takes memory in proportion to nodes'
        )


def describe(facts: dict[str, Any]) -> str:
    """Return the facts of a row space in words."""
    below = facts["below_cut"]
    gap = "nothing below it" if below is None else f"next singular value {below:.3g}"
    above = "" if facts["above_cut"] is None else f", smallest kept {facts['above_cut']:.3g}"
    return f"rank {facts['rank']}, cut at {facts['cut']:.3g}{above}, {gap}"
