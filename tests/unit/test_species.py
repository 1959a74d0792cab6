"""Particle species of openPMD files, of this program and of others, as particles of a scene."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest
from mpi4py import MPI

from damage_helpers import put, put_constant, write_openpmd
from mpipic.console import Console
from mpipic.io.apart import Apart
from mpipic.io.particle_file import Box, ParticleFileError, ParticleRows, Request, read_particle_file
from mpipic.run.loop import Simulation
from mpipic.run.verb import run
from mpipic.scene.records import Scene

FIELDS = {"density": (), "velocity": (2,)}
STYLES = ("offsets", "constants", "texts")


@pytest.fixture(scope="module")
def process() -> Iterator[Apart]:
    with Apart() as one:
        yield one


def read(path: Path, process: Apart, fields: dict = FIELDS, dim: int = 2, **more: object) -> ParticleRows:
    request = Request(str(path), dim, fields, **more)
    return read_particle_file(request, Box((1.0,) * dim, (0.01,) * dim), MPI.COMM_SELF, process)


def refusal(path: Path, process: Apart, **more: object) -> str:
    with pytest.raises(ParticleFileError) as caught:
        read(path, process, **more)
    (problem,) = caught.value.problems
    return problem


def component(species: h5py.Group, name: str) -> np.ndarray:
    """A component in SI, straight from the standard: number or constant, times unitSI."""
    item = species[name]
    if isinstance(item, h5py.Dataset):
        return item[:].astype(float) * item.attrs["unitSI"]
    return np.full(int(item.attrs["shape"][0]), item.attrs["value"] * item.attrs["unitSI"])


@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("iteration", [None, 0, 100])
def test_species_of_other_codes_come_in_si(tmp_path: Path, process: Apart, style: str, iteration: int | None) -> None:
    path = tmp_path / "data.h5"
    write_openpmd(path, style)
    rows = read(path, process, iteration=iteration)
    with h5py.File(path) as file:
        species = file[f"data/{100 if iteration is None else iteration}/particles/e"]
        position = [component(species, f"position/{a}") + component(species, f"positionOffset/{a}") for a in "xy"]
        velocity = [component(species, f"velocity/{a}") for a in "xy"]
        np.testing.assert_array_equal(rows.position, np.stack(position, axis=1))
        np.testing.assert_array_equal(rows.fields["velocity"], np.stack(velocity, axis=1))
        np.testing.assert_array_equal(rows.fields["density"], component(species, "density"))
        np.testing.assert_array_equal(rows.ids, species["id"][:])
    assert np.ptp(rows.position) > 0.0 and rows.position.dtype == np.float64


def test_what_there_is_to_choose_is_named(tmp_path: Path, process: Apart) -> None:
    path = tmp_path / "data.h5"
    write_openpmd(path, "texts")
    assert "has no iteration 7; it has 0 and 100" in refusal(path, process, iteration=7)
    with h5py.File(path, "a") as file:
        file.copy("data/100/particles/e", "data/100/particles/ions")
        file["data/100/particles/ions/density"][:] = 2.0
    assert "e and ions" in refusal(path, process)
    assert 'Did you mean "ions"?' in refusal(path, process, species="ion")
    assert set(read(path, process, species="ions").fields["density"]) == {2.0}
    words = refusal(path, process, dim=1, fields={}, species="e")
    assert 'name those to take, as in particles.axes = ["x"]' in words
    take = {"axes": ("y",), "records": {"density": "velocity/x"}}
    rows = read(path, process, dim=1, fields={"density": ()}, species="e", **take)
    whole = read(path, process, species="e")
    np.testing.assert_array_equal(rows.position[:, 0], whole.position[:, 1])
    np.testing.assert_array_equal(rows.fields["density"], whole.fields["velocity"][:, 0])
    swapped = read(path, process, species="e", axes=("y", "x"))
    np.testing.assert_array_equal(swapped.position, whole.position[:, ::-1])
    np.testing.assert_array_equal(swapped.fields["velocity"], whole.fields["velocity"][:, ::-1])


def test_a_series_of_files_is_found_from_any_of_them(tmp_path: Path, process: Apart) -> None:
    for iteration in (0, 100):
        path = tmp_path / f"data{iteration:04d}.h5"
        write_openpmd(path, "constants")
        with h5py.File(path, "a") as file:
            file.attrs["iterationEncoding"] = np.bytes_("fileBased")
            file.attrs["iterationFormat"] = np.bytes_("data%04T.h5")
            del file[f"data/{100 - iteration}"]
    first, last = tmp_path / "data0000.h5", tmp_path / "data0100.h5"
    np.testing.assert_array_equal(read(first, process, iteration=100).position, read(last, process).position)
    assert "data0005.h5 of its series is not there" in refusal(first, process, iteration=5)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda e: e["position/x"].attrs.__delitem__("unitSI"), "position/x has no attribute unitSI"),
        (lambda e: e["position/x"].attrs.__setitem__("unitSI", 0.0), "position/x has unitSI = 0"),
        (lambda e: e["position/x"].attrs.__setitem__("unitSI", np.nan), "unitSI must be a finite number"),
        (lambda e: e["position/x"].attrs.__setitem__("unitSI", "one"), "unitSI must be a finite number"),
        (lambda e: e["positionOffset"].__delitem__("y"), "positionOffset has the components x, and needs y"),
        (lambda e: e["velocity"].__delitem__("y"), "velocity has the components x, and needs y"),
        (lambda e: e.__delitem__("position"), "position is missing"),
        (lambda e: e["density"].attrs.__setitem__("shape", np.array([7], "u8")), "density has 7 rows, expected (60,)"),
        (lambda e: e["density"].attrs.__setitem__("shape", -1.5), "has shape = -1.5, expected a whole number"),
        (lambda e: e["density"].attrs.__delitem__("value"), "density"),
    ],
)
def test_what_breaks_the_standard_is_named(tmp_path: Path, process: Apart, spoil: object, words: str) -> None:
    path = tmp_path / "data.h5"
    write_openpmd(path, "constants")
    with h5py.File(path, "a") as file:
        spoil(file["data/100/particles/e"])
    with pytest.raises(ParticleFileError) as caught:
        read(path, process)
    assert all(text.startswith(str(path)) for text in caught.value.problems)
    assert any(words in text for text in caught.value.problems), caught.value.problems


def test_a_scalar_a_constant_and_units_are_what_they_say(tmp_path: Path, process: Apart) -> None:
    path = tmp_path / "data.h5"
    with h5py.File(path, "w") as file:
        file.attrs.update({"openPMD": "1.1.0", "basePath": "/data/%T/", "particlesPath": "p/"})
        species = file.create_group("data/3/p/gas")
        put(species, "position/x", np.array([0.25, 0.5], "f4"), 2.0)
        put_constant(species, "density", 3.0, 2, unit=0.5)
    rows = read(path, process, dim=1, fields={"density": ()})
    assert rows.position.tolist() == [[0.5], [1.0]] and rows.fields["density"].tolist() == [1.5, 1.5]
    assert rows.ids.tolist() == [0, 1], "without ids, rows are numbered"


@pytest.mark.parametrize("cells", [[40], [6, 5], [4, 3, 5]])
def test_a_run_goes_on_from_its_own_snapshot_to_the_last_bit(tmp_path: Path, cells: list[int]) -> None:
    d = len(cells)
    table = {
        "grid": {"cells": cells, "length": [1.0] * d},
        "particles": {"per_cell": [2] * d, "layout": "jittered", "seed": 4},
        "gas": {"flow": [0.13] * d},
        "time": {"steps": 6, "cfl": 0.2},
        "output": {"every": 3},
    }
    scene = Scene.from_dict(table)
    assert run(scene, MPI.COMM_SELF, tmp_path / "out", False, Console(MPI.COMM_SELF, quiet=True), False) == 0
    straight = Simulation(scene, MPI.COMM_SELF)
    for _ in range(3):
        straight.physics.step()
    table["particles"] = {"layout": "file", "path": str(tmp_path / "out" / "particles.h5"), "iteration": 3}
    table["initial"] = {"profile": "file"}
    again = Simulation(Scene.from_dict(table), MPI.COMM_SELF).particles
    order, back = np.argsort(straight.particles.ids), np.argsort(again.ids)
    for name in ("density", "velocity"):
        np.testing.assert_array_equal(again[name][back], straight.particles[name][order])
    np.testing.assert_array_equal(again.position[back], straight.particles.position[order])


@pytest.mark.parametrize("box", [([1000], [2e-5]), ([96, 7], [35.8569, 3.14159])])
def test_positions_of_a_snapshot_come_back_to_the_last_bit_in_any_box(tmp_path: Path, box: tuple[list, list]) -> None:
    table = {"grid": {"cells": box[0], "length": box[1]}, "particles": {"layout": "random", "per_cell": [20]}}
    drawn = Simulation(Scene.from_dict(table), MPI.COMM_SELF).particles
    with h5py.File(tmp_path / "p.h5", "w") as file:
        file["position"], file["id"] = drawn.position, drawn.ids
    table["particles"] = {"layout": "file", "path": str(tmp_path / "p.h5")}
    again = Simulation(Scene.from_dict(table), MPI.COMM_SELF).particles
    order, back = np.argsort(drawn.ids), np.argsort(again.ids)
    assert np.array_equal(again.position[back], drawn.position[order])


def test_writing_snapshots_counts_as_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nodal means are made before, in phases of their own."""
    monkeypatch.setattr("mpipic.io.snapshots.ParticleSeries.write", lambda *a: time.sleep(0.05))
    scene = Scene.from_dict({"grid": {"cells": [8]}, "time": {"steps": 2}, "output": {"every": 1}})
    assert run(scene, MPI.COMM_SELF, tmp_path / "out", False, Console(MPI.COMM_SELF, quiet=True), False) == 0
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["seconds"]["phases"]["output"] >= 0.15
