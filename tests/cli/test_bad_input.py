"""Claims about bad input: every mistake is named once, in words, by rank 0, with exit code 2 and no traceback."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from helpers import TESTS, finish, mpipic, run_ranks, start

COMMANDS = TESTS / "parallel" / "command_helpers.py"
HERE = "{here}"
"""Stands for the folder of a test's files in arguments and messages."""


def overrides(*texts: str) -> list[str]:
    return [word for text in texts for word in ("--set", text)]


def from_file(name: str, *more: str) -> list[str]:
    return overrides("particles.layout=file", f"particles.path={HERE}/{name}", *more)


# name: (arguments after the verb, the lines of the message; each must appear once)
SCENES: dict[str, tuple[list[str], list[str]]] = {
    "unknown-key": (
        overrides("gas.flwo=[1.0]"),
        ["gas.flwo = [1.0]: there is no such key; [gas] has sound_speed, flow, density. Did you mean"],
    ),
    "unknown-section": (overrides("filters.kind=none"), ["there is no such section"]),
    "length-of-another-dimension": (
        overrides("grid.cells=[8, 8]", "gas.flow=[0.1]", "grid.length=[1.0, 1.0, 1.0]"),
        ["grid.length = [1.0, 1.0, 1.0]: must have", "gas.flow = [0.1]: must have"],
    ),
    "not-a-number": (
        overrides("gas.flow=[nan]", "time.blow_up=inf"),
        ["gas.flow = [nan]: must be a list of finite numbers", "time.blow_up = inf: must be a finite number above 1"],
    ),
    "zero-and-negative": (
        overrides("grid.cells=[0]", "time.steps=-3", "time.dt=0.0"),
        ["grid.cells = [0]: must be", "time.steps = -3: must be", "time.dt = 0.0: must be"],
    ),
    "dt-and-cfl": (
        overrides("time.dt=0.001", "time.cfl=0.1"),
        ["time.cfl = 0.1: give either time.dt or time.cfl, not both"],
    ),
    "no-such-scene": ([f"{HERE}/nothere.toml"], ["nothere.toml: cannot be read: No such file or directory"]),
    "a-folder-for-a-scene": ([HERE], ["cannot be read: Is a directory"]),
    "malformed": ([f"{HERE}/malformed.toml"], ["malformed.toml: not valid TOML at line 3, column 1"]),
    "not-text": ([f"{HERE}/particles.h5"], ["not a text file in UTF-8"]),
    "set-without-value": (overrides("steps"), ["--set steps: must have the form section.key=value"]),
    "set-without-section": (overrides("steps=4"), ["--set steps=4: must have the form section.key=value"]),
    "set-bad-toml": (overrides("grid.cells=[4"), ["--set grid.cells=[4: the value is not valid TOML"]),
    "not-yet": (
        overrides("particles.layout=clustered", "output.checkpoint_every=5"),
        [
            'particles.layout = "clustered": must be one of lattice, jittered, random, file',
            "output.checkpoint_every = 5: must be 0: checkpoints cannot be written yet",
        ],
    ),
    "svd-too-large": (
        overrides("filter.kind=svd", "grid.cells=[100000]"),
        [
            'filter.kind = "svd": svd of 100000 nodes and 200000 particles needs about ',
            " GB on ",
            " GB are free",
            'filter.kind = "exact" is the same operator and takes memory in proportion to nodes',
        ],
    ),
    "misspelt": (overrides("filter.kind=locl"), ['Did you mean "local"?']),
    "no-such-particles": (from_file("nothere.h5"), ["particles.path", "cannot be read: No such file or directory"]),
    "particles-nowhere": (
        from_file("nowhere.h5"),
        ["particles.path: ", "nowhere.h5: position is not finite in 1 row, first row 1: (inf)"],
    ),
    "particles-misnamed": (
        from_file("misnamed.h5", "initial.profile=file"),
        [
            "density is missing; the file has Density, position and vel. Did you mean",
            "velocity is missing; the file has Density, position and vel. Did you mean",
            'particles.records = ["velocity=vel"]',
        ],
    ),
    "particles-of-no-series": (
        from_file("particles.h5", "particles.species=e", "particles.iteration=3"),
        ["particles.h5: is no openPMD file, and has no iteration or species to choose"],
    ),
    "particle-keys": (
        from_file("particles.h5", 'particles.records=["density"]', 'particles.axes=["x","y"]'),
        [
            'particles.records = ["density"]: must be a list of texts "quantity=record"',
            'particles.axes = ["x", "y"]: must hold as many different names as grid.cells has entries, 1',
        ],
    ),
    "too-sharp-in-3d": (
        overrides("grid.cells=[4, 4, 4]", "initial.sharpness=1e6"),
        ['initial = "gaussian": sharpness = 1e+06 needs', "this box allows sharpness up to"],
    ),
}

