"""Growth per step: recurrence of patterns, the table of known growth rates, and dense matrices beside Krylov's."""

import math

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

from dense_helpers import Dense, close
from mpipic.analysis import growth as growth_module
from mpipic.analysis.growth import Monodromy, analyse
from mpipic.analysis.growth_map import MapAxis, MapPoint, by_filter, parse_axis, with_flow, with_value
from mpipic.analysis.recurrence import Recurrence, find, nearest_flows
from mpipic.run.limits import cfl_limit
from mpipic.scene.records import Scene, SceneError

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


def pattern(cells, layout, per_cell, flow, cfl, *more, preset="recommended"):
    jitter = ["particles.jitter=0.4"] if layout == "jittered" else []
    return Scene.load(None, [f"grid.cells={cells}", f"particles.layout={layout}", f"particles.per_cell={per_cell}",
                             f"gas.flow={flow}", f"time.cfl={cfl}", "initial.profile=plane-wave", *jitter, *more],
                      preset=preset)  # fmt: skip


EXACT = ("filter.kind=exact", "filter.tolerance=1e-13")
# scene, and whether it grows
BOTH_WAYS = {
    "1D paper random": (pattern([12], "random", [2], [0.5], 0.2, preset="paper"), True),
    "1D paper jittered": (pattern([16], "jittered", [2], [0.5], 0.2, preset="paper"), True),
    "1D exact random": (pattern([12], "random", [3], [1.0], 0.25, *EXACT, preset="paper"), True),
    "1D unfiltered lattice": (pattern([16], "lattice", [2], [0.25], 0.2, "filter.kind=none", preset="paper"), True),
    "1D recommended random": (pattern([12], "random", [2], [0.5], 0.4), False),
    "1D recommended, linear": (pattern([12], "random", [2], [0.5], 0.4, "mapping.basis=linear"), True),
    "1D recommended, quadratic": (pattern([12], "random", [1], [0.25], 0.4, "mapping.basis=quadratic"), False),
    "2D paper random": (pattern([4, 4], "random", [2], [1.0, 0.5], 0.5, preset="paper"), True),
    "2D paper jittered": (pattern([4, 4], "jittered", [2, 1], [1.0, 0.5], 0.5, preset="paper"), True),
    "2D recommended random": (pattern([4, 3], "random", [1], [1.25, 0.625], 0.4), False),
}


@pytest.mark.parametrize("name", BOTH_WAYS)
def test_krylov_finds_what_lapack_finds(monkeypatch, name):
    made, grows = BOTH_WAYS[name]
    dense = analyse(made, COMM, 100)
    monkeypatch.setattr(growth_module, "DENSE", 0)
    krylov = analyse(made, COMM, 100)
    assert (dense.solver, krylov.solver) == ("lapack", "krylovschur")
    assert (dense.growth_per_step > 1e-5) == grows
    if not grows:
        assert abs(dense.growth_per_step) < 1e-11, "constants neither grow nor decay"
    assert abs(krylov.growth_per_step - dense.growth_per_step) < 1e-8
    assert abs(abs(complex(*krylov.eigenvalue)) / abs(complex(*dense.eigenvalue)) - 1.0) < 1e-8
    assert krylov.norm_bound is None and dense.norm_bound >= dense.growth_per_step


@pytest.mark.parametrize("layout, per_cell, flow, seed", [("random", 3, 0.5, 5), ("random", 2, 0.125, 5),
                                                          ("random", 1, 0.25, 19), ("lattice", 3, 0.5, 0)])  # fmt: skip
def test_the_recommended_scheme_does_not_grow(layout, per_cell, flow, seed):
    made = pattern([16], layout, [per_cell], [flow], 0.4, f"particles.seed={seed}")
    assert analyse(made, COMM, 200).growth_per_step < 1e-11


def test_without_damping_of_the_null_space_noise_and_sound_feed_each_other():
    """At v/c = 2/16 particles hear the grid pass at the frequency of sound of two waves in 16 cells."""
    made = pattern([16], "random", [2], [0.125], 0.4, "particles.seed=5", "damping.null_space=0", "mapping.penalty=0.1",
                   "damping.order=4", "damping.strength=1.0")  # fmt: skip
    growth = analyse(made, COMM, 100)
    assert growth.growth_per_step == pytest.approx(9.289e-4, rel=1e-3)
    assert growth.wave == (2,) and growth.null_space_share > 0.05


