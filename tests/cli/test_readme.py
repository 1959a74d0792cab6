"""What README shows must work as it stands there; so must the examples of the other documents."""

import csv
import re

import pytest

from document_helpers import DOCS, README, blocks
from helpers import mpipic_here, run_python

LIBRARY = """
kept = MPI.COMM_WORLD.allreduce(filtered.sum()), MPI.COMM_WORLD.allreduce(q.sum())
assert filtered.shape == q.shape and abs(kept[0] - kept[1]) < 1e-9, kept
assert 0.01 < np.abs(filtered - q).max() < 0.5, "a filter that does nothing, or destroys"
"""
PHYSICS = """
arrived = MPI.COMM_WORLD.allreduce(simulation.physics.motion.migrated)
assert before > 1000.0 and abs(after - before) < 1e-9 * before, (before, after)
assert (arrived > 100) == (MPI.COMM_WORLD.size > 1), arrived
"""
FILTERED = """
assert 0.001 < distance < 0.1 and invisible < 1e-8 and slope.shape == (len(q), 2), (distance, invisible, slope.shape)
"""
EXTENDED = """
assert 2.6209e-3 < error < 3.6228e-3, error  # between order 2 and local
"""
BASES = """
assert set(worst) == {"linear", "quadratic", "cubic"} and max(map(max, worst.values())) < 1e-11, worst
"""
EXAMPLES = {
    README: [LIBRARY],
    DOCS / "physics.md": [PHYSICS],
    DOCS / "library.md": [FILTERED],
    DOCS / "extending.md": [EXTENDED, BASES],
}
"""Document to what must hold after each of its Python examples."""


@pytest.mark.mpi
@pytest.mark.parametrize("ranks", [1, 3])
def test_the_examples_do_what_they_say_on_any_number_of_ranks(ranks, tmp_path):
    script = tmp_path / "examples.py"
    parts = [
        example + check for document, checks in EXAMPLES.items() for example, check in zip(blocks(document), checks)
    ]
    assert len(parts) == sum(map(len, EXAMPLES.values())) == sum(len(blocks(document)) for document in EXAMPLES)
    script.write_text("\n".join(parts) + '\nprint("all hold", MPI.COMM_WORLD.rank)\n', encoding="utf-8")
    finished = run_python(ranks, script)
    assert finished.returncode == 0, finished.stderr
    assert finished.stdout.count("all hold") == ranks


def test_the_guide_leads_to_a_run_of_particles_of_ones_own(tmp_path, monkeypatch):
    guide = DOCS / "guide.md"
    (script,), (scene,) = blocks(guide), blocks(guide, "toml")
    monkeypatch.chdir(tmp_path)
    exec(script, {})
    (tmp_path / "mine.toml").write_text(scene, encoding="utf-8")
    text = guide.read_text(encoding="utf-8")
    commands = [line.split() for line in re.findall(r"^    \./run (.*mine\.toml.*)$", text, flags=re.MULTILINE)]
    assert [words[0] for words in commands] == ["check", "filters", "stability", "stability", "run", "run", "run"]
    commands.pop(3)  # half a minute
    for words in commands:
        finished = mpipic_here(*words, *(["--no-plots"] if words[0] == "run" else []))
        assert finished.returncode == 0, finished.stderr
        if words[0] == "stability":
            (growth,) = re.findall(r"^growth +(\S+)", finished.stdout, flags=re.MULTILINE)
            assert f"| local | {float(growth):.3e} |".replace("e-03", "e-3") in text
    for name in ("local", "exact", "recommended"):
        assert (tmp_path / "runs" / name / "particles.h5").exists()
        with (tmp_path / "runs" / name / "history.csv").open(newline="") as file:
            largest = float(list(csv.DictReader(file))[-1]["max_density"])
        assert re.search(rf"^\| {name} \|.*\| {largest:.3g} \|$", text, flags=re.MULTILINE), (name, largest)


def test_the_guide_quotes_the_messages_of_wrong_keys():
    (quoted,) = blocks(DOCS / "guide.md", "text")
    said = mpipic_here("run", "--set", "filter.kind=locl", "--set", "grid.cells=[0]", "--set", "gas.flw=1")
    assert said.returncode == 2 and said.stderr == quoted