# What shows only when the particles are read: not for `check`.
RUNS: dict[str, tuple[list[str], list[str]]] = {
    "particles-of-another-dimension": (
        from_file("particles.h5", "grid.cells=[8, 8]", "initial.profile=file"),
        ["position has shape (20, 1), expected (n, 2)", "velocity has shape (20, 1), expected (n, 2)"],
    ),
    "particles-wrong-in-many-ways": (
        from_file("wrong.h5", "initial.profile=file", 'particles.records=["velocity="]'),
        [
            "position is not finite in 1 row, first row 3: (nan)",
            "position is so far away that its digits do not tell its cell in 2 rows, first row 5: (1e+300)",
            "density is not finite in 1 row, first row 19: inf",
        ],
    ),
    "particles-not-hdf5": (from_file("malformed.toml"), ["malformed.toml: as HDF5, it cannot be read: "]),
    "output-taken": (
        ["--output", f"{HERE}/taken"],
        ["taken already holds summary.json, history.csv, which no run of this program left there"],
    ),
    "output-below-a-file": (["--output", f"{HERE}/malformed.toml/out"], ["cannot be used: Not a directory"]),
}

MALFORMED = "[grid]\ncells = [\n"


def make_files(folder: Path) -> None:
    (folder / "malformed.toml").write_text(MALFORMED)
    taken = folder / "taken"
    taken.mkdir()
    (taken / "summary.json").write_text("{}")
    (taken / "history.csv").write_text("step\n")
    good = np.linspace(0.0, 0.95, 20)[:, None]
    wrong, density = good.copy(), np.zeros(20)
    wrong[3], wrong[5], wrong[12], density[19] = np.nan, 1e300, -1e200, np.inf
    with h5py.File(folder / "particles.h5", "w") as file:
        file["position"], file["velocity"] = good, np.zeros((20, 1))
    with h5py.File(folder / "nowhere.h5", "w") as file:
        file["position"] = [[0.5], [np.inf]]
    with h5py.File(folder / "misnamed.h5", "w") as file:
        file["position"], file["Density"], file["vel"] = good, np.zeros(20), good
    with h5py.File(folder / "wrong.h5", "w") as file:
        file["position"], file["density"] = wrong, density


Said = Callable[[int, str], SimpleNamespace]


@pytest.fixture(scope="module")
def said(tmp_path_factory: pytest.TempPathFactory) -> Said:
    """What all ranks said in a case, and their exit codes; every number of ranks is started once."""
    folder = tmp_path_factory.mktemp("refused")
    make_files(folder)

    def answer(ranks: int, name: str) -> SimpleNamespace:
        place = folder / str(ranks)
        if not place.exists():
            place.mkdir()
            cases = {f"check-{case}": ["check", *words] for case, (words, _) in SCENES.items()}
            for case, (words, _) in {**SCENES, **RUNS}.items():
                default = [] if "--output" in words else ["--output", f"{HERE}/{ranks}/runs-{case}"]
                cases[f"run-{case}"] = ["run", *words, *default]
            old = place / "old"
            old.mkdir()
            (old / "summary.json").write_text("{}")
            cases["overwrite"] = ["run", *RUNS["particles-wrong-in-many-ways"][0], "--output", str(old), "--overwrite"]
            cases["check-too-many-ranks"] = ["check", *overrides("grid.cells=[1]")]
            cases["run-too-many-ranks"] = ["run", *overrides("grid.cells=[1]"), "--output", f"{HERE}/x"]
            filled = json.dumps(cases).replace(HERE, str(folder))
            (place / "cases.json").write_text(filled)
            ended = run_ranks(ranks, COMMANDS, str(place / "cases.json"), str(place))
            assert ended.returncode == 0, ended.stdout + ended.stderr
        codes = json.loads((place / "codes.json").read_text())[name]
        out, err = ([(place / f"{name}.{rank}.{kind}").read_text() for rank in range(ranks)] for kind in ("out", "err"))
        return SimpleNamespace(codes=codes, out=out, err=err, here=str(folder), place=place)

    return answer


ALL = [("check", name) for name in SCENES] + [("run", name) for name in {**SCENES, **RUNS}]


def is_refusal(found: SimpleNamespace, lines: list[str]) -> None:
    """Exit code 2 on all ranks, each line once, in an error of rank 0, and nothing else from anyone."""
    first, others = found.err[0], found.err[1:]
    assert found.codes == [2] * len(found.codes), found.err
    for line in lines:
        assert first.count(line) == 1, first
    assert all(text.startswith("error: ") for text in first.splitlines()), first
    assert "Traceback" not in first
    assert others == [""] * len(others) and found.out == [""] * len(found.out)


@pytest.mark.mpi
@pytest.mark.parametrize(("verb", "name"), ALL)
def test_a_mistake_is_named_once_with_exit_code_2(said: Said, verb: str, name: str) -> None:
    for ranks in (1, 2):
        found = said(ranks, f"{verb}-{name}")
        is_refusal(found, [line.replace(HERE, found.here) for line in {**SCENES, **RUNS}[name][1]])


@pytest.mark.mpi
@pytest.mark.parametrize("ranks", [1, 2])
def test_a_refused_scene_leaves_no_run_directory(said: Said, ranks: int) -> None:
    names = [name for name in {**SCENES, **RUNS} if not name.startswith("output-")]
    left = [name for name in names if (said(ranks, f"run-{name}").place / f"runs-{name}").exists()]
    assert len(names) > 20 and left == []


