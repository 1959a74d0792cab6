"""The verb `stability`: growth per step of a scene's scheme, computed instead of watched (Floquet analysis).

The scheme is linear in (ρ, u), and positions move at constant flow. After T steps the pattern of particles relative to
the grid recurs, so those T steps are one linear map M of the particle values, again and again; what survives grows by
μ = |λ|^(1/T) per step, λ the largest eigenvalue of M. M is applied by taking the very steps that a run takes.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from mpipic.agreement import on_first
from mpipic.analysis.recurrence import Recurrence, find
from mpipic.analysis.writing import make_folder
from mpipic.arrays import FloatArray
from mpipic.console import Console
from mpipic.errors import NotConverged
from mpipic.files import write_json
from mpipic.filters import ExactFilter
from mpipic.io.run_directory import RunDirectory
from mpipic.mapping.mapping import Mapping
from mpipic.mesh.petsc_options import Solver, configure, refusing
from mpipic.particles.migration import Routes
from mpipic.run.facts import versions
from mpipic.run.loop import Simulation

if TYPE_CHECKING:
    from mpipic.scene.records import Scene

Mode = NDArray[np.float64] | NDArray[np.complex128]
"""An eigenvector, real or complex."""
NOISE = 1e-16
"""Size of rounding relative to the solution: what grows."""
DENSE = 700
"""Unknowns up to which M is written out and all its eigenvalues are found."""


@dataclass(frozen=True)
class Growth:
    """Growth of a scheme, the same on all ranks.

    Attributes
    ----------
    growth_per_step
        μ - 1, from the largest eigenvalue; `norm_bound` where that is less, as it is by rounding alone.
    norm_bound
        ‖M‖^(1/T) - 1 in the norm Σ ρ² + |ρ₀ u / c|² over particles, which no growth exceeds; None where M was not
        written out. Singular values carry rounding and the error of the scene's solvers, but do not magnify them as
        eigenvalues can: a bound of nothing but rounding shows that no perturbation grows, not even for a while.
    period_steps
        T.
    eigenvalue
        (real, imaginary) of the largest λ of T steps.
    residual
        ‖M x - λ x‖ / |λ|, x of norm 1.
    noise_step, blow_up_step
        The steps at which rounding noise has grown to the solution's size, and to `time.blow_up` times it; None
        without growth.
    wave
        Periods in the box per axis of the mode's strongest wave.
    null_space_share
        Share of the mode's density that no node sees.
    """

    growth_per_step: float
    norm_bound: float | None
    period_steps: int
    eigenvalue: tuple[float, float]
    residual: float
    noise_step: float | None
    blow_up_step: float | None
    wave: tuple[int, ...]
    null_space_share: float
    solver: str
    unknowns: int


class Monodromy:
    """Applies M to vectors of (ρ, ρ₀ u / c) of this rank's particles, as they were at t = 0; a PETSc shell matrix.

    Notes
    -----
    Collective: T steps of the scene, and one exchange of all particles with all ranks.
    """

    def __init__(self, scene: Scene, comm: MPI.Comm, recurrence: Recurrence) -> None:
        self.recurrence, self.scene, self.comm = recurrence, scene, comm
        self.simulation = Simulation(scene, comm)
        particles = self.simulation.particles
        self.coordinate, self.ids = np.array(particles.coordinate), np.array(particles.ids)
        self.position = particles.position
        self.width = 1 + scene.dim
        self.scales = np.array([1.0, *[scene.gas.sound_speed / scene.gas.density] * scene.dim])
        counts = comm.allgather(len(self.ids))
        everyone = np.concatenate(comm.allgather(self.ids)) if sum(counts) else np.empty(0, dtype=np.int64)
        order = np.argsort(everyone)
        starts = np.concatenate([[0], np.cumsum(counts)])
        self._home = np.searchsorted(starts, order, side="right") - 1
        self._index = order - starts[self._home]
        self.routes = Routes(self.simulation.grid)
        self.applications = 0

    @property
    def unknowns(self) -> int:
        """Size of M: unknowns on all ranks."""
        return int(self.simulation.total) * self.width

    @property
    def own(self) -> int:
        """Rows of M that this rank holds."""
        return len(self.ids) * self.width

    def apply(self, x: FloatArray) -> FloatArray:
        """Return M x, (own,). Collective."""
        self.applications += 1
        simulation = self.simulation
        particles = simulation.particles
        simulation.set_state(self.coordinate, x.reshape(-1, self.width) * self.scales, self.ids)
        for _ in range(self.recurrence.steps):
            simulation.physics.step()
        successor = self.recurrence.successor(np.array(particles.ids))
        rows = np.column_stack([self._index[successor].astype(float), particles.state / self.scales])
        arrived = self.routes.exchange(rows, self._home[successor]).rows
        result = np.empty((len(self.ids), self.width))
        result[arrived[:, 0].astype(np.int64)] = arrived[:, 1:]
        return result.ravel()

    def mult(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Set y = M x, as PETSc calls it. Collective."""
        values = self.apply(np.array(x.getArray(readonly=True)))
        with y as out:
            out[...] = values

    def dense(self) -> FloatArray:
        """Return M written out, (unknowns, unknowns), on all ranks. Collective; as many applications as columns."""
        starts = np.concatenate([[0], np.cumsum(self.comm.allgather(self.own))])
        first = int(starts[self.comm.rank])
        columns = []
        for column in range(self.unknowns):
            unit = np.zeros(self.own)
            if first <= column < first + self.own:
                unit[column - first] = 1.0
            columns.append(np.concatenate(self.comm.allgather(self.apply(unit))))
        return np.stack(columns, axis=1)


