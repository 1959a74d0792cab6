"""The loop over steps: what it reports and when, and how it ends."""

import h5py
import numpy as np
import pytest
from mpi4py import MPI

from dense_helpers import Dense, close
from mpipic.run.loop import Simulation
from mpipic.scene.records import SceneError
from run_helpers import Reports, run_scene, scene_of
from serial_helpers import by_id


def test_errors_are_reported_at_the_steps_asked_for_and_at_the_last():
    _, outcome, reports = run_scene(scene_of(time={"steps": 30}, output={"report_at": [0, 7, 20]}))
    assert outcome.status == "completed" and sorted(reports.errors) == [0, 7, 20, 30]
    assert [reports.errors[step].time for step in (0, 7)] == [0.0, pytest.approx(7 * 1.25e-3)]
    assert reports.steps == 30


def test_at_step_zero_the_particles_carry_the_exact_solution():
    for dim in (1, 2, 3):
        scene = scene_of(grid={"cells": [8] * dim}, time={"steps": 0})
        simulation, _, reports = run_scene(scene)
        assert [norms.linf for norms in reports.errors[0].errors.values()] == [0.0, 0.0]
        assert by_id(simulation.particles)[1].max() > 0.5


def test_snapshots_come_every_so_many_steps_from_the_first_on():
    _, _, reports = run_scene(scene_of(time={"steps": 25}, output={"every": 10}))
    assert reports.snapshots == [(0, 0.0), (10, pytest.approx(0.0125)), (20, pytest.approx(0.025))]
    assert not run_scene(scene_of(time={"steps": 25}))[2].snapshots


def test_the_largest_density_is_recorded_along_the_run_at_some_400_steps_at_most():
    _, _, reports = run_scene(scene_of(time={"steps": 1000}))
    assert 300 <= len(reports.peaks) <= 402 and {0, 1000} <= set(reports.peaks)
    assert reports.peaks[0] == pytest.approx(1.0, abs=0.01) and 0.3 < reports.peaks[1000] < 1.0


def test_time_is_the_step_times_dt_and_not_a_running_sum():
    simulation, _, _ = run_scene(scene_of(time={"dt": 0.1 / 3, "steps": 99, "blow_up": 1e300}))
    assert simulation.step == 99 and simulation.time == 99 * (0.1 / 3)


def test_a_run_goes_on_from_where_it_is():
    """Steps taken by two runs over one simulation are those of one run."""
    whole = by_id(run_scene(scene_of(time={"steps": 40}))[0].particles)
    simulation = Simulation(scene_of(time={"steps": 40}), MPI.COMM_SELF)
    looks = iter([False, True])
    outcome = simulation.run(Reports(), interrupted=lambda: next(looks, False))
    assert outcome.status == "interrupted" and 0 < outcome.step < 40
    outcome = simulation.run(Reports())
    assert (outcome.status, outcome.step) == ("completed", 40)
    for one, other in zip(by_id(simulation.particles), whole):
        assert np.array_equal(one, other)


def test_runs_repeat_to_the_bit():
    scene = scene_of(particles={"layout": "random", "per_cell": [4]}, time={"steps": 50})
    for one, other in zip(*(by_id(run_scene(scene)[0].particles) for _ in range(2))):
        assert np.array_equal(one, other)


UNSTABLE = {"filter": {"kind": "none"}, "time": {"dt": 0.02, "steps": 400, "blow_up": 50.0}}


def test_a_blow_up_is_dated_to_the_first_step_beyond_the_limit():
    simulation, outcome, _ = run_scene(scene_of(UNSTABLE))
    assert outcome.status == "unstable"
    again = Simulation(scene_of(UNSTABLE), MPI.COMM_SELF)
    assert again.limit == simulation.limit == pytest.approx(50.0, rel=0.01)
    for _ in range(outcome.step - 1):
        again.physics.step()
        assert np.abs(again.particles["density"]).max() <= again.limit
    again.physics.step()
    size = np.abs(again.particles["density"])
    assert size.max() > again.limit
    bad = outcome.blow_up
    assert (bad.step, bad.rank, bad.value) == (outcome.step, 0, size.max())
    assert bad.cell == tuple(map(int, again.particles.coordinate[np.argmax(size)]))


def test_a_density_that_is_no_number_ends_the_run():
    simulation = Simulation(scene_of(time={"steps": 50}), MPI.COMM_SELF)
    simulation.particles["velocity"][17] = np.nan
    simulation.physics.stepper.sweep.held_sums[:, 1] = np.nan
    outcome = simulation.run(Reports())
    assert outcome.status == "unstable" and outcome.step == 1 and not np.isfinite(outcome.blow_up.value)


