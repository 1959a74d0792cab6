"""What each rank runs for `test_failing_rank.py`: python failing_helpers.py CASE. Every case must end in an error."""

from __future__ import annotations

import sys
import time

import numpy as np

from mpipic import cli
from mpipic.run.loop import Simulation
from mpipic.runtime import start
from mpipic.scene.records import Scene

SMALL = ["grid.cells=[20]", "gas.flow=[0.5]", "time.steps=1000000"]


def fail_deep_inside() -> None:
    """Something with a name to look for in a traceback."""
    raise ZeroDivisionError("the ninth part of nothing")


def case_exception() -> None:
    """Rank 1 fails while the others wait for it."""
    comm = start()
    if comm.rank == 1:
        fail_deep_inside()
    comm.Barrier()


def case_exception_in_run() -> None:
    """Rank 1 fails in the middle of `mpipic run`, the others go on stepping."""

    def failing_progress(self: object, step: int, time: float) -> None:
        if step == 50 and start().rank == 1:
            fail_deep_inside()

    from mpipic.run.verb import Recorder

    Recorder.progress = failing_progress
    sys.argv = ["mpipic", "run", "--no-plots", "--output", sys.argv[2], *(f"--set={text}" for text in SMALL)]
    cli.main()


class Thief:
    """An observer that takes one particle of the last rank away after step 7."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation

    def record(self, *args: object) -> None:
        """Nothing."""

    snapshot = record

    def progress(self, step: int, time: float) -> None:
        """Take it."""
        if step == 7 and self.simulation.comm.rank == self.simulation.comm.size - 1:
            self.simulation.particles.take(np.array([0]))


def case_theft() -> None:
    """A particle disappears on one rank."""
    comm = start()
    simulation = Simulation(Scene.load(None, SMALL), comm)
    simulation.run(Thief(simulation))


def case_delay() -> None:
    """Rank 0 waits long, by itself; the last rank fails at once."""
    comm = start()
    if comm.rank == comm.size - 1:
        fail_deep_inside()
    time.sleep(3600)


if __name__ == "__main__":
    globals()[f"case_{sys.argv[1]}"]()
    print("reached the end", flush=True)