SKEW = ("mapping.mass=consistent", "mapping.gradient=skew", *EXACT)
# cells, layout, particles per cell, cells moved per step, basis, seed
DISORDERED = [
    ([8], "random", [4], [0.25], "cubic", 0),
    ([8], "random", [4], [0.25], "cubic", 1),
    ([8], "random", [2], [0.25], "cubic", 1),  # Φ has a singular value of 3e-2 of the largest
    ([8], "jittered", [2], [0.2], "quadratic", 0),
    ([6], "random", [6], [0.5], "linear", 0),
    ([3, 3], "random", [3], [0.5, 0.5], "cubic", 0),
    ([4, 3], "jittered", [2, 1], [1.0, 0.5], "quadratic", 1),
    ([2, 2, 2], "random", [2], [0.5, 0.5, 0.5], "quadratic", 0),
    ([2, 2, 2], "jittered", [2, 1, 1], [1.0, 0.5, 0.5], "linear", 0),
]


def skew(case, integrator, cfl):
    cells, layout, per_cell, moves, basis, seed = case
    box = f"grid.length={[n / 8 for n in cells]}"
    return pattern(cells, layout, per_cell, [move / cfl for move in moves], cfl, f"mapping.basis={basis}", *SKEW, box,
                   f"particles.seed={seed}", f"time.integrator={integrator}", preset="paper")  # fmt: skip


@pytest.fixture
def tight_midpoint():
    """The midpoint rule's own solver to rounding: at the 1e-12 that it has, 1e-11 is left of a norm of 1."""
    options = PETSc.Options()
    options["midpoint_ksp_rtol"] = 1e-15
    yield
    del options["midpoint_ksp_rtol"]


def every(cases):
    return pytest.mark.parametrize("case", cases, ids=lambda case: f"{len(case[0])}D-{case[1]}-{case[4]}-{case[5]}")


@every(DISORDERED)
def test_the_skew_gradient_cannot_grow_on_disordered_particles_within_its_limit(case):
    cfl = 0.9 * cfl_limit(skew(case, "rk4", 0.2), COMM)
    growth = analyse(skew(case, "rk4", cfl), COMM, 100)
    assert growth.norm_bound <= 1e-12, "no step lengthens any vector of particle values"
    assert growth.growth_per_step <= 1e-12


@every([DISORDERED[1], DISORDERED[4], DISORDERED[6]])
def test_with_the_midpoint_rule_it_cannot_at_any_time_step(tight_midpoint, case):
    growth = analyse(skew(case, "midpoint", 1.5), COMM, 100)
    assert growth.norm_bound <= 1e-12
    assert growth.growth_per_step <= 1e-12


def test_a_norm_above_one_does_not_hide_that_the_direct_gradient_grows():
    made = pattern([8], "random", [4], [0.5], 0.5, "mapping.basis=cubic", "mapping.mass=consistent", *EXACT,
                   "time.integrator=rk4", preset="paper")  # fmt: skip
    growth = analyse(made, COMM, 100)
    assert growth.norm_bound > growth.growth_per_step > 1e-3


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


def test_a_map_holds_the_growth_of_a_point_in_the_row_of_its_x_and_the_column_of_its_y():
    axes = [MapAxis("gas.flow", (0.1, 0.2)), MapAxis("time.cfl", (0.3, 0.4))]
    growths = {(0.1, 0.3): 1.0, (0.1, 0.4): 2.0, (0.2, 0.3): None, (0.2, 0.4): 4.0}
    found = [MapPoint("local", *at, (0.1,), growth, 1, None, "") for at, growth in growths.items()]
    found.append(MapPoint("none", 0.2, 0.3, (0.1,), 5.0, 1, None, ""))
    maps = by_filter(axes, found)
    np.testing.assert_array_equal(maps["local"], [[1.0, 2.0], [np.nan, 4.0]])
    np.testing.assert_array_equal(maps["none"], [[np.nan, np.nan], [5.0, np.nan]])


def test_growth_and_its_bound_do_not_depend_on_the_gas():
    """In units of length and c, ρ / ρ₀ and u / c obey the same equations in any gas; M and its norm are of these."""
    found = []
    for speed, density in ((1.0, 1.0), (3.0, 0.5)):
        gas = {"sound_speed": speed, "density": density, "flow": [0.5 * speed]}
        made = scene(grid={"cells": [8]}, particles={"layout": "random", "per_cell": [2]}, gas=gas,
                     filter={"kind": "none"}, time={"cfl": 0.25})  # fmt: skip
        found.append(analyse(made, COMM, 100))
    assert found[0].norm_bound > found[0].growth_per_step > 1e-3
    for name in ("growth_per_step", "norm_bound"):
        assert getattr(found[1], name) == pytest.approx(getattr(found[0], name), rel=1e-9)


def test_predicted_steps_follow_from_the_growth():
    growth = analyse(scene(filter={"kind": "none"}, gas={"flow": [0.25]}, time={"cfl": 0.2}), COMM, 200)
    rate = math.log1p(growth.growth_per_step)
    assert growth.noise_step == pytest.approx(math.log(1e16) / rate)
    assert growth.blow_up_step == pytest.approx(math.log(1e18) / rate)
