"""What runs keep: sums, uniform states, particles; and what flow does and does not do."""

import numpy as np
import pytest

from dense_helpers import close
from run_helpers import run_scene, scene_of
from serial_helpers import SETTINGS, by_id

BOXES = {1: [32], 2: [12, 10], 3: [6, 5, 4]}
every_dimension = pytest.mark.parametrize("dim", [1, 2, 3])
every_kind = pytest.mark.parametrize("kind", ["none", "local", "exact"])


def scene(dim, kind="local", flow=(0.3, -0.2, 0.1), layout="lattice", steps=100, **sections):
    per_cell = [2**dim] if layout == "random" else [2] * dim
    return scene_of(
        grid={"cells": BOXES[dim]},
        particles={"layout": layout, "per_cell": per_cell},
        gas={"flow": list(flow[:dim])},
        initial={"sharpness": 20.0},
        filter={"kind": kind, **SETTINGS.get(kind, {})},
        time={"cfl": 0.1, "steps": steps},
        **sections,
    )


@every_dimension
@every_kind
def test_mass_and_momentum_are_kept_on_a_lattice(dim, kind):
    simulation, _, _ = run_scene(scene(dim, kind, steps=0))
    before = by_id(simulation.particles)[1].sum()
    simulation, _, _ = run_scene(scene(dim, kind))
    _, density, velocity = by_id(simulation.particles)
    assert density.sum() == pytest.approx(before, rel=1e-11)
    assert np.abs(velocity.sum(axis=0)).max() < 1e-11 * np.abs(velocity).sum()


@every_dimension
@every_kind
@pytest.mark.parametrize("layout", ["lattice", "random"])
def test_particles_go_with_the_flow_and_none_is_lost(dim, kind, layout):
    start = by_id(run_scene(scene(dim, kind, layout=layout, steps=0))[0].particles)[0]
    simulation, outcome, _ = run_scene(scene(dim, kind, layout=layout))
    length, flow = np.array(simulation.grid.length), np.array(simulation.scene.gas.flow)
    assert outcome.status == "completed" and simulation.particles.count == simulation.total == len(start)
    moved = by_id(simulation.particles)[0] - start - flow * simulation.time
    assert np.abs(flow * simulation.time).min() > 0.02
    close(moved / length, np.rint(moved / length), 1e-12, scale=1.0)


@every_dimension
@every_kind
def test_without_flow_no_particle_moves_and_the_wave_still_travels(dim, kind):
    start = by_id(run_scene(scene(dim, kind, flow=(0.0,) * 3, steps=0))[0].particles)
    simulation, _, reports = run_scene(scene(dim, kind, flow=(0.0,) * 3))
    end = by_id(simulation.particles)
    assert np.array_equal(end[0], start[0]) and simulation.physics.facts()["sorts"] == 1
    assert np.abs(end[1] - start[1]).max() > 0.3
    assert reports.errors[100].errors["density"].l2 < (0.03, 0.2, 0.2)[dim - 1]


@every_dimension
def test_a_flow_of_whole_cells_a_step_is_no_flow_at_all(dim):
    """On a periodic grid the particles then only change cells."""
    still = by_id(run_scene(scene(dim, flow=(0.0,) * 3))[0].particles)
    h = 1.0 / np.array(BOXES[dim])
    dt = 0.1 * h.min()
    moving = by_id(run_scene(scene(dim, flow=tuple(h / dt * [1, -2, 3][:dim])))[0].particles)
    close(moving[1], still[1], 1e-11)
    close(moving[2], still[2], 1e-11)


@every_dimension
def test_the_energy_hardly_changes_in_a_short_run(dim):
    """c² ρ² + ρ₀² u² over the particles, c = ρ₀ = 1; it swings a little, because ρ and u are half a step apart."""
    energies = []
    for steps in (0, 20, 50, 100):
        _, density, velocity = by_id(run_scene(scene(dim, steps=steps))[0].particles)
        energies.append((density**2).sum() + (velocity**2).sum())
    assert np.ptp(energies) < 0.05 * energies[0]
    assert (velocity**2).sum() > 0.2 * energies[0]
