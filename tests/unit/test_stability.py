"""Growth per step: recurrence of patterns, the table of known growth rates, and dense matrices beside Krylov's."""

import math

import numpy as np
import pytest
from mpi4py import MPI

from dense_helpers import Dense, close
from mpipic import stability
from mpipic.recurrence import Recurrence, find, nearest_flows
from mpipic.scene import Scene, SceneError
from mpipic.stability import Monodromy, analyse
from mpipic.stability_map import parse_axis, with_flow, with_value

COMM = MPI.COMM_SELF


def scene(**sections):
    return Scene.from_dict({"grid": {"cells": [16]}, "initial": {"profile": "plane-wave"}, **sections})


# basis, particles per cell, flow, CFL: growth of none, local, order 2, exact, in thousandths, three decimals
KNOWN = [
    ("linear", 2, 0.05, 0.05, (21.079, 0.114, 0.187, 3.563)),
    ("linear", 2, 0.1, 0.1, (50.172, 0.850, 1.158, 2.562)),
    ("linear", 4, 0.25, 0.2, (94.794, 0.094, 0.258, 0.786)),
    ("quadratic", 2, 0.05, 0.1, (20.443, 0.000, 0.000, 0.003)),
    ("cubic", 2, 0.05, 0.1, (5.932, 0.000, 0.000, 0.000)),
]
KINDS = ({"kind": "none"}, {"kind": "local"}, {"kind": "order", "order": 2}, {"kind": "exact", "tolerance": 1e-12})


@pytest.mark.parametrize(
    "basis, per_cell, flow, cfl, wanted, number",
    # the exact filter takes seconds where the period is long
    [(*row, number) for row in KNOWN for number in range(4) if number < 3 or row[2] >= 0.1],
)
def test_growth_is_what_dense_eigenvalues_of_another_implementation_gave(basis, per_cell, flow, cfl, wanted, number):
    made = scene(
        particles={"per_cell": [per_cell]}, gas={"flow": [flow]}, mapping={"basis": basis}, filter=KINDS[number],
        time={"cfl": cfl},
    )  # fmt: skip
    growth = analyse(made, COMM, 1000)
    assert f"{1e3 * growth.growth_per_step:.3f}".lstrip("-") == f"{wanted[number]:.3f}"
    assert growth.residual < 1e-9


def test_the_paper_scene_grows_with_the_local_filter_too():
    growth = analyse(Scene.from_dict({}), COMM, 1000)
    assert growth.period_steps == 80 and f"{1e3 * growth.growth_per_step:.3f}" == "0.750"
    assert 48_000 < growth.noise_step < 51_000 and growth.blow_up_step > growth.noise_step


def test_the_monodromy_is_the_product_of_dense_step_matrices():
    made = scene(grid={"cells": [8]}, particles={"layout": "random", "per_cell": [3]}, gas={"flow": [0.5]},
                 filter={"kind": "local"}, time={"cfl": 0.25})  # fmt: skip
    recurrence = find(made, 100)
    assert recurrence.steps == 8 and recurrence.lattice is None
    monodromy = Monodromy(made, COMM, recurrence)
    n, position, product = len(monodromy.ids), monodromy.position.copy(), np.eye(2 * len(monodromy.ids))
    rates = (made.dt, made.dt)
    for _ in range(recurrence.steps):
        dense = Dense((8,), (1.0,), position)
        columns = []
        for unit in np.eye(2 * n):
            density, velocity = dense.euler_step(unit[0::2].copy(), unit[1::2, None].copy(), rates, "local")
            columns.append(np.column_stack([density, velocity[:, 0]]).ravel())
        product = np.stack(columns, axis=1) @ product
        position = np.mod(position + 0.5 * made.dt, 1.0)
    close(monodromy.dense(), product, 1e-11)


