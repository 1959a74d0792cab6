"""What each rank runs for `test_border_ranks.py`: python border_helpers.py FOLDER.

Takes 1000 steps of the swirling tracers and saves FOLDER/swirl.npz on rank 0: particles in the order of their ids, how
many ranks each has been on, the nodal means, and the conserved sums. Then runs a scene of theirs into FOLDER/run, as
`mpipic run` would if the package had them.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from mpipic import Scene
from mpipic.console import Console
from mpipic.run import build, verb
from mpipic.run.loop import Simulation
from mpipic.runtime import start
from swirl_helpers import Swirl

COMM = start()
STEPS = 1000
SCENE = [
    "grid.cells=[12, 10]", "grid.length=[1.5, 1.0]", "particles.layout=random", "particles.per_cell=[3]",
    "mapping.basis=quadratic", "gas.flow=[0.0, 0.0]", "time.dt=0.01", f"time.steps={STEPS}",
]  # fmt: skip


class Tracers(Swirl):
    """The same, as a physics that a scene can name."""

    kind = "swirl"
    about = "tracers in a swirling flow"


def run_scene(folder: Path) -> None:
    """Run a scene with this physics, snapshots, a report and pictures and all."""
    build.PHYSICS["swirl"] = lambda scene: Tracers(scene.grid.length, scene.dt)
    scene = Scene.from_dict(
        {
            "physics": {"kind": "swirl"},
            "grid": {"cells": [12, 10], "length": [1.5, 1.0]},
            "particles": {"layout": "random", "per_cell": [3]},
            "time": {"dt": 0.01, "steps": 40},
            "output": {"every": 20, "report_at": [0]},
        },
        name="swirl",
    )
    code = verb.run(scene, COMM, folder / "run", False, Console(COMM), True)
    assert code == 0


def whole(simulation: Simulation) -> dict[str, np.ndarray] | None:
    """Particles of all ranks in the order of their ids; None but on rank 0."""
    particles = simulation.particles
    mine = {"ids": particles.ids, "coordinate": particles.coordinate, **particles.fields}
    mine["owner"] = np.full(particles.count, COMM.rank)
    parts = COMM.gather({name: values.copy() for name, values in mine.items()})
    if parts is None:
        return None
    joined = {name: np.concatenate([part[name] for part in parts]) for name in mine}
    order = np.argsort(joined["ids"], kind="stable")
    return {name: values[order] for name, values in joined.items()}


def main(folder: Path) -> None:
    """Run, and save."""
    scene = Scene.load(None, SCENE)
    simulation = Simulation(scene, COMM, physics=Swirl(scene.grid.length, scene.dt))
    begin, sums = whole(simulation), simulation.conserved()
    for _ in range(STEPS):
        simulation.physics.step()
    end, sums_at_end = whole(simulation), simulation.conserved()
    grid = simulation.grid
    nodal = {name: COMM.gather(values) for name, values in simulation.physics.nodal().items()}
    starts = COMM.gather(grid.owned_start)
    arrived = COMM.allreduce(simulation.physics.motion.migrated)
    simulation.close()
    if begin is not None and end is not None:
        save(folder, begin, end, nodal, starts, scene.grid.cells, {"before": sums, "after": sums_at_end}, arrived)
    run_scene(folder)


def save(folder, begin, end, nodal, starts, cells, sums, arrived) -> None:
    """Write everything to one file."""
    on_nodes = {}
    for name, blocks in nodal.items():
        array = np.zeros((*cells, *blocks[0].shape[2:]))
        for corner, block in zip(starts, blocks, strict=True):
            array[tuple(slice(c, c + n) for c, n in zip(corner, block.shape))] = block
        on_nodes[f"nodal_{name}"] = array
    names = {f"{name}_before": values for name, values in begin.items()}
    totals = {f"sum_{name}": np.array([sums["before"][name], sums["after"][name]]) for name in sums["before"]}
    np.savez(folder / "swirl.npz", **end, **names, **on_nodes, **totals, arrived=arrived)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
