"""Claims about output on several ranks: files hold the data of the ranks, and a failure is everybody's."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import h5py
import numpy as np
import pytest

from helpers import run_ranks

HELPERS = Path(__file__).with_name("output_helpers.py")
_spec = importlib.util.spec_from_file_location("output_helpers", HELPERS)
expected = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(expected)

pytestmark = pytest.mark.mpi


def run(ranks: int, case: str, folder: Path, status: int = 0) -> str:
    result = run_ranks(ranks, HELPERS, case, str(folder), timeout=60)
    assert result.returncode == status, result.stdout + result.stderr
    if status == 0:
        assert all(f"rank {rank} of {ranks} done" in result.stdout for rank in range(ranks))
    return result.stdout


def steps(path: Path) -> set[str]:
    with h5py.File(path, "r") as file:
        return set(file["data"])


@pytest.mark.parametrize("case", ["write", "funnel"])
@pytest.mark.parametrize("ranks", [1, 2, 3])
def test_particles_read_back_by_id_on_any_number_of_ranks(tmp_path: Path, case: str, ranks: int) -> None:
    run(ranks, case, tmp_path)
    for dim in (1, 2, 3):
        with h5py.File(tmp_path / f"{dim}.h5", "r") as file:
            assert set(file["data"]) == {"0", "10"}
            gas = file["data/10/particles/gas"]
            ids = gas["id"][:]
            assert sorted(ids) == list(range(expected.TOTAL))
            values = expected.particle_values(ids, dim)
            for axis, name in enumerate("xyz"[:dim]):
                assert np.array_equal(gas[f"position/{name}"][:], values["position"][:, axis])
                assert np.array_equal(gas[f"velocity/{name}"][:], values["velocity"][:, axis])
            assert np.array_equal(gas["density"][:], values["density"])
            assert np.array_equal(gas["colour"][:], values["colour"])
            assert gas["colour"].dtype == np.int32
            assert file["data/10"].attrs["time"] == 2.5


@pytest.mark.parametrize("case", ["write", "funnel"])
@pytest.mark.parametrize("ranks", [1, 2, 3])
def test_nodes_owned_in_uneven_slabs_come_together(tmp_path: Path, case: str, ranks: int) -> None:
    run(ranks, case, tmp_path)
    for dim in (1, 2, 3):
        with h5py.File(tmp_path / f"{dim}.h5", "r") as file:
            fields = file["data/0/fields"]
            whole = expected.nodal_value((5, 4, 11)[-dim:])
            assert np.array_equal(fields["density"][:], whole)
            for k, name in enumerate("xyz"[:dim]):
                assert np.array_equal(fields[f"velocity/{name}"][:], whole * (k + 1))


@pytest.mark.parametrize("ranks", [2, 3])
def test_a_patch_is_the_rows_and_the_box_of_one_rank(tmp_path: Path, ranks: int) -> None:
    run(ranks, "write", tmp_path)
    with h5py.File(tmp_path / "2.h5", "r") as file:
        gas = file["data/0/particles/gas"]
        patches = gas["particlePatches"]
        ids, counts = gas["id"][:], patches["numParticles"][:]
        offsets = patches["numParticlesOffset"][:]
        owners = expected.owner(np.arange(expected.TOTAL), ranks)
        assert list(counts) == [np.count_nonzero(owners == rank) for rank in range(ranks)]
        assert (counts[-1] == 0) == (ranks == 3), "with three ranks one must be empty"
        assert np.count_nonzero(np.diff(owners)) > 100, "ids must interleave"
        for rank in range(ranks):
            rows = slice(int(offsets[rank]), int(offsets[rank] + counts[rank]))
            assert np.all(owners[ids[rows]] == rank)
            for axis in "xy":
                x, low = gas[f"position/{axis}"][rows], patches[f"offset/{axis}"][rank]
                assert np.all(x >= low) and np.all(x < low + patches[f"extent/{axis}"][rank])


@pytest.mark.parametrize("ranks", [1, 2, 3])
@pytest.mark.parametrize("case", ["failure", "failure_funnel"])
def test_a_failed_snapshot_is_not_in_the_file_and_the_series_goes_on(tmp_path: Path, case: str, ranks: int) -> None:
    run(ranks, case, tmp_path)
    assert steps(tmp_path / "1.h5") == {"0", "2"}
    with h5py.File(tmp_path / "1.h5", "r") as file:
        gas = file["data/2/particles/gas"]
        assert np.array_equal(gas["density"][:], np.sin(gas["id"][:]))


@pytest.mark.parametrize("ranks", [1, 2])
def test_a_killed_run_leaves_its_snapshots_readable(tmp_path: Path, ranks: int) -> None:
    result = run_ranks(ranks, HELPERS, "killed", str(tmp_path), timeout=60)
    assert result.returncode != 0
    assert not (tmp_path / "1.h5").exists()
    assert steps(tmp_path / "1.h5.part") == {"0", "1"}


def test_an_exception_everywhere_closes_the_file_and_one_on_a_single_rank_does_not_hang(tmp_path: Path) -> None:
    result = run_ranks(2, HELPERS, "interrupt", str(tmp_path), timeout=60)
    assert "one rank left" in result.stdout and result.returncode == 7
    assert steps(tmp_path / "1.h5") == {"0"}
    assert not (tmp_path / "2.h5").exists()
    assert steps(tmp_path / "2.h5.part") == {"0"}


@pytest.mark.parametrize("ranks", [1, 2, 3])
def test_the_run_directory_is_agreed_on_and_refused_by_all(tmp_path: Path, ranks: int) -> None:
    run(ranks, "directory", tmp_path)
    names = sorted(path.name for path in (tmp_path / "runs").iterdir())
    assert len(names) == 3 and all(name.startswith("a-b-c-") for name in names)


def test_the_sample_does_not_depend_on_the_number_of_ranks(tmp_path: Path) -> None:
    samples = []
    for ranks in (1, 2, 3):
        folder = tmp_path / str(ranks)
        folder.mkdir()
        run(ranks, "sample", folder)
        samples.append(np.load(folder / "sample.npz"))
    first = samples[0]
    assert 95 <= len(first["ids"]) <= 100
    assert np.array_equal(first["all"], np.arange(expected.TOTAL))
    assert np.all(np.diff(first["ids"]) > 0)
    for sample in samples:
        assert set(sample.files) == {"all", "ids", "position", "density", "velocity", "colour"}
        for name in sample.files:
            assert np.array_equal(sample[name], first[name])
    assert np.array_equal(first["velocity"], expected.particle_values(first["ids"], 2)["velocity"])


@pytest.mark.parametrize("ranks", [1, 2, 3])
def test_ranks_read_the_rows_of_a_particle_file_once_and_report_problems_together(tmp_path: Path, ranks: int) -> None:
    n = 7
    with h5py.File(tmp_path / "good.h5", "w") as file:
        file["position"] = np.linspace(0.0, 0.9, n)[:, None]
        file["density"] = np.arange(n)
    with h5py.File(tmp_path / "bad.h5", "w") as file:
        x = np.linspace(0.0, 0.9, n)[:, None]
        x[[1, 6]] = 1.5
        file["position"] = x
    run(ranks, "read", tmp_path)
