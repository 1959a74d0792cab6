"""Claims about particle snapshots: the openPMD layout, and a file that holds whole snapshots only."""

from __future__ import annotations

import errno
import os
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
from mpi4py import MPI

from mpipic.errors import OutputError, WriteFailed
from mpipic.io import openpmd
from mpipic.io.snapshots import ParticleSeries

COMM = MPI.COMM_SELF
SCENE = SimpleNamespace(name="wave", to_toml=lambda: "[grid]\ncells = [4]\n")


def particles(dim: int, n: int = 6) -> SimpleNamespace:
    x = np.linspace(0.05, 0.9, n * dim).reshape(n, dim)
    fields = {"density": np.arange(n, dtype=float), "velocity": np.cos(x), "stress": np.arange(4.0 * n).reshape(n, 4)}
    return SimpleNamespace(ids=np.arange(n)[::-1].copy(), position=x, fields=fields)


def grid(dim: int) -> SimpleNamespace:
    cells = (4, 3, 2)[:dim]
    return SimpleNamespace(
        cells=cells, length=(1.0, 3.0, 4.0)[:dim], owned_start=(0,) * dim, owned_shape=cells, comm=COMM
    )


def write(path: Path, dim: int = 1, n: int = 6, steps: tuple[int, ...] = (0, 5)) -> Path:
    cells = grid(dim)
    nodal = {"density": np.ones(cells.cells), "velocity": np.ones((*cells.cells, dim)), "weight": np.ones(cells.cells)}
    with ParticleSeries(path, COMM, SCENE) as series:
        for step in steps:
            series.write(step, 0.1 * step, 0.1, particles(dim, n), cells, nodal)
    return path


def test_root_attributes_are_those_of_openpmd_1_1(tmp_path: Path) -> None:
    with h5py.File(write(tmp_path / "p.h5"), "r") as file:
        a = file.attrs
        assert (a["openPMD"], a["openPMDextension"], a["basePath"]) == (b"1.1.0", 0, b"/data/%T/")
        assert a["openPMDextension"].dtype == np.uint32
        assert (a["meshesPath"], a["particlesPath"]) == (b"fields/", b"particles/")
        assert (a["iterationEncoding"], a["iterationFormat"]) == (b"groupBased", b"/data/%T/")
        assert a["software"] == b"mpipic" and a["softwareVersion"] and a["author"]
        assert re.fullmatch(rb"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d [+-]\d{4}", a["date"])
        assert a["comment"] == b"wave\n[grid]\ncells = [4]"


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_every_record_and_component_has_its_units(tmp_path: Path, dim: int) -> None:
    length = [1, 0, 0, 0, 0, 0, 0]
    dimensions = {"position": length, "positionOffset": length}
    dimensions |= {"density": [-3, 1, 0, 0, 0, 0, 0], "velocity": [1, 0, -1, 0, 0, 0, 0]}
    with h5py.File(write(tmp_path / "p.h5", dim), "r") as file:
        snapshot = file["data/5"]
        assert (snapshot.attrs["time"], snapshot.attrs["dt"], snapshot.attrs["timeUnitSI"]) == (0.5, 0.1, 1.0)
        assert snapshot.attrs["closed"] == 1
        gas = snapshot["particles/gas"]
        assert set(gas) == {"id", "position", "positionOffset", "density", "velocity", "stress", "particlePatches"}
        records = {**{n: r for n, r in gas.items() if n != "particlePatches"}, **snapshot["fields"]}
        for name, record in records.items():
            assert list(record.attrs["unitDimension"]) == dimensions.get(name, [0.0] * 7)
            assert record.attrs["unitDimension"].dtype == np.float64 and record.attrs["timeOffset"] == 0.0
            components = [record] if isinstance(record, h5py.Dataset) else list(record.values())
            assert all(component.attrs["unitSI"] == 1.0 for component in components)
        assert set(gas["position"]) == set(gas["velocity"]) == set("xyz"[:dim])
        assert set(gas["stress"]) == (set("0123"))
        for component in gas["positionOffset"].values():
            assert component.attrs["value"] == 0.0 and list(component.attrs["shape"]) == [6]
        assert gas["id"].dtype == np.int64 and isinstance(gas["density"], h5py.Dataset)


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_a_tensor_has_a_component_for_each_pair_of_axes(tmp_path: Path, dim: int) -> None:
    some = particles(dim)
    some.fields = {"F": np.arange(6.0 * dim * dim).reshape(6, dim, dim), "pairs": np.arange(36.0).reshape(6, 3, 2)}
    with ParticleSeries(tmp_path / "p.h5", COMM) as series:
        series.write(0, 0.0, 0.1, some, grid(dim), {})
    with h5py.File(tmp_path / "p.h5", "r") as file:
        gas = file["data/0/particles/gas"]
        axes = "xyz"[:dim]
        assert set(gas["F"]) == {a + b for a in axes for b in axes}
        assert set(gas["pairs"]) == {f"{i}_{j}" for i in range(3) for j in range(2)}
        for i, j in np.ndindex(dim, dim):
            assert np.array_equal(gas[f"F/{axes[i]}{axes[j]}"][:], some.fields["F"][:, i, j])
        assert np.array_equal(gas["pairs/2_1"][:], some.fields["pairs"][:, 2, 1])


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_meshes_describe_the_grid(tmp_path: Path, dim: int) -> None:
    with h5py.File(write(tmp_path / "p.h5", dim), "r") as file:
        for name in ("density", "velocity", "weight"):
            mesh = file["data/0/fields"][name]
            assert (mesh.attrs["geometry"], mesh.attrs["dataOrder"]) == (b"cartesian", b"C")
            assert list(mesh.attrs["axisLabels"]) == [b"x", b"y", b"z"][:dim]
            assert list(mesh.attrs["gridSpacing"]) == [0.25, 1.0, 2.0][:dim]
            assert list(mesh.attrs["gridGlobalOffset"]) == [0.0] * dim and mesh.attrs["gridUnitSI"] == 1.0
            for component in [mesh] if name != "velocity" else mesh.values():
                assert component.shape == (4, 3, 2)[:dim]
                assert list(component.attrs["position"]) == [0.0] * dim


