"""Errors of the schemes of high order against exact solutions: what they are, and how fast they fall.

Density errors are root mean squares over the particles, of a pulse or wave of height 1. The pulse is exp(-60 |x - ½|²)
on a lattice of three particles a cell, with flow 0.1 and CFL 0.2, at t = 1.
"""

from functools import cache
from statistics import linear_regression

import numpy as np
import pytest

from covering_helpers import covering
from helpers import ROOT
from mpipic.scene.records import Scene
from run_helpers import error_of, orders, run_scene, scene_of

TIGHT = {"tolerance": 1e-12}


def ending_at(end, cfl, cells, **sections):
    """A scene that ends there, with the time step nearest to the CFL number; sound speed 1, boxes of size 1."""
    steps = round(end * max(cells) / cfl)
    time = sections.pop("time") | {"dt": end / steps, "steps": steps}
    return scene_of(grid={"cells": list(cells)}, time=time, **sections)


# ---------------------------------------------------------------- the pulse in 1D

SCHEMES = {
    "linear lumped local symplectic": {"mapping": {}, "filter": {"kind": "local"}},
    "linear lumped exact symplectic": {"mapping": {}, "filter": {"kind": "exact", **TIGHT}},
    "quadratic consistent exact rk4": {"mapping": {"basis": "quadratic", "mass": "consistent", **TIGHT}},
    "cubic consistent exact rk4": {"mapping": {"basis": "cubic", "mass": "consistent", **TIGHT}},
}
ERRORS = {
    "linear lumped local symplectic": {32: 1.2e-1, 64: 2.3e-2, 128: 2.0e-3},
    "linear lumped exact symplectic": {32: 6.1e-2, 64: 7.3e-3, 128: 5.7e-4},
    "quadratic consistent exact rk4": {32: 8.4e-4, 64: 2.2e-5, 128: 1.9e-7},
    "cubic consistent exact rk4": {32: 8.8e-5, 64: 1.9e-6, 128: 6.3e-9},
}
"""Scheme to cells to error, measured once."""
ORDERS = {"linear lumped local symplectic": 2, "linear lumped exact symplectic": 2}
ORDERS |= {"quadratic consistent exact rk4": 4, "cubic consistent exact rk4": 6}


@cache
def pulse_error(name, cells):
    parts = {"filter": {"kind": "exact", **TIGHT}, **SCHEMES[name], "time": {"integrator": name.split()[-1]}}
    return error_of(ending_at(1.0, 0.2, (cells,), particles={"per_cell": [3]}, gas={"flow": [0.1]}, **parts))


@pytest.mark.parametrize("name, cells", [(name, cells) for name, errors in ERRORS.items() for cells in errors])
def test_the_pulse_s_error_is_what_it_was_measured_to_be(name, cells):
    assert pulse_error(name, cells) == pytest.approx(ERRORS[name][cells], rel=0.1)


@pytest.mark.parametrize("name", SCHEMES)
def test_errors_fall_at_the_order_of_the_scheme_or_faster(name):
    """The slope over four levels, and the last step of it, which is free of what coarse grids fail to resolve."""
    levels = (32, 48, 64, 128)
    errors = [pulse_error(name, cells) for cells in levels]
    assert np.all(np.diff(errors) < 0)
    slope = -linear_regression(np.log(levels), np.log(errors)).slope
    assert slope >= ORDERS[name] and orders(errors)[-1] >= ORDERS[name]
    assert errors[-1] <= 1.1 * ERRORS[name][128]


def test_at_equal_cells_every_step_up_in_the_scheme_is_a_gain():
    for cells, gain in ((32, 1.9), (64, 3.0), (128, 3.0)):
        errors = [pulse_error(name, cells) for name in SCHEMES]
        assert np.all(np.array(errors[:-1]) > gain * np.array(errors[1:]))


# ---------------------------------------------------------------- particles at random

RANDOM = {
    "recommended": ({}, {1: 1.5e-3, 2: 3.5e-4, 4: 2.5e-4}),
    "waves damped": (
        {"mapping.penalty": 0.1, "damping.null_space": 0, "damping.order": 4, "damping.strength": 1},
        {1: 5e-4, 2: 1e-4, 4: 1e-4},
    ),
}
"""Changes to the recommended scheme, and particles a cell, on average, to the error that it stays below."""


