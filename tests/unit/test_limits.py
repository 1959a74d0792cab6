"""The CFL limit that a run states, against runs at it."""

import numpy as np
import pytest
from mpi4py import MPI

from mpipic.run.limits import cfl_limit
from mpipic.run.loop import Simulation
from mpipic.scene.records import Scene

SCHEMES = {
    "none": ["filter.kind=none"],
    "local": [],
    "exact": ["filter.kind=exact"],
    "cubic": ["mapping.basis=cubic", "mapping.mass=consistent", "filter.kind=exact", "time.integrator=rk4"],
    "grid": ["mapping.basis=cubic", "mapping.mass=consistent", "mapping.gradient=grid", "filter.kind=exact",
             "time.integrator=rk4"],
}  # fmt: skip


def peak_after(scheme, cfl, steps=600):
    """Largest |density| relative to the start, of noise at frozen positions."""
    still = ["grid.cells=[24]", "gas.flow=[0.0]", f"time.cfl={cfl}", "initial.profile=plane-wave"]
    simulation = Simulation(Scene.load(None, [*still, *SCHEMES[scheme]]), MPI.COMM_SELF)
    simulation.set_state(state=np.random.default_rng(0).standard_normal(simulation.particles.state.shape))
    start = simulation.physics.peak
    for _ in range(steps):
        simulation.physics.step()
        if not simulation.physics.peak < 1e6 * start:
            return np.inf
    return simulation.physics.peak / start


@pytest.mark.parametrize("scheme", SCHEMES)
def test_frozen_noise_stays_bounded_below_the_limit_and_grows_above(scheme):
    limit = cfl_limit(Scene.load(None, ["time.cfl=0.1", *SCHEMES[scheme]]), MPI.COMM_SELF)
    assert peak_after(scheme, 0.97 * limit) < 1e3
    assert peak_after(scheme, 1.05 * limit) == np.inf


def test_midpoint_has_no_limit():
    overrides = ["time.integrator=midpoint", "mapping.mass=consistent", "filter.kind=exact"]
    assert cfl_limit(Scene.load(None, overrides), MPI.COMM_SELF) is None
