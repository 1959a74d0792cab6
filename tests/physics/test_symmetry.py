"""Axes are alike: rows of a plane scene are the scene in 1D, and exchanged or mirrored axes do that to the results."""

import h5py
import numpy as np
import pytest

from dense_helpers import close, pattern, run_euler
from run_helpers import run_scene, scene_of
from serial_helpers import SETTINGS, by_id

every_kind = pytest.mark.parametrize("kind", ["none", "local", "exact"])


def final_state(scene):
    simulation, outcome, _ = run_scene(scene)
    assert outcome.status == "completed"
    return by_id(simulation.particles)


@every_kind
@pytest.mark.parametrize("dim, across", [(2, 0.0), (2, 0.4), (3, -0.3)])
def test_every_row_of_plane_data_along_x_is_the_scene_in_1d(kind, dim, across):
    """Also when the flow carries the rows across the grid."""

    def scene(d, cells, per_cell, length):
        return scene_of(
            grid={"cells": cells, "length": length},
            particles={"per_cell": per_cell},
            gas={"flow": [0.05, across, -across][:d], "density": 1.5, "sound_speed": 1.2},
            initial={"profile": "plane-gaussian", "wave": [1, 0, 0][:d]},
            filter={"kind": kind, **SETTINGS.get(kind, {})},
            time={"dt": 2e-3, "steps": 120},
        )

    _, line_density, line_velocity = final_state(scene(1, [32], [2], [1.0]))
    _, density, velocity = final_state(scene(dim, [32, 3, 4][:dim], [2, 2, 1][:dim], [1.0, 0.1, 0.2][:dim]))
    rows = density.reshape(-1, 64)
    assert len(rows) == (6 if dim == 2 else 24)
    assert np.abs(line_velocity).max() > 0.05 and line_density.max() < 0.9
    close(rows, np.broadcast_to(line_density, rows.shape), 1e-11)
    close(velocity[:, 0].reshape(-1, 64), np.broadcast_to(line_velocity[:, 0], rows.shape), 1e-11)
    close(velocity[:, 1:], np.zeros_like(velocity[:, 1:]), 1e-11, scale=1.0)


CELLS, LENGTH, VELOCITY = np.array([4, 3, 5]), np.array([1.0, 1.5, 2.5]), np.array([0.9, -0.4, 0.3])


def file_scene(path, kind, cells, length, flow, position, density, velocity, steps=40):
    with h5py.File(path, "w") as file:
        file["position"], file["density"], file["velocity"] = position, density, velocity
    return scene_of(
        grid={"cells": list(map(int, cells)), "length": list(map(float, length))},
        particles={"layout": "file", "path": str(path)},
        gas={"flow": list(map(float, flow)), "density": 1.7, "sound_speed": 1.3},
        initial={"profile": "file"},
        filter={"kind": kind, **SETTINGS.get(kind, {})},
        time={"dt": 0.03, "steps": steps},
    )


def random_case(dim, name="random"):
    cells, length = CELLS[:dim], LENGTH[:dim]
    position = pattern(name, cells, length)
    rng = np.random.default_rng(6)
    density, velocity = rng.standard_normal(len(position)), rng.standard_normal(position.shape)
    return cells, length, VELOCITY[:dim], position, density, velocity


@every_kind
@pytest.mark.parametrize("order", [(1, 0), (1, 2, 0), (0, 2, 1), (2, 1, 0)])
def test_exchanged_axes_exchange_the_results(tmp_path, kind, order):
    order = list(order)
    cells, length, flow, position, density, velocity = random_case(len(order))
    plain = final_state(file_scene(tmp_path / "a.h5", kind, cells, length, flow, position, density, velocity))
    turned = final_state(
        file_scene(
            tmp_path / "b.h5", kind, cells[order], length[order], flow[order],
            position[:, order], density, velocity[:, order],
        )
    )  # fmt: skip
    close(turned[0], plain[0][:, order], 1e-13)
    close(turned[1], plain[1], 1e-11)
    close(turned[2], plain[2][:, order], 1e-11)
    assert not np.allclose(plain[1], density)


@every_kind
@pytest.mark.parametrize("dim", [1, 2, 3])
def test_a_mirrored_scene_gives_mirrored_results(tmp_path, kind, dim):
    """The last axis is turned round; no particle is on a node, where left and right differ."""
    cells, length, flow, position, density, velocity = random_case(dim)
    turn = np.where(np.arange(dim) == dim - 1, -1.0, 1.0)
    plain = final_state(file_scene(tmp_path / "a.h5", kind, cells, length, flow, position, density, velocity))
    mirrored = final_state(
        file_scene(
            tmp_path / "b.h5", kind, cells, length, flow * turn,
            np.mod(position * turn, length), density, velocity * turn,
        )
    )  # fmt: skip
    close(mirrored[0], np.mod(plain[0] * turn, length), 1e-13)
    close(mirrored[1], plain[1], 1e-11)
    close(mirrored[2], plain[2] * turn, 1e-11)


@every_kind
@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("name", ["random", "jittered"])
def test_a_run_from_a_file_is_the_dense_run_from_its_particles(tmp_path, kind, dim, name):
    """Position, density and velocity are the file's, row i is id i, and all constants of the scene take their place."""
    cells, length, flow, position, density, velocity = random_case(dim, name)
    scene = file_scene(tmp_path / "p.h5", kind, cells, length, flow, position, density, velocity)
    wanted = run_euler(
        cells, length, position, density, velocity, flow * 0.03, (0.03 * 1.7, 0.03 * 1.3**2 / 1.7), kind, 40
    )
    for found, expected in zip(final_state(scene), wanted):
        close(found, expected, 1e-11)


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_a_run_of_no_steps_from_a_file_is_the_file(tmp_path, dim):
    case = random_case(dim, "few")
    state = final_state(file_scene(tmp_path / "p.h5", "local", *case, steps=0))
    for found, given in zip(state, case[3:]):
        assert np.array_equal(found, given)