def test_the_patch_of_one_rank_holds_every_particle(tmp_path: Path) -> None:
    with h5py.File(write(tmp_path / "p.h5", 2), "r") as file:
        gas = file["data/0/particles/gas"]
        patches = gas["particlePatches"]
        assert list(patches["numParticles"]) == [6] and list(patches["numParticlesOffset"]) == [0]
        assert patches["numParticles"].dtype == patches["numParticlesOffset"].dtype == np.uint64
        for axis in "xy":
            low, x = patches[f"offset/{axis}"][0], gas[f"position/{axis}"][:]
            assert low == x.min() and 0 < low + patches[f"extent/{axis}"][0] - x.max() < 1e-15
            assert patches[f"offset/{axis}"].attrs["unitSI"] == 1.0


@pytest.mark.parametrize("dim", [1, 3])
def test_no_particles_at_all_is_a_snapshot_too(tmp_path: Path, dim: int) -> None:
    with h5py.File(write(tmp_path / "p.h5", dim, n=0), "r") as file:
        gas = file["data/5/particles/gas"]
        assert gas["density"].shape == gas["position/x"].shape == (0,)
        assert list(gas["particlePatches/numParticles"]) == [0]


def test_the_series_has_its_name_only_when_closed(tmp_path: Path) -> None:
    series = ParticleSeries(tmp_path / "p.h5", COMM)
    series.write(0, 0.0, 0.1, particles(1), grid(1), {})
    assert [path.name for path in tmp_path.iterdir()] == ["p.h5.part"]
    series.close()
    series.close()
    with pytest.raises(OutputError, match="closed"):
        series.write(1, 0.1, 0.1, particles(1), grid(1), {})
    assert [path.name for path in tmp_path.iterdir()] == ["p.h5"]
    with h5py.File(tmp_path / "p.h5", "r") as file:
        assert list(file["data/0/fields"]) == []


