"""Running a scene in this process on one rank, and what it reported."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from mpipic.run.loop import Simulation
from mpipic.scene.records import Scene


class Reports:
    """An observer that keeps what it is told."""

    def __init__(self):
        self.errors, self.peaks, self.snapshots, self.steps = {}, {}, [], 0

    def record(self, step, time, peak, report):
        self.peaks[step] = peak
        if report is not None:
            self.errors[step] = report

    def snapshot(self, step, time):
        self.snapshots.append((step, time))

    def progress(self, step, time):
        self.steps += 1


def scene_of(data=None, **sections):
    """A scene from sections as keywords: scene_of(filter={"kind": "none"})."""
    return Scene.from_dict({**(data or {}), **sections})


def run_scene(scene):
    """The simulation after its last step, how it ended, and what it reported."""
    simulation, reports = Simulation(scene, MPI.COMM_SELF), Reports()
    return simulation, simulation.run(reports), reports


def error_of(scene):
    """Root mean square error of density after the last step of a run that must complete."""
    _, outcome, reports = run_scene(scene)
    assert outcome.status == "completed"
    return reports.errors[scene.time.steps].errors["density"].l2


def orders(errors, factor=2.0):
    """Observed orders of convergence between levels that refine by `factor`."""
    errors = np.asarray(errors)
    return np.log(errors[:-1] / errors[1:]) / np.log(factor)