def test_krylov_finds_what_lapack_finds(monkeypatch):
    made = scene(particles={"layout": "jittered", "per_cell": [2], "jitter": 0.4}, gas={"flow": [0.5]},
                 time={"cfl": 0.2})  # fmt: skip
    dense = analyse(made, COMM, 100)
    monkeypatch.setattr(stability, "DENSE", 0)
    krylov = analyse(made, COMM, 100)
    assert (dense.solver, krylov.solver) == ("lapack", "krylovschur")
    assert dense.growth_per_step > 1e-3
    assert krylov.growth_per_step == pytest.approx(dense.growth_per_step, rel=1e-6)
    assert abs(abs(complex(*krylov.eigenvalue)) - abs(complex(*dense.eigenvalue))) < 1e-8 * abs(
        complex(*dense.eigenvalue)
    )


@pytest.mark.parametrize("layout", [{"layout": "random", "per_cell": [3], "seed": 5}, {"per_cell": [3]}])
def test_the_recommended_scheme_does_not_grow(layout):
    made = Scene.load(None, ["grid.cells=[16]", "gas.flow=[0.5]", "time.cfl=0.4", "initial.profile=plane-wave",
                             *(f"particles.{k}={v}" for k, v in layout.items())], preset="recommended")  # fmt: skip
    assert analyse(made, COMM, 200).growth_per_step < 1e-7


@pytest.mark.parametrize("integrator, cfl", [("rk4", 0.2), ("midpoint", 3.0)])
def test_the_skew_gradient_does_not_grow_on_disordered_particles(integrator, cfl):
    flow = 0.5 * 0.2 / cfl
    made = scene(grid={"cells": [8]}, particles={"layout": "random", "per_cell": [4]}, gas={"flow": [flow]},
                 mapping={"basis": "cubic", "mass": "consistent", "gradient": "skew"},
                 filter={"kind": "exact", "tolerance": 1e-13},
                 time={"cfl": cfl, "integrator": integrator})  # fmt: skip
    assert analyse(made, COMM, 200).growth_per_step <= 1e-11


def test_a_lattice_recurs_after_a_spacing_and_other_patterns_after_a_cell():
    lattice = find(scene(gas={"flow": [0.5]}, time={"cfl": 0.25}), 100)
    random = find(scene(gas={"flow": [0.5]}, time={"cfl": 0.25}, particles={"layout": "random"}), 100)
    assert (lattice.steps, lattice.shift, lattice.lattice) == (4, (1,), (32,))
    assert (random.steps, random.shift, random.lattice) == (8, (1,), None)
    assert find(scene(gas={"flow": [0.0]}), 1).steps == 1


def test_particles_change_places_with_their_neighbours_on_a_lattice():
    recurrence = Recurrence(3, (1, -1), (4, 3))
    successor = recurrence.successor(np.arange(12))
    assert sorted(successor) == list(range(12))
    assert successor[0] == 1 + 4 * 2 and successor[3] == 0 + 4 * 2


def test_a_flow_that_does_not_recur_is_refused_with_flows_that_do():
    made = scene(gas={"flow": [0.512345]}, time={"cfl": 0.2})
    with pytest.raises(SceneError, match=r"within 50 steps; near it, these do: \["):
        find(made, 50)
    for flow in nearest_flows(made, 50):
        assert find(scene(gas={"flow": list(flow)}, time={"cfl": 0.2}), 50).steps <= 50
        assert abs(flow[0] - 0.512345) < 0.05
    assert find(with_flow(made, 50), 50).steps <= 50


def test_a_map_axis_is_read_and_put_into_the_scene():
    axis = parse_axis("gas.flow=0:0.5:3")
    assert axis.key == "gas.flow" and axis.values == (0.0, 0.25, 0.5)
    assert with_value(scene(), "gas.flow", 0.25).gas.flow == (0.25,)
    assert with_value(scene(), "time.cfl", 0.5).cfl == 0.5
    for wrong in ("gas.flow", "gas.flow=1:2", "gas.flow=a:b:3", "gas.flow=0:1:0"):
        with pytest.raises(SceneError, match="FROM:TO:COUNT"):
            parse_axis(wrong)


def test_predicted_steps_follow_from_the_growth():
    growth = analyse(scene(filter={"kind": "none"}, gas={"flow": [0.25]}, time={"cfl": 0.2}), COMM, 200)
    rate = math.log1p(growth.growth_per_step)
    assert growth.noise_step == pytest.approx(math.log(1e16) / rate)
    assert growth.blow_up_step == pytest.approx(math.log(1e18) / rate)