def solver_classes() -> dict[str, type[Solver]]:
    """Return the class of the eigensolver by how its PETSc options begin."""
    from slepc4py import SLEPc

    return {"stability_eps": SLEPc.EPS}


def analyse(scene: Scene, comm: MPI.Comm, most_steps: int, tolerance: float = 1e-9) -> Growth:
    """Return the growth per step of the scene's scheme on its pattern of particles. Collective.

    Raises
    ------
    SceneError
        The flow does not recur within `most_steps`.
    NotConverged
        The eigensolver has not found the largest eigenvalue.
    """
    recurrence = find(scene, most_steps)
    monodromy = Monodromy(scene, comm, recurrence)
    found = _by_all(monodromy) if monodromy.unknowns <= DENSE else _by_krylov(monodromy, tolerance)
    growth, bound = _per_step(abs(found.value), recurrence.steps), None
    if found.norm is not None:
        bound = _per_step(found.norm, recurrence.steps)
        growth = min(growth, bound)
    mode = found.vector.reshape(-1, monodromy.width)[:, 0]
    blow_up = _steps_to(1.0 / NOISE * scene.time.blow_up, growth)
    result = Growth(
        growth_per_step=growth,
        norm_bound=bound,
        period_steps=recurrence.steps,
        eigenvalue=(found.value.real, found.value.imag),
        residual=found.residual,
        noise_step=_steps_to(1.0 / NOISE, growth),
        blow_up_step=blow_up,
        wave=_strongest_wave(monodromy, mode),
        null_space_share=_null_space_share(monodromy, mode),
        solver=found.solver,
        unknowns=monodromy.unknowns,
    )
    monodromy.simulation.close()
    return result


class Eigenpair(NamedTuple):
    """The largest eigenvalue of M, this rank's part of its vector, and ‖M‖ where it is known."""

    value: complex
    vector: Mode
    residual: float
    solver: str
    norm: float | None


def _per_step(factor: float, steps: int) -> float:
    """Return the growth per step of what that many steps multiply by `factor`."""
    return math.expm1(math.log(factor) / steps) if factor > 0 else -1.0


def _by_all(monodromy: Monodromy) -> Eigenpair:
    """Find all eigenvalues of M written out, and its norm, by LAPACK; the same on every rank."""
    matrix = monodromy.dense()
    values, vectors = np.linalg.eig(matrix)
    largest = int(np.argmax(np.abs(values)))
    value, vector = complex(values[largest]), vectors[:, largest]
    residual = float(np.linalg.norm(matrix @ vector - value * vector) / max(abs(value), 1e-300))
    starts = np.concatenate([[0], np.cumsum(monodromy.comm.allgather(monodromy.own))])
    span = slice(int(starts[monodromy.comm.rank]), int(starts[monodromy.comm.rank + 1]))
    return Eigenpair(value, vector[span], residual, "lapack", float(np.linalg.norm(matrix, 2)))


def _by_krylov(monodromy: Monodromy, tolerance: float) -> Eigenpair:
    """Find the largest eigenvalue of M by SLEPc's Krylov-Schur method on a shell; options ``-stability_eps_...``."""
    from slepc4py import SLEPc

    sizes = ((monodromy.own, None), (monodromy.own, None))
    matrix = PETSc.Mat().createPython(sizes, monodromy, comm=monodromy.comm)
    eps = SLEPc.EPS().create(monodromy.comm)
    eps.setOptionsPrefix("stability_")
    eps.setOperators(matrix)
    eps.setProblemType(SLEPc.EPS.ProblemType.NHEP)
    eps.setType(SLEPc.EPS.Type.KRYLOVSCHUR)
    eps.setWhichEigenpairs(SLEPc.EPS.Which.LARGEST_MAGNITUDE)
    eps.setDimensions(nev=1, ncv=min(monodromy.unknowns, 48))
    eps.setTolerances(tolerance, 40)
    configure(eps, matrix)
    with refusing("stability_"):
        eps.solve()
    if eps.getConverged() < 1:
        applications = monodromy.applications
        eps.destroy()
        matrix.destroy()
        raise NotConverged(
            f"the largest eigenvalue was not found to {tolerance:g} in {applications} applications of "
            f"{monodromy.recurrence.steps} steps: many modes grow or decay at nearly the same rate; "
            "a smaller scene finds all of them"
        )
    real, imaginary = matrix.createVecs()
    value = complex(eps.getEigenpair(0, real, imaginary))
    vector = np.array(real.getArray(readonly=True)) + 1j * np.array(imaginary.getArray(readonly=True))
    residual = float(eps.computeError(0, SLEPc.EPS.ErrorType.RELATIVE))
    for item in (eps, real, imaginary, matrix):
        item.destroy()
    return Eigenpair(value, vector, residual, "krylovschur", None)