def test_nodal_means_are_those_of_the_particles():
    scene = scene_of(grid={"cells": [5, 4]}, particles={"layout": "random", "per_cell": [1]}, time={"steps": 10})
    simulation, _, _ = run_scene(scene)
    position, density, velocity = by_id(simulation.particles)
    dense, means = Dense((5, 4), (1.0, 1.0), position), simulation.physics.nodal()
    close(means["density"], (dense.S @ density).reshape(5, 4))
    close(means["velocity"], (dense.S @ velocity).reshape(5, 4, 2))


def test_the_conserved_sums_are_the_mass_and_with_the_gas_s_density_the_momentum():
    scene = scene_of(
        grid={"cells": [5, 4]},
        particles={"layout": "random", "per_cell": [3]},
        gas={"density": 1.7},
        time={"steps": 10},
    )
    simulation, _, _ = run_scene(scene)
    _, density, velocity = by_id(simulation.particles)
    sums = simulation.conserved()
    close(sums["mass"], density.sum(), 1e-13)
    close(sums["momentum"], 1.7 * velocity.sum(axis=0), 1e-12)
    assert np.abs(sums["momentum"]).min() > 1e-3 and simulation.conserved_at_start["mass"] > 0.1


@pytest.mark.parametrize("layout, count", [("lattice", 8 * 4 * 6), ("jittered", 8 * 4 * 6), ("random", 8 * 4 * 3)])
def test_a_scene_has_the_particles_it_asks_for_in_the_box(layout, count):
    per_cell = [3] if layout == "random" else [3, 2]
    particles = {"layout": layout, "per_cell": per_cell, **({"jitter": 3.0} if layout == "jittered" else {})}
    grid = {"cells": [8, 4], "length": [1.0, 3.0]}
    simulation, _, _ = run_scene(scene_of(grid=grid, particles=particles, time={"steps": 0}))
    assert simulation.total == simulation.particles.count == simulation.scene.particle_count == count
    position = by_id(simulation.particles)[0]
    assert np.all((position >= 0) & (position < simulation.grid.length))


def test_a_file_gives_the_places_and_a_profile_the_density(tmp_path):
    position = np.random.default_rng(0).random((30, 1))
    with h5py.File(tmp_path / "p.h5", "w") as file:
        file["position"] = position
    scene = scene_of(particles={"layout": "file", "path": str(tmp_path / "p.h5")}, time={"steps": 0})
    simulation, _, reports = run_scene(scene)
    found = by_id(simulation.particles)
    close(found[0], position, 1e-14)
    assert reports.errors[0].errors["density"].linf == 0.0 and found[1].max() > 0.5


def test_a_file_that_cannot_be_used_is_a_mistake_of_the_scene(tmp_path):
    with h5py.File(tmp_path / "p.h5", "w") as file:
        file["position"] = np.array([[0.2], [np.nan]])
    scene = scene_of(particles={"layout": "file", "path": str(tmp_path / "p.h5")})
    with pytest.raises(SceneError, match=r"particles\.path.*nan"):
        Simulation(scene, MPI.COMM_SELF)


@pytest.mark.parametrize("key", ["density", "velocity"])
def test_a_file_may_give_one_field_and_the_limit_still_has_a_scale(tmp_path, key):
    """Where density starts at zero, the limit comes from the velocity that will turn into it."""
    position = (np.arange(64)[:, None] + 0.5) / 64
    wave = np.sin(2 * np.pi * position) * 0.01
    with h5py.File(tmp_path / "p.h5", "w") as file:
        file["position"], file[key] = position, wave if key == "velocity" else wave[:, 0]
    scene = scene_of(
        grid={"cells": [32]},
        particles={"layout": "file", "path": str(tmp_path / "p.h5")},
        gas={"sound_speed": 2.0, "density": 6.0},
        initial={"profile": "file"},
        time={"cfl": 0.1, "steps": 100},
    )
    simulation, outcome, reports = run_scene(scene)
    assert outcome.status == "completed" and not reports.errors
    size = 0.01 * (6.0 / 2.0 if key == "velocity" else 1.0)
    assert simulation.limit == pytest.approx(100 * size, rel=0.01)
    assert 0.3 * size < max(reports.peaks.values()) < 1.1 * size