def random_pulse(per_cell, seed, preset, changes=()):
    """48 cells, CFL 0.2, until t = 1."""
    keys = {"grid.cells": [48], "gas.flow": [0.1], "time.dt": 1 / 240, "time.steps": 240, **dict(changes)}
    keys |= {"particles.layout": "random", "particles.per_cell": [per_cell], "particles.seed": seed}
    return Scene.load(None, [f"{key}={value}" for key, value in keys.items()], preset)


@pytest.mark.parametrize("name, per_cell, seed", covering(2, RANDOM, (1, 2, 4), (0, 1, 2)))
def test_on_random_particles_penalised_splines_are_accurate(name, per_cell, seed):
    changes, errors = RANDOM[name]
    assert error_of(random_pulse(per_cell, seed, "recommended", changes.items())) < errors[per_cell]


@pytest.mark.parametrize("per_cell", [1, 2, 4])
def test_on_random_particles_the_recommended_scheme_is_a_hundred_times_as_accurate_as_the_paper_s(per_cell):
    error = error_of(random_pulse(per_cell, 0, "recommended"))
    scene = random_pulse(per_cell, 0, "paper")
    _, outcome, reports = run_scene(scene)
    assert outcome.status == "unstable" or reports.errors[scene.time.steps].errors["density"].l2 > 100 * error


def test_the_recommended_configuration_does_what_it_says():
    path = ROOT / "configs" / "recommended.toml"
    assert "l2 error of the density below 2e-6 at t = 1" in path.read_text()
    scene = Scene.load(path)
    assert scene.duration == pytest.approx(1.0) and error_of(scene) < 2e-6
    paper = Scene.load(path, preset="paper")
    _, outcome, _ = run_scene(paper)
    assert outcome.status == "unstable" and outcome.step * paper.dt == pytest.approx(0.3, abs=0.05)


# ---------------------------------------------------------------- differences on the nodes


@pytest.mark.parametrize("order, error", {4: 6.2e-3, 6: 2.4e-4, 8: 6.0e-5, 10: 5.5e-5}.items())
def test_a_standing_wave_s_error_falls_with_the_order_of_the_differences(order, error):
    """Two axes, 16 cells each, until what is left is the time step's."""
    scene = ending_at(
        2.0, 0.2, (16, 16),
        gas={"flow": [0.13, 0.07]}, initial={"profile": "standing-wave"}, filter={"kind": "exact"},
        mapping={"basis": "cubic", "mass": "consistent", "gradient": "grid", "gradient_order": order, **TIGHT},
        damping={"order": 4, "strength": 1.0}, time={"integrator": "rk4"},
    )  # fmt: skip
    assert error_of(scene) == pytest.approx(error, rel=0.1)


# ---------------------------------------------------------------- long time steps


def midpoint(steps, time, flow, layout="lattice"):
    return scene_of(
        grid={"cells": [512]},
        particles={"layout": layout, "per_cell": [2]},
        gas={"flow": [flow]},
        initial={"profile": "plane-wave"},
        mapping={"basis": "cubic", "mass": "penalised", "gradient": "grid"},
        filter={"kind": "exact"},
        time={"dt": time / steps, "steps": steps, "integrator": "midpoint"},
    )


def test_the_midpoint_rule_is_of_second_order_at_cfl_numbers_from_50_down():
    """A wave of one period after 1.25 of them: its error is that of the phase, ω³ dt² t / 12 in radians."""
    scenes = [midpoint(13 * 2**level, 1.25, 0.05) for level in range(4)]
    assert [round(scene.cfl) for scene in scenes] == [49, 25, 12, 6]
    errors = [error_of(scene) for scene in scenes]
    assert np.all(np.abs(orders(errors) - 2.0) < (0.1, 0.05, 0.02))
    phase = (2 * np.pi) ** 3 * scenes[-1].dt ** 2 / 12 * 1.25
    assert errors[-1] == pytest.approx(phase * np.sqrt(0.5), rel=0.01)


def test_at_cfl_50_and_sound_ten_thousand_times_as_fast_as_the_flow_nothing_grows():
    """On random particles: two hundred steps, in which the flow takes them one cell far."""
    scene = midpoint(200, 200 * 50 / 512, 1e-4, layout="random")
    assert scene.cfl == pytest.approx(50.0)
    simulation, outcome, reports = run_scene(scene)
    assert outcome.status == "completed" and max(reports.peaks.values()) < 1.001
    energy = np.mean(np.sum(simulation.particles.state**2, axis=1))
    assert energy == pytest.approx(0.5, rel=0.05), "nor does it fade: density and velocity take turns"