def test_a_series_without_snapshots_leaves_no_file(tmp_path: Path) -> None:
    ParticleSeries(tmp_path / "p.h5", COMM).close()
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_missing_is_an_output_error(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"p\.h5\.part cannot be created"):
        ParticleSeries(tmp_path / "none" / "p.h5", COMM)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"density": np.zeros(5)}, r"'density' has shape \(5,\), expected \(6,\)"),
        ({"phase": np.zeros(6, complex)}, "'phase' has type complex128"),
    ],
)
def test_a_field_that_does_not_fit_is_named_and_nothing_is_written(tmp_path: Path, change: Any, words: str) -> None:
    with ParticleSeries(tmp_path / "p.h5", COMM) as series:
        series.write(0, 0.0, 0.1, particles(1), grid(1), {})
        wrong = particles(1)
        wrong.fields.update(change)
        with pytest.raises(OutputError, match=words):
            series.write(1, 0.1, 0.1, wrong, grid(1), {})
        with pytest.raises(OutputError, match="nodes"):
            series.write(2, 0.1, 0.1, particles(1), grid(1), {"nodes": np.zeros(3)})
        with pytest.raises(OutputError, match="written before"):
            series.write(0, 0.1, 0.1, particles(1), grid(1), {})
    with h5py.File(tmp_path / "p.h5", "r") as file:
        assert list(file["data"]) == ["0"]


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO])
def test_a_disk_that_fails_at_any_write_costs_one_snapshot(tmp_path: Path, monkeypatch: Any, number: int) -> None:
    """From the first write to the last; half of each may still reach the disk."""
    whole, path = os.pwrite, tmp_path / "p.h5"
    left = [0]

    def failing(descriptor: int, data: Any, offset: int) -> int:
        left[0] -= 1
        if left[0] == 0:
            whole(descriptor, data[: len(data) // 2], offset)
            raise OSError(number, os.strerror(number))
        return whole(descriptor, data, offset)

    monkeypatch.setattr(os, "pwrite", failing)
    failed = 0
    with ParticleSeries(path, COMM) as series:
        series.write(0, 0.0, 0.1, particles(2), grid(2), {})
        size = Path(f"{path}.part").stat().st_size
        for last in range(1, 200):
            left[0] = last
            try:
                series.write(1, 0.1, 0.1, particles(2), grid(2), {})
                break
            except WriteFailed as error:
                assert "snapshot of step 1" in str(error) and os.strerror(number) in str(error)
            failed += 1
            with h5py.File(f"{path}.part", "r") as file:
                assert list(file["data"]) == ["0"], last
                assert np.array_equal(file["data/0/particles/gas/density"][:], np.arange(6.0))
            assert Path(f"{path}.part").stat().st_size == size, "the space is given back"
    assert failed > 30
    with h5py.File(path, "r") as file:
        assert set(file["data"]) == {"0", "1"}
        assert np.array_equal(file["data/1/particles/gas/density"][:], np.arange(6.0))


def test_a_folder_that_disappears_is_said_at_the_next_snapshot(tmp_path: Path) -> None:
    series = ParticleSeries(tmp_path / "out.h5", COMM)
    series.write(0, 0.0, 0.1, particles(1), grid(1), {})
    (tmp_path / "out.h5.part").unlink()
    with pytest.raises(WriteFailed, match=r"step 1 .*out\.h5\.part: No such file or directory; the folder is gone"):
        series.write(1, 0.1, 0.1, particles(1), grid(1), {})
    with pytest.raises(WriteFailed, match=r"out\.h5 cannot be put in place"):
        series.close()


def test_a_comment_too_long_for_an_attribute_is_left_out() -> None:
    assert openpmd.root_attributes("wave", "x" * 70_000)["comment"] == b"wave"
    assert "comment" not in openpmd.root_attributes()


@pytest.mark.parametrize("point", [0.0, 0.3, 1e-300, 1e10, -2.5])
def test_a_box_around_one_point_holds_it(point: float) -> None:
    low, extent = openpmd.smallest_box(np.array([[point]]))
    assert low[0] == point and low[0] + extent[0] > point


def test_positions_that_are_not_finite_are_written_without_a_warning(tmp_path: Path) -> None:
    wild = particles(1)
    wild.position[:2] = [[np.nan], [np.inf]]
    with np.errstate(all="raise"), ParticleSeries(tmp_path / "p.h5", COMM) as series:
        series.write(0, 0.0, 0.1, wild, grid(1), {})
    with h5py.File(tmp_path / "p.h5", "r") as file:
        assert np.array_equal(file["data/0/particles/gas/position/x"][:], wild.position[:, 0], equal_nan=True)
