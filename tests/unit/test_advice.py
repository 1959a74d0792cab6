import numpy as np
import pytest
from mpi4py import MPI

from mpipic.run import describe as advice
from mpipic.run.loop import Simulation
from mpipic.scene.records import Scene


def scene_of(cells, kind):
    data = {"grid": {"cells": cells}, "particles": {"per_cell": [2] * len(cells)}, "filter": {"kind": kind}}
    return Scene.from_dict({**data, "initial": {"profile": "plane-wave"}})


@pytest.mark.parametrize("kind", ["none", "local"])
@pytest.mark.parametrize("cells", [[20000], [150, 150], [32, 32, 32]])
def test_the_memory_that_check_promises_is_what_a_run_takes(cells, kind):
    scene = scene_of(cells, kind)
    promised = advice.rank_bytes(scene, 1, scene.particle_count)
    simulation = Simulation(scene, MPI.COMM_SELF)
    simulation.physics.step()  # work arrays are made when first used
    taken = simulation.resident_bytes()
    ghosts = np.prod([n + 2 for n in cells]) / np.prod(cells)
    assert promised < taken < promised * ghosts * 1.06  # ghost nodes, and the list of particles that leave


SCHEMES = {
    "exact": {"filter": {"kind": "exact"}},
    "exact rk4": {"filter": {"kind": "exact"}, "time": {"integrator": "rk4"}},
    "consistent": {"mapping": {"mass": "consistent", "basis": "cubic", "gradient": "grid"}},
    "penalised exact": {"mapping": {"mass": "penalised", "basis": "quadratic"}, "filter": {"kind": "exact"}},
}


@pytest.mark.parametrize("name", SCHEMES)
def test_what_solvers_keep_on_a_node_is_promised_too(name):
    """To a third: ghosts and scratch of what is assembled, are not promised; PETSc's vectors are, and not taken."""
    scene = Scene.from_dict({"grid": {"cells": [150, 150]}, "initial": {"profile": "plane-wave"}, **SCHEMES[name]})
    simulation = Simulation(scene, MPI.COMM_SELF)
    for _ in range(3):
        simulation.physics.step()
    taken = simulation.physics.nbytes / scene.cell_count
    assert 0.67 * advice.node_bytes(scene) < taken < 1.33 * advice.node_bytes(scene)


def test_what_a_scene_leaves_out_is_said():
    scene = scene_of([8], "none")
    assert dict(advice.built(scene))["filter"] == "none"
    assert {"filter", "SLEPc", "h5py", "snapshots", "linear solvers", "y", "z"} <= set(advice.left_out(scene))
    assert "filter" not in advice.left_out(scene_of([8], "local"))


def test_keys_that_nothing_uses_are_all_left_out_in_the_order_given():
    scene = Scene.load(None, ["particles.jitter=0.4", "filter.order=3", "particles.seed=7"])
    assert [one.key for one in scene.unused] == ["particles.jitter", "particles.seed", "filter.order"]
    assert advice.left_out(scene)[-3:] == [one.key for one in scene.unused]
