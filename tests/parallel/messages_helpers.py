"""What each rank runs for `test_messages.py`: python messages_helpers.py FILE; rank 0 writes it as JSON."""

from __future__ import annotations

import json
import sys
from collections import Counter
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from mpipic.mesh.grid import Grid
from mpipic.particles.migration import LostParticles, Reach, Routes, migrate
from mpipic.particles.store import Particles
from mpipic.run.loop import Simulation
from mpipic.runtime import start
from mpipic.scene.records import Scene

COMM = start()

BOXES = {
    # equal blocks on 2, 4 and 8 ranks; then blocks that differ by a cell; then blocks of one cell
    "1d": (48,), "2d": (16, 16), "3d": (8, 8, 8), "1d-uneven": (29,), "2d-uneven": (9, 11), "3d-uneven": (5, 6, 7),
    "1d-single": (8,),
}  # fmt: skip
MOVES = {
    "forward": (0.3, 0.2, 0.4), "back": (-0.3, -0.7, -0.1), "across": (0.3, -0.2, 0.4), "whole": (1.0, -2.0, 3.0),
    "far": (17.3, -8.6, 5.2), "past": (-131.4, 77.7, 40.1), "along-x": (0.6, 0.0, 0.0), "still": (0.0, 0.0, 0.0),
}  # fmt: skip


def case_routes() -> Any:
    """Destinations and sources of every rank, and where particles all over each rank's cells really go."""
    found = []
    for box, cells in BOXES.items():
        grid = Grid(cells, [1.0] * len(cells))
        rng = np.random.default_rng(COMM.rank)
        first, shape = np.array(grid.owned_start), np.array(grid.owned_shape)
        inside = first + rng.random((4000, grid.dim)) * shape
        corners = first + rng.integers(0, 2, (200, grid.dim)) * (shape - 1e-9)
        nodes = first + rng.integers(0, 10**6, (400, grid.dim)) % shape
        coordinate = np.concatenate([inside, corners, nodes])
        coordinate = coordinate[grid.owner_of(coordinate) == COMM.rank]
        for move, displacement in MOVES.items():
            shift = displacement[: grid.dim]
            routes = Routes(grid, Reach.of_one(shift))
            reached = np.unique(grid.owner_of(grid.wrapped(coordinate + shift))).tolist()
            facts = {"destinations": routes.destinations, "sources": routes.sources, "reached": reached}
            routes.free()
            everywhere = COMM.gather(facts)
            found.append({"box": box, "move": move, "dim": grid.dim, "ranks": everywhere})
    return found


class Counting:
    """A communicator that counts by name what is called on it."""

    calls: ClassVar[Counter[str]] = Counter()

    def __getattribute__(self, name: str) -> Any:
        if name[0].isalpha() and name not in ("rank", "size", "Get_rank", "Get_size"):
            Counting.calls[name] += 1
        return super().__getattribute__(name)


class CountingComm(Counting, MPI.Intracomm):
    """For the ranks of a run."""


class CountingGraph(Counting, MPI.Distgraphcomm):
    """For the neighbours of migration."""


def count_calls(holder: Any, seen: set[int]) -> int:
    """Put counting communicators in the place of all that are held by an object and what it holds; how many."""
    if id(holder) in seen or not type(holder).__module__.startswith("mpipic.") or not hasattr(holder, "__dict__"):
        return 0
    seen.add(id(holder))
    found = 0
    for name, value in list(vars(holder).items()):
        for kind, counting in ((MPI.Intracomm, CountingComm), (MPI.Distgraphcomm, CountingGraph)):
            if type(value) is kind:
                setattr(holder, name, counting(value))
                found += 1
        found += count_calls(value, seen)
    return found


STEPS, RUN = 6, 500
HALO = ("SFReduceBegin", "SFReduceEnd", "SFBcastBegin", "SFBcastEnd")
VECTORS = ("VecNorm", "VecDot", "VecTDot", "VecMDot", "VecReduceComm", "VecMax", "VecSum")


def logged(quantity: str, events: tuple[str, ...]) -> float:
    """What PETSc logged so far: numReductions are its global reductions, numMessages what this rank sent."""
    return sum(PETSc.Log.Event(name).getPerfInfo()[quantity] for name in events)


KINDS = ("none", "local", "order", "chebyshev", "exact")
SOLVER = ("KSPSolve", "MatMult", "PCApply")


def case_step() -> Any:
    """What is called on communicators in `STEPS` steps, and what PETSc counts."""
    PETSc.Log.begin()
    found = {}
    for kind in KINDS:
        settings = ["grid.cells=[12, 12]", "gas.flow=[0.9, -0.7]", "time.cfl=0.3"]
        settings += ["filter.tolerance=1e-6"] if kind == "exact" else []  # iterations are counted, not results
        scene = Scene.load(None, [*settings, "particles.layout=random", f"filter.kind={kind}"])
        simulation = Simulation(scene, COMM)
        simulation.physics.step()  # solvers are made when first used
        counted = count_calls(simulation, set())
        Counting.calls.clear()
        before = {name: logged("count", (name,)) for name in (*SOLVER, *HALO)}
        reductions, messages = logged("numReductions", HALO + VECTORS), logged("numMessages", HALO)
        migrated = simulation.physics.stepper.sweep.migrated
        for _ in range(STEPS):
            simulation.physics.step()
        calls = dict(Counting.calls)
        reductions = logged("numReductions", HALO + VECTORS) - reductions
        messages = logged("numMessages", HALO) - messages
        events = {name: logged("count", (name,)) - count for name, count in before.items()}
        migrated = COMM.gather(simulation.physics.stepper.sweep.migrated - migrated)
        facts = {"calls": calls, "counted": counted, "petsc_reductions": reductions, "halo_messages": messages}
        everywhere = COMM.gather({**facts, "events": events})
        found[kind] = {"ranks": everywhere, "migrated": migrated}
    return found


def case_run() -> Any:
    """What is called on communicators in a run of `RUN` steps, besides the neighbours'."""
    if COMM.size > 2:
        return None
    scene = Scene.load(None, ["grid.cells=[16]", "gas.flow=[0.5]", "time.cfl=0.2", f"time.steps={RUN}"])
    simulation = Simulation(scene, COMM)
    count_calls(simulation, set())
    Counting.calls.clear()
    simulation.run(Silent())
    return COMM.gather({name: n for name, n in Counting.calls.items() if not name.startswith("Neighbor")})


class Silent:
    """An observer that does nothing."""

    def record(self, *args: object) -> None:
        """Nothing."""

    snapshot = progress = record


def case_astray() -> Any:
    """Every rank is given a particle that belongs two ranks further, where a short journey has no route."""
    if COMM.size < 4:
        return None
    grid = Grid((24,), (1.0,))
    routes = Routes(grid, Reach.of_one((0.25,)))
    particles = Particles(grid.h, {"density": (), "velocity": (1,)})
    home = grid.owned_start[0] + 0.5
    away = (home + 2 * grid.owned_shape[0]) % 24
    particles.append(np.array([[home], [away]]), np.zeros((2, 2)), np.array([2 * COMM.rank, 2 * COMM.rank + 1]))
    try:
        migrate(particles, routes, np.array([1]))
    except LostParticles as error:
        said = str(error)
    else:
        said = "delivered"
    return COMM.gather(said)


def main(file: Path) -> None:
    """Run all cases."""
    result = {name: globals()[f"case_{name}"]() for name in ("routes", "step", "run", "astray")}
    if COMM.rank == 0:
        file.write_text(json.dumps(result))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
