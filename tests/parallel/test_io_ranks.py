"""Claims about output on several ranks: files hold the data of the ranks, and a failure is everybody's."""

from __future__ import annotations

import importlib.util
import subprocess
from collections.abc import Callable
from functools import cache
from pathlib import Path

import h5py
import numpy as np
import pytest

from helpers import run_ranks

HELPERS = Path(__file__).with_name("io_helpers.py")
_spec = importlib.util.spec_from_file_location("io_helpers", HELPERS)
expected = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(expected)

pytestmark = pytest.mark.mpi


CASES = ("write", "funnel", "failure", "failure_funnel", "directory", "sample", "read", "damaged")
"""Those that end well: run one after the other in one start."""


def prepare(folder: Path) -> None:
    """A folder for every case, and what the case "read" reads."""
    for case in CASES:
        (folder / case).mkdir(parents=True)
    x = np.linspace(0.0, 0.9, 7)[:, None]
    with h5py.File(folder / "read" / "good.h5", "w") as file:
        file["position"], file["density"] = x, np.arange(7)
    x[[1, 6], 0] = 1.5, -2.75
    with h5py.File(folder / "read" / "outside.h5", "w") as file:
        file["position"] = x
    x[[1, 6]] = np.nan
    with h5py.File(folder / "read" / "bad.h5", "w") as file:
        file["position"] = x
    with h5py.File(folder / "read" / "twice.h5", "w") as file:
        file["position"], file["id"] = np.zeros((7, 1)), [8, 1, 2, 9, 8, 8, 9]


Ended = Callable[[int], tuple[Path, subprocess.CompletedProcess[str]]]


@pytest.fixture(scope="module")
def ended(tmp_path_factory: pytest.TempPathFactory) -> Ended:
    """The folder of all cases on a number of ranks, and what was said; every number of ranks is started once."""
    folder = tmp_path_factory.mktemp("output")

    @cache
    def of(ranks: int) -> tuple[Path, subprocess.CompletedProcess[str]]:
        place = folder / str(ranks)
        prepare(place)
        return place, run_ranks(ranks, HELPERS, str(place), *CASES)

    return of


def folder_of(case: str, ended: Ended, ranks: int) -> Path:
    """The folder of a case that all ranks have run to its end."""
    folder, process = ended(ranks)
    for rank in range(ranks):
        assert f"rank {rank} of {ranks} did {case}\n" in process.stdout, process.stdout + process.stderr
    return folder / case


def alone(case: str, folder: Path, ranks: int) -> subprocess.CompletedProcess[str]:
    """Run a case that ends its ranks, in `folder`/`case`."""
    (folder / case).mkdir()
    return run_ranks(ranks, HELPERS, str(folder), case)


@pytest.mark.parametrize("ranks", [1, 2, 3])
def test_every_case_ends_and_with_exit_code_0(ended: Ended, ranks: int) -> None:
    for case in CASES:
        folder_of(case, ended, ranks)
    process = ended(ranks)[1]
    assert process.returncode == 0, process.stdout + process.stderr


def steps(path: Path) -> set[str]:
    with h5py.File(path, "r") as file:
        return set(file["data"])


@pytest.mark.parametrize("case", ["write", "funnel"])
@pytest.mark.parametrize("ranks", [1, 2, 3])
def test_particles_read_back_by_id_on_any_number_of_ranks(ended: Ended, case: str, ranks: int) -> None:
    folder = folder_of(case, ended, ranks)
    for dim in (1, 2, 3):
        with h5py.File(folder / f"{dim}.h5", "r") as file:
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
def test_nodes_owned_in_uneven_slabs_come_together(ended: Ended, case: str, ranks: int) -> None:
    folder = folder_of(case, ended, ranks)
    for dim in (1, 2, 3):
        with h5py.File(folder / f"{dim}.h5", "r") as file:
            fields = file["data/0/fields"]
            whole = expected.nodal_value((5, 4, 11)[-dim:])
            assert np.array_equal(fields["density"][:], whole)
            for k, name in enumerate("xyz"[:dim]):
                assert np.array_equal(fields[f"velocity/{name}"][:], whole * (k + 1))


@pytest.mark.parametrize("ranks", [2, 3])
def test_a_patch_is_the_rows_and_the_box_of_one_rank(ended: Ended, ranks: int) -> None:
    with h5py.File(folder_of("write", ended, ranks) / "2.h5", "r") as file:
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
def test_a_failed_snapshot_is_not_in_the_file_and_the_series_goes_on(ended: Ended, case: str, ranks: int) -> None:
    path = folder_of(case, ended, ranks) / "1.h5"
    assert steps(path) == {"0", "2"}
    with h5py.File(path, "r") as file:
        gas = file["data/2/particles/gas"]
        assert np.array_equal(gas["density"][:], np.sin(gas["id"][:]))


@pytest.mark.parametrize("ranks", [1, 2])
def test_a_killed_run_leaves_its_snapshots_readable(tmp_path: Path, ranks: int) -> None:
    assert alone("killed", tmp_path, ranks).returncode != 0
    assert not (tmp_path / "killed" / "1.h5").exists()
    assert steps(tmp_path / "killed" / "1.h5.part") == {"0", "1"}


def test_an_exception_everywhere_closes_the_file_and_one_on_a_single_rank_does_not_hang(tmp_path: Path) -> None:
    result, folder = alone("interrupt", tmp_path, 2), tmp_path / "interrupt"
    assert "one rank left" in result.stdout and result.returncode == 7
    assert steps(folder / "1.h5") == {"0"}
    assert not (folder / "2.h5").exists()
    assert steps(folder / "2.h5.part") == {"0"}


@pytest.mark.parametrize("ranks", [1, 2, 3])
def test_the_run_directory_is_agreed_on_and_refused_by_all(ended: Ended, ranks: int) -> None:
    names = sorted(path.name for path in (folder_of("directory", ended, ranks) / "runs").iterdir())
    assert len(names) == 3 and all(name.startswith("a-b-c-") for name in names)


def test_the_sample_does_not_depend_on_the_number_of_ranks(ended: Ended) -> None:
    samples = [np.load(folder_of("sample", ended, ranks) / "sample.npz") for ranks in (1, 2, 3)]
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
def test_ranks_read_the_rows_of_a_particle_file_once_and_report_problems_together(ended: Ended, ranks: int) -> None:
    folder_of("read", ended, ranks)  # the ranks check it themselves
