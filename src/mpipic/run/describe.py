"""What a scene builds and what it leaves out, in words and in bytes, without building it."""

from __future__ import annotations

from typing import Any

from mpipic.mesh.basis import DEGREES
from mpipic.mesh.decomposition import process_grid
from mpipic.scene.records import Scene

MEGA = 1e6


def particle_bytes(dim: int) -> int:
    """Resident bytes per particle: coordinate, density, velocity, id."""
    return 8 * (dim + 1 + dim + 1)


def node_bytes(scene: Scene) -> int:
    """Resident bytes per node: sums, row sums and their inverses, pair moments, and the work arrays of the step."""
    dim, degree = scene.dim, DEGREES[scene.mapping.basis]
    filtered = scene.filter.kind != "none"
    work = (1 + dim) + 1 + (dim if filtered else 0)
    moments = 3**dim if degree == 1 else 0
    stages = 4 if scene.time.integrator == "rk4" else 1
    fields = scene.mapping.mass != "lumped"
    at_stages = scene.filter.kind == "exact" and scene.mapping.gradient != "grid"
    # the stencil by rows and by diagonals; of each column that is solved for its copies, PETSc's vectors and
    # two earlier answers
    half = ((2 * degree + 1) ** dim + 1) // 2
    solvers = 2 if at_stages and scene.mapping.mass == "penalised" else int(fields or at_stages)
    solver = solvers * (2 * half + 2 + 5 * (1 + dim)) + 2 * (1 + dim) * (int(fields) + stages * int(at_stages))
    kept = stages * 2 * (1 + dim) if stages > 1 else 0
    return 8 * ((dim + 2) + 1 + moments + work + solver + kept)


def rank_bytes(scene: Scene, ranks: int, particles: int) -> float:
    """Resident bytes of arrays on one of `ranks` equal ranks, without halos and interpreter (about 150 MB)."""
    return (particles * particle_bytes(scene.dim) + scene.cell_count * node_bytes(scene)) / ranks


def parts(scene: Scene) -> tuple[list[tuple[str, str]], list[str]]:
    """What the scene builds, (part, description), and what it leaves out."""
    moving = any(scene.gas.flow)
    filtered = scene.filter.kind != "none"
    built = [
        ("grid", f"{scene.dim}D, {' x '.join(map(str, scene.grid.cells))} cells, periodic"),
        ("particles", _particles(scene)),
        ("mapping", f"{scene.mapping.basis} basis, {_mass(scene)}, "
         + ("updated every step" if moving else "built once: the flow is 0")),
        ("filter", _filter(scene)),
        ("step", _step(scene)),
        ("initial", _initial(scene)),
    ]  # fmt: skip
    left_out = [] if scene.filter.kind == "svd" else ["SLEPc"]
    least_squares = scene.mapping.mass != "lumped"
    implicit = scene.time.integrator == "midpoint"
    reports = scene.output.report_at and scene.initial.profile != "file"
    solves = scene.filter.kind == "exact" or least_squares or implicit or reports
    left_out += [] if solves else ["linear solvers"]
    left_out += [] if scene.filter.kind == "svd" else ["assembled matrices"]
    left_out += [] if filtered else ["filter"]
    left_out += [] if moving else ["migration"]
    left_out += [] if scene.output.every else ["snapshots"]
    left_out += [] if scene.output.every or scene.particles.layout == "file" else ["h5py"]
    left_out += ["y and z" if scene.dim == 1 else "z"] if scene.dim < 3 else []
    left_out += ["exact solution and errors"] if scene.initial.profile == "file" else []
    return built, left_out


def describe(scene: Scene, comm: Any) -> list[tuple[str, str]]:
    """What `mpipic check` prints, as (name, value) lines. Local."""
    built, left_out = parts(scene)
    steps = f"{scene.time.steps} of dt = {scene.dt:.6g}, CFL {scene.cfl:.4g}"
    lines = [("scene", scene.name), *built, ("steps", steps)]
    blocks = " x ".join(map(str, process_grid(scene.grid.cells, comm.size) or ()))
    lines += [("ranks", f"{comm.size}, as {blocks} blocks"), ("left out", ", ".join(left_out))]
    count = scene.particle_count
    each = f"{particle_bytes(scene.dim)} bytes a particle, {node_bytes(scene)} bytes a node"
    if count is None:
        return [*lines, ("memory", each)]
    total = rank_bytes(scene, comm.size, count)
    return [
        *lines,
        ("memory", f"{each}: {total * comm.size / count:.0f} bytes a particle in all"),
        ("per rank", f"{total / MEGA:.1f} MB of arrays, and about 150 MB of libraries"),
    ]


def _mass(scene: Scene) -> str:
    mapping = scene.mapping
    if mapping.mass == "penalised":
        return f"least squares with a penalty of {mapping.penalty:g} on differences of order {mapping.penalty_order}"
    return "least squares" if mapping.mass == "consistent" else "lumped mass"


def _step(scene: Scene) -> str:
    mapping, gradient = scene.mapping, {"direct": "gradient at the particles", "skew": "skew gradient"}
    taken = gradient.get(mapping.gradient, f"central differences of order {mapping.gradient_order} on the nodes")
    method = {"symplectic": "symplectic Euler", "rk4": "Runge-Kutta of order 4", "midpoint": "implicit midpoint rule"}
    damping = f", damped with {scene.damping.order} second differences" if scene.damping.order else ""
    if scene.damping.null_space:
        damping += f", null space damped at rate {scene.damping.null_space:g}"
    if mapping.mass == "lumped" and mapping.gradient == "direct" and scene.time.integrator == "symplectic":
        passes = "nine passes" if scene.filter.kind == "svd" else "one pass"
        return f"Formulation 2 (symplectic Euler), {passes} over the particles a step"
    return f"{method[scene.time.integrator]}, {taken}{damping}"


def _filter(scene: Scene) -> str:
    kind = scene.filter.kind
    if scene.mapping.gradient == "grid" and kind in ("exact", "svd"):
        return f"{kind}: nothing to do, gradients on the nodes are in its range"
    if kind == "none":
        return "none"
    if kind == "exact":
        return f"exact: conjugate gradients on the nodes to {scene.filter.tolerance:g}, neighbours and dot products"
    if kind == "svd":
        return "svd: all singular triplets of the mapping matrix by SLEPc, whenever particles have moved"
    exchanges = 1 if kind == "local" else scene.filter.order
    order = "" if kind == "local" else f" {scene.filter.order}"
    return f"{kind}{order}: neighbours only, {exchanges} halo exchange{'s' if exchanges > 1 else ''} an application"


def _particles(scene: Scene) -> str:
    layout, count = scene.particles, scene.particle_count
    if layout.layout == "file":
        return f"from {layout.path}"
    per_cell = " x ".join(map(str, layout.per_cell)) + (" on average" if layout.layout == "random" else "")
    jitter = f", moved by up to {layout.jitter:g} spacings" if layout.layout == "jittered" else ""
    return f"{count:,} on a {layout.layout} layout{jitter}, {per_cell} per cell"


def _initial(scene: Scene) -> str:
    initial = scene.initial
    if initial.profile == "file":
        return f"from {scene.particles.path}"
    if initial.profile == "gaussian":
        return f"gaussian at {list(initial.center)}, sharpness {initial.sharpness:g}"
    about = f", sharpness {initial.sharpness:g}" if initial.profile == "plane-gaussian" else ""
    return f"{initial.profile}, periods {list(initial.wave)}{about}"