@pytest.mark.mpi
@pytest.mark.parametrize("verb", ["run", "check"])
def test_more_ranks_than_cells_are_refused_with_the_nearest_number(said: Said, verb: str) -> None:
    rule = "number of ranks = 2: cannot divide grid.cells = [1] into blocks; the nearest smaller number that can is 1"
    is_refusal(said(2, f"{verb}-too-many-ranks"), [rule])


def test_mistakes_that_can_be_found_together_are_reported_together(said: Said) -> None:
    for name, count in (("check-not-yet", 2), ("check-zero-and-negative", 3), ("run-particles-wrong-in-many-ways", 3)):
        assert len(said(1, name).err[0].splitlines()) == count


@pytest.mark.mpi
@pytest.mark.parametrize("ranks", [1, 2])
@pytest.mark.parametrize("verb", ["check", "run"])
def test_a_decomposition_that_would_not_fit_is_refused_in_one_line_that_names_the_numbers(
    said: Said, verb: str, ranks: int
) -> None:
    (line,) = said(ranks, f"{verb}-svd-too-large").err[0].splitlines()
    needed, free = map(float, re.findall(r"([\d.e+]+) GB", line))
    assert needed > 8e-9 * 1e5 * 3e5, "both bases, once"
    assert 0.05 < free < needed


def test_results_of_another_run_are_untouched_by_a_refusal(said: Said) -> None:
    found = said(1, "run-output-taken")
    taken = Path(found.here) / "taken"
    assert sorted(path.name for path in taken.iterdir()) == ["history.csv", "summary.json"]
    assert (taken / "summary.json").read_text() == "{}"


@pytest.mark.mpi
@pytest.mark.parametrize("ranks", [1, 2])
def test_a_refused_scene_overwrites_nothing(said: Said, ranks: int) -> None:
    found = said(ranks, "overwrite")
    assert found.codes == [2] * ranks
    assert [path.name for path in (found.place / "old").iterdir()] == ["summary.json"]


@pytest.mark.mpi
def test_mpiexec_ends_with_code_2_and_the_message_once() -> None:
    ended = mpipic("run", "--set", "particles.layout=clustered", ranks=2)
    assert ended.returncode == 2 and ended.stdout.count("clustered") == 0
    assert ended.stderr.count('particles.layout = "clustered": must be one of') == 1
    assert "Traceback" not in ended.stderr


@pytest.mark.mpi
@pytest.mark.parametrize("ranks", [1, 2])
def test_what_nothing_uses_is_a_warning_said_once(ranks: int) -> None:
    more = overrides("filter.kind=svd", "filter.order=2", "grid.cells=[8]")
    ended = mpipic("check", *more, ranks=ranks, timeout=60)
    why = 'filter.kind = "svd" takes no order; order and chebyshev do'
    assert ended.returncode == 0
    assert ended.stderr.splitlines() == [f"warning: filter.order = 2 is not used: {why}"]
    (left_out,) = [line for line in ended.stdout.splitlines() if line.startswith("left out")]
    assert left_out.endswith(", filter.order")


def test_a_comparison_of_filters_uses_what_the_scene_says_of_any_filter() -> None:
    more = overrides("filter.tolerance=1e-3", "filter.order=7", "mapping.penalty=1.0", "grid.cells=[8]")
    ended = mpipic("filters", *more, "--filters", "order,exact", timeout=60)
    assert ended.returncode == 0 and "mapping.penalty" in ended.stderr and "filter." not in ended.stderr
    assert "order 7" in ended.stdout and "residual of 0.001" in ended.stdout


USAGE = {
    "unknown-option": (["run", "--colour", "red"], "No such option: --colour"),
    "unknown-verb": (["jump"], "No such command 'jump'"),
    "option-without-value": (["run", "--output"], "Option '--output' requires an argument"),
    "two-scenes": (["check", "a.toml", "b.toml"], "unexpected extra argument"),
}


@pytest.mark.parametrize("name", USAGE)
def test_wrong_usage_says_what_is_wrong_with_exit_code_2(name: str) -> None:
    arguments, message = USAGE[name]
    ended = finish(start([sys.executable, "-m", "mpipic", *arguments]))
    assert ended.returncode == 2 and ended.stdout == ""
    assert ended.stderr.count(message) == 1 and "Traceback" not in ended.stderr


@pytest.mark.mpi
def test_wrong_usage_and_help_appear_once_under_mpiexec() -> None:
    arguments, message = USAGE["unknown-option"]
    ended = mpipic(*arguments, ranks=2)
    assert ended.returncode == 2 and ended.stderr.count(message) == 1 and "Traceback" not in ended.stderr
    ended = mpipic("run", "--help", ranks=2)
    assert ended.returncode == 0 and ended.stdout.count("Usage") == 1


@pytest.mark.mpi
@pytest.mark.parametrize("ranks", [1, 2])
def test_help_is_plain_text_where_it_is_kept(ranks: int) -> None:
    ended = mpipic("run", "--help", ranks=ranks)
    assert "--overwrite" in ended.stdout and "\x1b" not in ended.stdout
