"""What README shows must work as it stands there."""

import re
from pathlib import Path

import pytest

from helpers import run_python

README = Path(__file__).parents[2] / "README.md"
PHYSICS = README.parent / "docs" / "physics.md"


def python_blocks(document: Path = README) -> list[str]:
    return re.findall(r"```python\n(.*?)```", document.read_text(encoding="utf-8"), flags=re.DOTALL)


@pytest.mark.mpi
@pytest.mark.parametrize("ranks", [1, 3])
def test_the_library_example_filters_on_any_number_of_ranks(ranks, tmp_path):
    (example,) = python_blocks()
    script = tmp_path / "example.py"
    check = """
kept = MPI.COMM_WORLD.allreduce(filtered.sum()), MPI.COMM_WORLD.allreduce(q.sum())
assert filtered.shape == q.shape and abs(kept[0] - kept[1]) < 1e-9, kept
assert 0.01 < np.abs(filtered - q).max() < 0.5, "a filter that does nothing, or destroys"
print("filtered", MPI.COMM_WORLD.rank)
"""
    script.write_text(example + check, encoding="utf-8")
    finished = run_python(ranks, script)
    assert finished.returncode == 0, finished.stderr
    assert finished.stdout.count("filtered") == ranks


@pytest.mark.mpi
@pytest.mark.parametrize("ranks", [1, 3])
def test_the_physics_example_moves_tracers_on_any_number_of_ranks(ranks, tmp_path):
    (example,) = python_blocks(PHYSICS)
    script = tmp_path / "example.py"
    check = """
arrived = MPI.COMM_WORLD.allreduce(simulation.physics.motion.migrated)
assert before > 1000.0 and abs(after - before) < 1e-9 * before, (before, after)
assert (arrived > 100) == (MPI.COMM_WORLD.size > 1), arrived
print("conserved", MPI.COMM_WORLD.rank)
"""
    script.write_text(example + check, encoding="utf-8")
    finished = run_python(ranks, script)
    assert finished.returncode == 0, finished.stderr
    assert finished.stdout.count("conserved") == ranks


def test_every_file_that_readme_names_is_there():
    text = README.read_text(encoding="utf-8")
    named = set(re.findall(r"(?:configs|docs|src/mpipic)/[\w./-]+\w", text))
    assert len(named) > 5
    missing = [name for name in named if not (README.parent / name).exists()]
    assert not missing
