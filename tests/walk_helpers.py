"""A walk through the library draws cases: a verb, values, how they are dressed or spoilt, and which ranks do so.

Every case must end in the answer of the dense matrices, or in ValueError or TypeError that names the argument, on all
ranks together. All ranks draw the same.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from argument_helpers import KINDS, SHAPES, dressed, expect, near, spoilt, times
from mpipic import FILTERS, Grid, Mapping, Placement

CASES = (
    "mapped", "mapped", "mapped", "placed", "placed", "nodal", "nodal", "in_place", "positions", "positions", "weights",
    "shapes_differ", "grid", "filter", "coordinates",
)  # fmt: skip
"""Methods of `Walk`, those that stand for several verbs more often."""


class Walk:
    """Draws cases on a world and holds each to what must come of it; `seen` counts what was refused and answered."""

    def __init__(self, world, seed):
        self.world, self.rng, self.seen = world, np.random.default_rng(seed), Counter()
        self.size, self.rank = world.comm.size, world.comm.rank

    def step(self):
        """One case, and now and then a right call after it."""
        getattr(self, CASES[self.rng.integers(len(CASES))])()
        if self.rng.random() < 0.05:
            self.mapped(spoil=False)

    def somebody(self):
        """Which ranks do it: one of them, or all. Whoever has particles is among them where that is asked for."""
        return self.rng.integers(2, size=self.size).astype(bool) | (
            np.arange(self.size) == self.rng.integers(self.size)
        )

    def given(self, right, spoil, who, typed=False):
        """This rank's argument; on all ranks as many numbers are drawn."""
        seed = int(self.rng.integers(1 << 30))
        own = np.random.default_rng(seed + self.rank)
        if not who[self.rank]:
            return right
        return (
            spoilt(own, right)
            if spoil
            else right.copy()
            if typed
            else dressed(own, right, len(self.world.position) > 0)
        )

    def told(self, kind, refused):
        self.seen[kind, "refused" if refused else "answered"] += 1

    def draw(self, last=None, kind="d", rows=None):
        """Whole numbers (n, *shape) of a type, the same on all ranks."""
        shape = SHAPES[self.rng.integers(len(SHAPES))]
        shape = shape if last is None else (*shape, last)
        n = len(self.world.position) if rows is None else rows
        return self.rng.integers(2 if kind == "?" else 100, size=(n, *shape)).astype(kind)

    def mapped(self, spoil=None):
        """Particle values to nodes, and through filters."""
        w, spoil = self.world, self.rng.random() < 0.6 if spoil is None else spoil
        verbs = ["sums", "p2g", "adjoint_gradient", *w.filters]
        verb = verbs[self.rng.integers(len(verbs))]
        q = self.draw(last=w.dim if verb == "adjoint_gradient" else None)
        given = self.given(q[w.ids], spoil, self.somebody())
        call = w.filters[verb] if verb in w.filters else getattr(w.mapping, verb)
        answer = expect(spoil, lambda: call(given), ["values"])
        self.told(verb, spoil)
        if spoil:
            return
        d = w.dense
        if verb in w.filters:
            near(answer, times(w.matrices[verb], q)[w.ids])
        elif verb == "adjoint_gradient":
            w.same_nodal(answer, sum(times(D.T, q[..., axis]) for axis, D in enumerate(d.D)))
        else:
            w.same_nodal(answer, times(d.S if verb == "p2g" else d.phi.T * d.weight, q))

    def placed(self):
        """Values to owners and back, bit for bit."""
        w, spoil = self.world, self.rng.random() < 0.5
        q = self.draw(kind=KINDS[self.rng.integers(13)])
        if q.dtype == np.int64 and q.ndim == 1 and len(q):
            q[0] = 2**63 - 25
        there = self.rng.random() < 0.5
        rows, wanted = (w.mine, q[w.ids]) if there else (w.ids, q[w.mine])
        given = self.given(q[rows], spoil, self.somebody(), typed=True)
        call = w.placement.to_owners if there else w.placement.to_callers
        answer = expect(spoil, lambda: call(given), ["values"])
        self.told("placed", spoil)
        if not spoil:
            assert answer.dtype == q.dtype and np.array_equal(answer, wanted)

    def nodal(self):
        """Nodal values to particles: local verbs, which refuse where the mistake is."""
        w, spoil = self.world, self.rng.random() < 0.6
        verb = ("g2p", "gradient", "divergence")[self.rng.integers(3)]
        q = self.draw(last=w.dim if verb == "divergence" else None, rows=w.grid.node_count)
        right, who = w.ghosted(q), self.somebody()
        if spoil and self.rng.random() < 0.2:
            given = w.grid.owned(right) if who[self.rank] else right
            spoil = spoil and not (w.dim == 1 and given.shape == right.shape)
        else:
            given = self.given(right, spoil, who)
        refused = bool(spoil and who[self.rank])
        answer = expect(refused, lambda: getattr(w.mapping, verb)(given), ["nodal"], together=False)
        self.told(verb, refused)
        if refused:
            return
        d = w.dense
        if verb == "g2p":
            near(answer, times(d.phi, q)[w.ids])
        elif verb == "gradient":
            near(answer, np.stack([times(D, q) for D in d.D], axis=-1)[w.ids])
        else:
            near(answer, sum(times(D, q[..., axis]) for axis, D in enumerate(d.D))[w.ids])

    def in_place(self):
        """Halos: arrays that are changed must be the right ones as they are."""
        w, spoil = self.world, self.rng.random() < 0.7
        right = w.ghosted(self.draw(rows=w.grid.node_count))
        who, given = self.somebody(), right.copy()
        own = np.random.default_rng(int(self.rng.integers(1 << 30)) + self.rank)
        if spoil and who[self.rank]:
            wrong = [right.astype("f4"), right.astype(int), right.tolist(), right[:-1], w.grid.owned(right), None,
                     np.ma.masked_array(right), np.repeat(right, 2, axis=0)[::2], right.astype(complex)]  # fmt: skip
            given = wrong[own.integers(len(wrong))]
            if given is wrong[7] and not right.size:
                given = None
        verb = ("sum_halo", "fill_halo")[self.rng.integers(2)]
        expect(spoil, lambda: getattr(w.grid, verb)(given), ["nodal"])
        self.told(verb, spoil)
        if not spoil and verb == "fill_halo":
            assert np.array_equal(given, right)

    def bad_positions(self, own, right):
        """Positions that tell nothing, or are none."""
        n, dim = right.shape
        wrong = [np.zeros((n, dim + 1)), np.zeros(n + 1), np.zeros((n + 1, dim, 1)), right.astype(complex), None, "x",
                 np.ma.masked_array(right), np.full((n + 1, dim), "0"), [[0.1], [0.1, 0.2]], 0.3]  # fmt: skip
        for bad in (np.nan, np.inf, -np.inf, 1e300, -1e19):
            spoiled = np.concatenate([right, np.zeros((1, dim))])
            spoiled[own.integers(n + 1), own.integers(dim)] = bad
            wrong.append(spoiled)
        if n not in (0, dim):
            wrong.append(right.T)
        return wrong[own.integers(len(wrong))]

    def positions(self):
        """Placements and mappings, whole periods off, on the upper face, or wrong."""
        w, spoil = self.world, self.rng.random() < 0.6
        own = np.random.default_rng(int(self.rng.integers(1 << 30)) + self.rank)
        who, placing = self.somebody(), self.rng.random() < 0.5
        right = w.position[w.mine] if placing else w.placement.position
        right = right + own.integers(-3, 4, size=right.shape) * np.array(w.length) * (not spoil)
        if self.rng.random() < 0.3 and placing and len(right):
            faces = np.array([0.0, 1.0, -1e-17, np.mod(-1e-17, 1.0), -1.0, 3.0])
            right[0] = faces[own.integers(6, size=w.dim)] * np.array(w.length)
        given = self.bad_positions(own, right) if spoil and who[self.rank] else right
        self.told("positions", spoil)
        if placing:
            placement = expect(spoil, lambda: Placement(w.grid, given), ["position"])
            if placement is None:
                return
            back = placement.to_callers(placement.position)
            assert np.array_equal(back, w.grid.in_box(right)) and np.all((back >= 0) & (back < w.length))
            Mapping(w.grid, placement.position)  # every owner finds them in its cells
        else:
            moved = Mapping(w.grid, w.placement.position)
            expect(spoil, lambda: moved.update(given), ["position"])
            near(moved.row_sums, Mapping(w.grid, w.placement.position).row_sums)

    def weights(self):
        """What particles count."""
        w, who = self.world, self.somebody()
        own, n = np.random.default_rng(int(self.rng.integers(1 << 30)) + self.rank), len(w.ids)
        right, spoil = np.full(n, 2), self.rng.random() < 0.6
        wrong = [
            np.ones(n + 1),
            np.ones((n, 1)),
            np.array(1.0),
            np.ones(n, complex),
            "weights",
            [1j],
            np.ma.ones(n),
            {},
        ]
        for bad in (0.0, -1.0, np.nan, np.inf, 5e-324, 1e-300, 1e300):
            wrong += [np.where(np.arange(n) == own.integers(n), bad, 1.0)] if n else []
        given = wrong[own.integers(len(wrong))] if spoil and who[self.rank] else right
        given = dressed(own, given) if not spoil else given
        mapping = expect(spoil, lambda: Mapping(w.grid, w.placement.position, given), ["weight"])
        self.told("weights", spoil)
        if mapping is not None:
            w.same_nodal(mapping.row_sums, 2.0 * w.dense.phi.sum(axis=0))
        held = w.comm.allgather(n > 0)
        if sum(held) > 1:  # one with weights, the others without
            last = self.rank == max(r for r, holds in enumerate(held) if holds)
            expect(True, lambda: Mapping(w.grid, w.placement.position, right if last else None), ["weights"])

    def shapes_differ(self):
        """Ranks that hold particles give values of another shape or type; those without give none."""
        w = self.world
        held = w.comm.allgather(len(w.ids))
        holders = [r for r, n in enumerate(held) if n]
        last = len(holders) > 1 and self.rank == holders[-1]
        n, own = len(w.ids), np.random.default_rng(self.rank)
        other = ((2,), (), (3, 1))[self.rng.integers(3)]
        shape = other if last else (3,)
        refused = len(holders) > 1
        q = own.random((n, *shape)) if n else np.empty(0)
        answer = expect(refused, lambda: w.mapping.p2g(q), ["values of shape"])
        self.told("shapes differ", refused)
        if not refused and holders:
            assert answer.shape == (w.grid.local_nodes, 3)
            back = w.filters["local"].apply(np.ones((n, 2)) if n else np.empty(0))
            assert back.shape == (n, 2)
        q = np.zeros(n, "i4" if last else "i8") if n else np.empty(0)
        answer = expect(refused, lambda: w.placement.to_callers(q), ["type int32"])
        assert answer is None or answer.dtype == (np.int64 if holders else np.float64)

    def grid(self):
        """Boxes that are none, on some ranks or on all; and differing ones."""
        w, who = self.world, self.somebody()
        cells = [(4.7,), ("8",), (True,), (0,), (-3,), "8", 8, None, (), (4, 4, 4, 4), (2**31,), (2**16, 2**16), [[4]],
                 (np.float64(4),), (None,), {4}, {4: 1}, (1j,), (10**30,), np.array([4.0])]  # fmt: skip
        lengths = [(0.0,), (-1.0,), (np.nan,), (np.inf,), (5e-324,), (1e-308,), ("1",), (True,), (1, 1), (), None, 1.0,
                   (1j,), (10**400,), (None,), "1", (np.array([1.0]),), (1e-310,)]  # fmt: skip
        bases = ["quartic", "Linear ", "", None, 1, b"linear", ["linear"], "cubik"]
        right = {"cells": (np.int32(8),), "length": (np.float32(1),), "comm": w.comm, "basis": "linear"}
        which = ("cells", "length", "basis", None)[self.rng.integers(4)]
        given, own = dict(right), np.random.default_rng(int(self.rng.integers(1 << 30)) + self.rank)
        if which and who[self.rank]:
            choices = {"cells": cells, "length": lengths, "basis": bases}[which]
            given[which] = choices[own.integers(len(choices))]
        names = ["cells", "length"] if which in ("cells", "length") else ["basis"]
        grid = expect(which is not None, lambda: Grid(**given), names)
        assert which or (grid.cells == (8,) and grid.h == (0.125,))
        if self.size > 1:
            other = [{"cells": (9,)}, {"length": (1.5,)}, {"basis": "cubic"}][self.rng.integers(3)]
            expect(True, lambda: Grid(**{**right, **(other if self.rank else {})}), ["ranks must call the same"])
        for comm in (None, 0, "world", w):
            expect(True, lambda comm=comm: Grid((8,), (1.0,), comm), ["comm"], together=False)
        self.told("grid", which is not None)

    def filter(self):
        """Settings of filters, and what is no mapping."""
        w, who = self.world, self.somebody()
        kind = ("exact", "order", "chebyshev")[self.rng.integers(3)]
        name, bad, good = {
            "exact": (
                "tolerance",
                [-1.0, 0, 1, 2.0, np.nan, np.inf, "x", None, 1j, [1e-9], True],
                [1e-8, np.float32(0.5)],
            ),
        }.get(kind, ("order", [0, -1, 2.5, True, 1e9, 10**9, "2", None, np.nan, [2], 3.0], [1, 5, np.int16(3), 1000]))
        own = np.random.default_rng(int(self.rng.integers(1 << 30)) + self.rank)
        spoil, value = self.rng.random() < 0.7, good[self.rng.integers(len(good))]
        given = bad[own.integers(len(bad))] if spoil and who[self.rank] else value
        made = expect(spoil, lambda: FILTERS[kind](w.mapping, **{name: given}), [name])
        assert spoil or getattr(made, name) == value
        if self.size > 1:
            others = {name: good[0] if self.rank else good[1]}
            expect(True, lambda: FILTERS[kind](w.mapping, **others), ["ranks must call the same"])
        for wrong in (None, w.grid, w.placement, "mapping"):
            expect(True, lambda wrong=wrong: FILTERS[kind](wrong), ["Mapping"], together=False)
        expect(True, lambda: FILTERS["local"](w.mapping, tolerance=1e-9), ["tolerance"], together=False)
        self.told("filter", spoil)

    def coordinates(self):
        """Where positions are in cells, and whose."""
        w, own = self.world, self.rng
        position, spoil = w.position + 2.0 * np.array(w.length), own.random() < 0.5
        if spoil:
            bad = self.bad_positions(own, w.position)
            expect(True, lambda: w.grid.coordinate_of(bad), ["position"], together=False)
            for far in (np.full((2, w.dim), -1.0), np.full((1, w.dim), np.nan), np.full((1, w.dim), 1e300)):
                expect(True, lambda far=far: w.grid.owner_of(far), ["coordinate"], together=False)
        else:
            owner = w.grid.owner_of(w.grid.coordinate_of(position))
            assert np.array_equal(np.flatnonzero(owner == self.rank), np.sort(w.ids))
        self.told("coordinates", spoil)
