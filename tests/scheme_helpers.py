"""The package's parts on one rank on splines of any degree, and its steps for schemes of `spline_helpers`."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, product

import numpy as np
from mpi4py import MPI

from covering_helpers import cover
from mpipic.kernels import stencil
from mpipic.mesh.grid import Grid
from mpipic.mesh.halo import Halo
from mpipic.run.build import physics_of
from mpipic.scene.records import Scene
from serial_helpers import by_id, particles_of
from spline_helpers import Scheme

TIGHT = 1e-13
"""Of every solver: what a step leaves of its residual is to be small beside the errors allowed."""


def matrix_of(grid, mapping):
    """G as a matrix (m, m) from half of its diagonals, on a padding of another width than the grid's own."""
    offsets = stencil.half_stencil(grid.dim, grid.degree)
    halo = Halo(grid.comm, grid.cells, grid.starts, 3)
    entries = np.zeros((halo.local_nodes, len(offsets)))
    mapping.add_gram_entries(halo.layout, entries)
    halo.add(entries)
    number = np.arange(grid.node_count).reshape(grid.cells)
    matrix = np.zeros((grid.node_count,) * 2)
    for offset, row in zip(offsets[:, : grid.dim], entries.T.copy()):
        entry = halo.own(row).transpose().ravel()
        there = np.roll(number, -offset, axis=tuple(range(grid.dim))).ravel()
        np.add.at(matrix, (number.ravel(), there), entry)
        if offset.any():
            np.add.at(matrix, (there, number.ravel()), entry)
    return matrix


def sections(scheme):
    """The sections of a scene that name this scheme: keys that nothing uses are left out."""
    mapping = {"basis": scheme.basis, "mass": scheme.mass, "gradient": scheme.gradient}
    if scheme.mass == "penalised":
        mapping |= {"penalty": scheme.penalty, "penalty_order": scheme.penalty_order}
    if scheme.gradient == "grid":
        mapping["gradient_order"] = scheme.gradient_order
    keep = {"kind": scheme.filter}
    if scheme.filter in ("order", "chebyshev"):
        keep["order"] = scheme.filter_order
    if scheme.filter == "exact":
        keep["tolerance"] = TIGHT
    if scheme.mass != "lumped":
        mapping["tolerance"] = TIGHT
    time = {"integrator": scheme.integrator}
    if scheme.integrator == "midpoint":
        time["tolerance"] = TIGHT
    damping = {"order": scheme.damping, "null_space": scheme.null_space}
    if scheme.damping:
        damping["strength"] = scheme.strength
    return {"mapping": mapping, "filter": keep, "damping": damping, "time": time}


def scene_of_scheme(scheme, cells, length, gas, dt):
    """A scene with this scheme, box, gas and time step."""
    parts = sections(scheme)
    return Scene.from_dict(
        {
            **parts,
            "grid": {"cells": list(cells), "length": list(length)},
            "gas": {"density": gas.density, "sound_speed": gas.sound_speed, "flow": list(gas.flow)},
            "time": {**parts["time"], "dt": dt},
        }
    )


class Run:
    """A scene's own step, as a simulation builds it, on particles that are given."""

    def __init__(self, scheme, cells, length, gas, dt, position, state):
        self.scene = scene_of_scheme(scheme, cells, length, gas, dt)
        self.grid = Grid(cells, length, MPI.COMM_SELF, scheme.basis)
        particles = particles_of(self.grid, position, state[:, 0], state[:, 1:])
        self.particles = particles
        self.physics = physics_of(self.scene)
        self.physics.place(self.grid, particles, lambda name: None)

    @property
    def stepper(self):
        """The step that the scene's physics has built."""
        return self.physics.stepper

    @property
    def sweep(self):
        """The particles, mapped, of a step on nodal arrays."""
        return self.stepper.sweep

    def steps(self, count):
        for _ in range(count):
            self.physics.step()
        return self

    @property
    def result(self):
        """Position (n, d) and state (n, 1 + d) in the order of the ids."""
        position, density, velocity = by_id(self.particles)
        return position, np.column_stack([density, velocity])


# ---------------------------------------------------------------- which schemes there are

PARTS = {
    "basis": ("linear", "quadratic", "cubic"),
    "mass": ("lumped", "consistent", "penalised"),
    "gradient": ("direct", "grid", "skew"),
    "filter": ("none", "local", "order", "chebyshev", "exact", "svd"),
    "integrator": ("symplectic", "rk4", "midpoint"),
    "damping": (0, 2),
}


def goes_together(scheme):
    """Whether a scene may hold this scheme."""
    if scheme.gradient == "skew" and scheme.filter in ("none", "svd"):
        return False
    if scheme.filter == "svd" and scheme.mass == "penalised" and scheme.gradient != "grid":
        return False
    return not scheme.damping or can_be_damped(scheme)


def can_be_damped(scheme):
    """Whether there are least-squares fields, and particles take what interpolates from them."""
    return scheme.mass != "lumped" and not (scheme.filter == "none" and scheme.gradient == "direct")


def _schemes():
    """Every scheme of PARTS that there is, the orders of its parts in turn; damping where it can be, else in turn."""
    schemes = []
    for count, names in enumerate(product(*PARTS.values())):
        turn = {
            "gradient_order": (2, 4, 6, 10)[count % 4],
            "filter_order": (1, 2, 3, 5)[count % 4],
            "penalty_order": (1, 2, 3, 4)[count // 2 % 4],
            "penalty": (0.1, 0.02)[count // 3 % 2],
            "strength": (1.0, 2.5, 9.0)[count % 3],
        }
        scheme = Scheme(*names, **turn)
        if scheme.damping:
            scheme = replace(scheme, damping=1 + count // 2 % 4)
        if can_be_damped(scheme):
            scheme = replace(scheme, null_space=(0.0, 0.7)[(count // 2 + count // 6) % 2])
        if goes_together(scheme):
            schemes.append(scheme)
    return schemes


SCHEMES = _schemes()


def _choices(scheme, strength):
    chosen = [(part, getattr(scheme, part)) for part in PARTS if part != "damping"]
    return combinations([*chosen, ("damping", scheme.damping > 0)], strength)


def covering(strength, wanted=lambda scheme: True):
    """Few of the schemes wanted, so that any `strength` choices of parts that go together are in one of them."""
    return cover([scheme for scheme in SCHEMES if wanted(scheme)], lambda scheme: _choices(scheme, strength))


def label(scheme):
    """A short name for a test."""
    return "-".join(str(getattr(scheme, part)) for part in PARTS)
