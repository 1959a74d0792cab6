"""What each rank runs for the tests of whole simulations: python simulate_helpers.py CASES FOLDER.

CASES is a JSON file, name -> overrides of the default scene. Every case is run to its end in one start of the ranks;
rank 0 saves FOLDER/<name>.npz with the particles in the order of their ids.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

from mpipic.run.loop import Simulation
from mpipic.runtime import start
from mpipic.scene.records import Scene

COMM = start()


def migrated_so_far(simulation: Simulation) -> int:
    """How many particles have arrived on this rank, whichever form of the step counts them."""
    stepper = simulation.physics.stepper
    return stepper.sweep.migrated if hasattr(stepper, "sweep") else stepper.motion.migrated


class Watch:
    """An observer that keeps how many particles there were, and which rank held them, after every step."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self.counts: list[int] = []
        self.migrated: list[int] = []

    def record(self, step: int, time: float, peak: float, report: object) -> None:
        """Nothing to keep."""

    def snapshot(self, step: int, time: float) -> None:
        """Nothing to keep."""

    def progress(self, step: int, time: float) -> None:
        """Keep the local count and what has migrated so far."""
        self.counts.append(self.simulation.particles.count)
        self.migrated.append(migrated_so_far(self.simulation))


def by_id(simulation: Simulation) -> dict[str, np.ndarray] | None:
    """Particles of all ranks in the order of their ids, and the rank that holds each; None but on rank 0."""
    particles = simulation.particles
    here = {
        "ids": particles.ids,
        "coordinate": particles.coordinate,
        "position": particles.position,
        "density": particles["density"],
        "velocity": particles["velocity"],
        "rank": np.full(particles.count, COMM.rank),
        "owner": simulation.grid.owner_of(particles.coordinate),
    }
    parts = COMM.gather({name: array.copy() for name, array in here.items()})
    if parts is None:
        return None
    whole = {name: np.concatenate([part[name] for part in parts]) for name in here}
    order = np.argsort(whole["ids"], kind="stable")
    return {name: array[order] for name, array in whole.items()}


def run_case(overrides: list[str]) -> dict[str, np.ndarray] | None:
    """Run one scene; what rank 0 saves."""
    scene = Scene.load(None, overrides)
    simulation = Simulation(scene, COMM)
    before = by_id(simulation)
    watch = Watch(simulation)
    outcome = simulation.run(watch)
    after = by_id(simulation)
    counts, migrated = COMM.gather(watch.counts), COMM.gather(watch.migrated)
    if before is None or after is None:
        return None
    return {
        **after,
        **{f"{name}_before": array for name, array in before.items()},
        "counts": np.array(counts),
        "migrated": np.array(migrated),
        "blocks": np.array(simulation.grid.blocks),
        "moved": np.array(scene.gas.flow) * scene.dt * outcome.step,
        "length": np.array(scene.grid.length),
        "completed": np.array(outcome.status == "completed"),
    }


def main(cases: Path, folder: Path) -> None:
    """Run all cases."""
    for name, overrides in json.loads(cases.read_text()).items():
        result = run_case(overrides)
        if result is not None:
            np.savez(folder / f"{name}.npz", **result)
            print("done", name, flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