def _steps_to(factor: float, growth: float) -> float | None:
    return math.log(factor) / math.log1p(growth) if growth > 1e-14 else None


def _strongest_wave(monodromy: Monodromy, mode: Mode) -> tuple[int, ...]:
    """Return the wave of largest amplitude among those, about, that the particles can tell apart. Collective."""
    scene, comm = monodromy.scene, monodromy.comm
    finer = max(1.0, monodromy.simulation.total / scene.cell_count) ** (1.0 / scene.dim)
    spans = [np.arange(-int(n * finer) // 2, int(n * finer) // 2 + 1) for n in scene.grid.cells]
    waves = np.stack(np.meshgrid(*spans, indexing="ij"), axis=-1).reshape(-1, scene.dim)
    turns = 2.0 * np.pi * monodromy.position / np.array(scene.grid.length)
    best, found = -1.0, (0,) * scene.dim
    for start in range(0, len(waves), 1024):
        block = waves[start : start + 1024]
        amplitude = np.exp(-1j * (turns @ block.T)).T @ mode
        comm.Allreduce(MPI.IN_PLACE, amplitude)
        largest = int(np.argmax(np.abs(amplitude)))
        if abs(amplitude[largest]) > best * (1.0 + 1e-9):
            best, found = abs(amplitude[largest]), tuple(int(abs(k)) for k in block[largest])
    return found


def _null_space_share(monodromy: Monodromy, mode: Mode) -> float:
    """Return ‖(1 - P) ρ‖ / ‖ρ‖ of the mode's density; 0 for a mode without density. Collective."""
    simulation = monodromy.simulation
    mapping = Mapping(simulation.grid, monodromy.position)
    parts = np.column_stack([mode.real, mode.imag])
    size = simulation.grid.reduce(np.array([np.sum(parts**2)]))[0]
    if size == 0.0:
        return 0.0
    hidden = parts - ExactFilter(mapping, 1e-10, "report_", strict=False).apply(parts)
    return float(np.sqrt(simulation.grid.reduce(np.array([np.sum(hidden**2)]))[0] / size))


def report(growth: Growth, scene: Scene) -> list[tuple[str, str]]:
    """Return the result as (name, value) lines."""

    def when(step: float | None) -> str:
        return "never, as nothing grows" if step is None else f"at about step {step:,.0f}, t = {step * scene.dt:.4g}"

    bound = growth.norm_bound
    return [
        ("growth", f"{growth.growth_per_step:.6e} a step (μ - 1)"),
        *([] if bound is None else [("bound", f"{bound:.3e} a step: the norm of M allows no more")]),
        ("period", f"{growth.period_steps} steps; {growth.unknowns} unknowns, by {growth.solver}"),
        ("eigenvalue", f"{growth.eigenvalue[0]:.8g} {growth.eigenvalue[1]:+.8g} i, residual {growth.residual:.1e}"),
        ("mode", f"wave {list(growth.wave)}, {100 * growth.null_space_share:.3g} % in the null space"),
        ("noise", f"reaches the solution's size {when(growth.noise_step)}"),
        ("blow-up", f"|ρ| passes {scene.time.blow_up:g} times its start {when(growth.blow_up_step)}"),
    ]


def run(scene: Scene, comm: MPI.Comm, console: Console, output: Path | None, most_steps: int) -> Growth:
    """Analyse, print, and write stability.json into the folder `output`. Collective."""
    if output is not None:
        make_folder(output, comm)
    growth = analyse(scene, comm, most_steps)
    console.banner(report(growth, scene))
    folder = output or RunDirectory.default(f"{scene.name}-stability", comm)
    content = {**asdict(growth), "scene": scene.to_dict(), "versions": versions()}
    on_first(comm, lambda: write_json(folder / "stability.json", content))
    console.message(f"results in {folder}")
    return growth
