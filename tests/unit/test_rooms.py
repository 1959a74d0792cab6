"""Claims about the house: rooms import downwards, each knows what it may, files are short, docstrings sentences."""

from __future__ import annotations

from pathlib import Path

import pytest

from helpers import ROOT
from house_helpers import broken_rules

BOTH = "only run/build.py imports both scene and parts"
PRIVATE = "no private name of another file"


def test_the_house_keeps_its_rules() -> None:
    broken = broken_rules(ROOT / "src" / "mpipic")
    assert not broken, "\n".join(map(str, ["", *broken]))


# ---------------------------------------------------------------- the checker itself

HOUSE = {
    "__init__.py": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from mpipic.run.loop import Simulation\n",
    "__main__.py": "from mpipic.cli import main\nmain()\n",
    "cli.py": "from mpipic import __version__\nfrom mpipic.run import loop\nfrom mpipic.scene.records import Scene\n",
    "errors.py": "class NotConverged(Exception):\n    _code = 4\n",
    "kernels/__init__.py": "from mpipic.kernels import loops\n",
    "kernels/loops.py": "import numba\n",
    "mesh/__init__.py": "",
    "mesh/grid.py": "from mpi4py import MPI\nimport mpipic.errors\nfrom mpipic.kernels import loops\n",
    "filters/__init__.py": "",
    "filters/svd.py": "def solve():\n    from slepc4py import SLEPc\n    from mpipic.mesh.grid import Grid\n",
    "physics/__init__.py": "",
    "physics/base.py": "from mpipic.mesh.grid import Grid\n",
    "physics/gas/__init__.py": "",
    "physics/gas/step.py": "from mpipic.physics.base import Physics\nfrom mpipic.filters import svd\n",
    "physics/solid/__init__.py": "",
    "scene/__init__.py": "",
    "scene/records.py": "from mpipic.errors import NotConverged\n",
    "io/__init__.py": "",
    "io/files.py": "import h5py\n",
    "run/__init__.py": "",
    "run/build.py": "from mpipic.mesh.grid import Grid\nfrom mpipic.scene.records import Scene\n",
    "run/loop.py": (
        "from typing import TYPE_CHECKING\nfrom mpipic.scene.records import Scene\n"
        "if TYPE_CHECKING:\n    from mpipic.mesh.grid import Grid\n"
    ),
    "study/__init__.py": "",
    "analysis/__init__.py": "",
}
"""A small house in order."""


def build(folder: Path, more: dict[str, str]) -> Path:
    """Write the house, with lines added to some files, and new files."""
    for name in {**HOUSE, **more}:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(HOUSE.get(name, "") + more.get(name, ""))
    return folder


def test_a_house_in_order_breaks_no_rule(tmp_path: Path) -> None:
    assert not broken_rules(build(tmp_path, {}))


UP = "mesh imports no filters: a room imports from rooms below it"
HELD = "    " + "x = 1\n    " * 40 + "\n"
PLANTED = {
    "upwards": ("mesh/grid.py", "from mpipic.filters.svd import solve\n", UP),
    "upwards in a function": ("mesh/grid.py", "def f():\n    import mpipic.filters.svd\n", UP),
    "upwards for types": (
        "mesh/grid.py",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from mpipic.filters.svd import solve\n",
        UP,
    ),
    "upwards, relative": ("mesh/grid.py", "from ..filters import svd\n", UP),
    "upwards, a whole room": ("mesh/grid.py", "from mpipic import filters\n", UP),
    "to the command line": (
        "run/loop.py",
        "from mpipic.cli import main\n",
        "run imports no cli: a room imports from rooms below it",
    ),
    "sideways": (
        "study/runs.py",
        "from mpipic.analysis import growth\n",
        "study imports no analysis: a room imports from rooms below it",
    ),
    "part from a room aside": (
        "io/files.py",
        "from mpipic.mesh.grid import Grid\n",
        "io imports no mesh: a room imports from rooms below it",
    ),
    "rooms aside, of each other": (
        "io/files.py",
        "from mpipic.scene.records import Scene\n",
        "io imports no scene: a room imports from rooms below it",
    ),
    "a scene in a part": (
        "filters/svd.py",
        "from mpipic.scene.records import Scene\n",
        "filters imports no scene: a room imports from rooms below it",
    ),
    "a scene beside a part": ("run/loop.py", "from mpipic.mesh.grid import Grid\n", BOTH),
    "ground that is none": ("errors.py", "from mpipic.mesh.grid import Grid\n", "ground imports only ground"),
    "one physics of another": (
        "physics/solid/step.py",
        "from mpipic.physics.gas import step\n",
        "no physics knows another, and what is common knows none",
    ),
    "a physics in what is common": (
        "physics/base.py",
        "import mpipic.physics.gas\n",
        "no physics knows another, and what is common knows none",
    ),
    "MPI in a physics, for types": (
        "physics/gas/step.py",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from mpi4py import MPI\n",
        "physics never imports mpi4py",
    ),
    "PETSc in a room aside": ("io/files.py", "from petsc4py import PETSc\n", "io never imports petsc4py"),
    "h5py elsewhere": ("run/loop.py", "def f():\n    import h5py.version\n", "only io import h5py"),
    "SLEPc elsewhere": ("run/loop.py", "from slepc4py import SLEPc\n", "only filters and analysis import slepc4py"),
    "through the door": (
        "run/loop.py",
        "from mpipic import Simulation\n",
        "a room imports from rooms, not through the door",
    ),
    "an open door": ("__init__.py", "from mpipic.errors import *\n", "the door imports when asked, not before"),
    "an import by name": (
        "run/loop.py",
        "import importlib\nimportlib.import_module('mpipic.cli')\n",
        "only the door imports by name, which no test can read",
    ),
    "a private name imported": ("run/loop.py", "from mpipic.run.build import _place\n", PRIVATE),
    "a private name used": ("run/loop.py", "def f(error):\n    return error._code\n", PRIVATE),
    "a long file": ("run/loop.py", "x = 1\n" * 400, "no file above 400 lines"),
    "a long function": ("run/loop.py", "def f():\n" + HELD, "no function above 40 lines"),
    "a fragment": ("run/loop.py", 'def f():\n    """Of a run."""\n', "a docstring is a sentence"),
    "a fragment below a name": ("run/loop.py", 'x = 1\n"""What there is."""\n', "a docstring is a sentence"),
    "an unknown room": ("attic/box.py", "", "every room is on a floor"),
}


@pytest.mark.parametrize("planted", PLANTED)
def test_the_checker_finds_what_is_planted(tmp_path: Path, planted: str) -> None:
    file, text, rule = PLANTED[planted]
    (found,) = broken_rules(build(tmp_path, {file: text}))
    assert found.rule == rule
    assert found.file in (file, file.split("/")[0])
    assert str(found).startswith(f"{found.file}:{found.line}: ")


def test_a_fourteenth_room_is_one_too_many(tmp_path: Path) -> None:
    rooms = ("analysis", "study", "figures", "filters", "mapping", "particles", "mesh", "plots", "physics", "attic")
    files = {f"{room}/__init__.py": "" for room in rooms}
    found = [one.what for one in broken_rules(build(tmp_path, files))]
    assert found == ["14 rooms", "a room that the test does not know"]
