"""Thousands of particle files with damage anywhere: each is read, or refused in words, soon, and no field is lost."""

from __future__ import annotations

from collections import Counter
from importlib import import_module
from pathlib import Path

import pytest

from damage_helpers import damaged, judge, write_all
from mpipic.io.apart import Apart, Died
from mpipic.io.particle_file import pieces

COUNT = 2200


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[str, str]]:
    """What became of each copy: its name, and "read", "refused", or what is wrong with the answer."""
    folder = tmp_path_factory.mktemp("damaged")
    copy, found = folder / "copy.h5", []
    with Apart(patience=10.0) as process:
        for name, data in damaged(write_all(folder), seed=7, count=COUNT):
            copy.write_bytes(data)
            found.append((name, judge(copy, process)))
    return found


def test_any_damage_is_an_error_in_words_or_does_no_harm(outcomes: list[tuple[str, str]]) -> None:
    assert [item for item in outcomes if item[1] not in ("read", "refused")] == []


def test_the_copies_are_damaged_enough_and_not_too_much(outcomes: list[tuple[str, str]]) -> None:
    counts = Counter(outcome for _, outcome in outcomes)
    assert counts["read"] > COUNT // 5 and counts["refused"] > COUNT // 5, counts


def test_files_that_are_whole_are_read(tmp_path: Path) -> None:
    with Apart() as process:
        assert {kind: judge(path, process) for kind, path in write_all(tmp_path).items()} == dict.fromkeys(
            write_all(tmp_path), "read"
        )


def test_the_judge_knows_lost_fields_and_other_errors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_all(tmp_path)["contiguous"]
    with Apart() as process:
        for wrong, words in ((ZeroDivisionError("x"), "ZeroDivisionError: x"), (None, "density is lost")):
            monkeypatch.setattr("damage_helpers.read_particle_file", lambda *a, wrong=wrong: fake(wrong))
            assert words in judge(path, process)


def fake(wrong: Exception | None) -> object:
    """Raise an error of another kind, or return particles whose density is zero."""
    if wrong:
        raise wrong
    import numpy as np

    from mpipic.io.particle_file import ParticleRows

    ones = np.ones((3, 2))
    return ParticleRows(np.arange(3), ones, {"density": np.zeros(3), "velocity": ones})


@pytest.mark.parametrize("size", [1, 1 << 20])
def test_a_process_that_has_gone_is_told_of_however_much_was_to_be_sent(tmp_path: Path, size: int) -> None:
    """PETSc is there, and takes a broken pipe for the end of the program."""
    import_module("petsc4py.PETSc")
    good = write_all(tmp_path)["contiguous"]
    with Apart() as process:
        assert judge(good, process) == "read"
        process._process.kill()
        process._process.wait()
        with pytest.raises(Died, match="SIGKILL"):
            list(process.run(pieces, "x" * size, 0, 1))
        assert judge(good, process) == "read", "another one is started"
