"""Arguments as callers get them wrong, and as they get them right in odd clothes, for every verb of the library.

`walk_helpers` draws from them.
"""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from dense_helpers import Dense
from mpipic import FILTERS, Grid, Mapping, Placement

BOXES = {1: ((6,), (1.5,)), 2: ((4, 3), (1.0, 3.0)), 3: ((3, 2, 4), (0.75, 2.0, 2.0))}
SHAPES = ((), (1,), (2,), (3,), (2, 2), (3, 1, 2), (0,), (2, 0))
KINDS = ("?", "b", "h", "i", "l", "B", "H", "I", "L", "e", "f", "d", "g", ">f8", ">i4")
COUNT = 14


class World:
    """Particles on the ranks of a communicator, everything that maps and filters them, and the dense reference.

    `spread`: "box" all over; "corner" in so little of it that other ranks own none; "none" no particles.
    """

    def __init__(self, comm, dim, spread="box", weighted=False):
        self.comm, self.dim = comm, dim
        cells, self.length = BOXES[dim]
        rng = np.random.default_rng(dim)
        n = 0 if spread == "none" else COUNT
        self.position = rng.random((n, dim)) * self.length * (0.1 if spread == "corner" else 1.0)
        weight = rng.random(n) + 0.5 if weighted else None
        self.mine = np.arange(n)[comm.rank :: comm.size]
        self.grid = Grid(cells, self.length, comm)
        self.placement = Placement(self.grid, self.position[self.mine])
        self.ids = self.placement.to_owners(self.mine)
        self.weight = None if weight is None else weight[self.ids]
        self.mapping = Mapping(self.grid, self.placement.position, self.weight)
        self.filters = {kind: FILTERS[kind](self.mapping) for kind in FILTERS}
        dense = Dense(cells, self.length, self.position, weight)
        self.dense = dense
        self.matrices = {kind: dense.filter(kind) if n else np.zeros((0, 0)) for kind in FILTERS}
        self.block = tuple(slice(s, s + k) for s, k in zip(self.grid.owned_start, self.grid.owned_shape, strict=True))
        self.count = {"owners": len(self.mine), "others": len(self.ids)}

    def ghosted(self, nodal):
        """This rank's array with ghosts of values on all nodes (nodes, *shape)."""
        out = np.zeros((self.grid.local_nodes, *nodal.shape[1:]))
        if out.size:
            self.grid.owned(out)[...] = nodal.reshape(*self.grid.cells, *nodal.shape[1:])[self.block]
            self.grid.fill_halo(out)
        return out

    def same_nodal(self, found, wanted):
        """Assert that a nodal array is what is wanted on all nodes, (nodes, *shape)."""
        own = self.grid.owned(found)
        near(own, wanted.reshape(*self.grid.cells, *wanted.shape[1:])[self.block])


def near(found, wanted):
    """Assert that arrays agree, in shape too."""
    assert found.shape == wanted.shape, (found.shape, wanted.shape)
    assert np.abs(found - wanted).max(initial=0.0) <= 1e-7 * max(1.0, np.abs(wanted).max(initial=0.0))


def times(matrix, values):
    """The matrix applied to values (n, *shape)."""
    return np.tensordot(matrix, values.astype(float), axes=1)


# ---------------------------------------------------------------- clothes and stains


def dressed(rng, right, others=False):
    """The same numbers in another type, order or container; never an error. `others` tell the shape of none."""
    kinds = [k for k in KINDS if k != "?" or right.max(initial=0) <= 1]
    choice = rng.integers(7)
    if choice == 0:
        return np.asfortranarray(right)
    if choice == 1 and len(right):
        return np.repeat(right, 2, axis=0)[::2]
    if choice == 2 and right.size and right.ndim < 4:
        return right.tolist()
    if choice == 3:
        frozen = right.copy()
        frozen.flags.writeable = False
        return frozen
    if choice == 4 and others and not len(right):
        return np.empty(0)
    return right.astype(kinds[rng.integers(len(kinds))])


def spoilt(rng, right, least=0):
    """What cannot stand for `right` (n, *shape), n of at least `least` axes after the first."""
    n, unit = len(right), np.zeros((1, *right.shape[1:]))
    wrong = [
        None, 3.5, "values", b"values", {}, {"a": 1}, set(), object(), len, right.astype(complex), 1j * np.ones(n),
        np.ma.masked_array(right, mask=False), np.full(right.shape, "1"), np.full(right.shape, None, dtype=object),
        np.zeros(n, "datetime64[s]"), np.zeros(n, [("x", "f8")]), [[1.0], [2.0, 3.0]], [1.0, None], [10**30],
        np.concatenate([right, unit]), np.concatenate([right, unit, unit]), np.zeros((n + 7, 2)), np.array(2.5),
        np.zeros((n,) + (1,) * 9), iter([1.0]), np.zeros((n + 1, 0)),
    ]  # fmt: skip
    if n:
        wrong += [right[:-1], right[1:].tolist(), np.empty(0), np.empty((0, 3)), right[:0], (), []]
    if n > 1:
        wrong += [right[:, None].swapaxes(0, 1)]
    return wrong[rng.integers(len(wrong))]


def expect(refusal, call, names, together=True):
    """Call; return the answer, or None for an error that must be and is of the right kind, and names a culprit.

    Collective verbs, `together`, say the same on all ranks.
    """
    try:
        answer = call()
    except (TypeError, ValueError) as error:
        text = str(error)
        if together:
            said = MPI.COMM_WORLD.allgather((type(error), text))
            assert len(set(said)) == 1, said
        assert refusal, f"refused what is right: {text}"
        assert any(name in text for name in names), f"{names} are not in: {text}"
        assert not together or text.startswith("rank"), text
        return None
    assert not refusal, f"accepted what is wrong, and answered {answer!r}"
    return answer
