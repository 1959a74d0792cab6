"""Claims about parts: each owns its settings, so that a new one is found wherever parts are read."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from itertools import combinations

import numpy as np
import pytest
from mpi4py import MPI

import mpipic
from helpers import ROOT
from helpers import mpipic as command
from mpipic import parts
from mpipic.filters import FILTERS, NodalFilter, create
from mpipic.keys import FROM_1, ByScene, Count, Keys, key
from mpipic.mapping.mapping import Mapping
from mpipic.parts import Part, Values, rule
from mpipic.physics.base import KINDS
from mpipic.run.build import PHYSICS
from mpipic.run.describe import describe, left_out
from mpipic.run.loop import Simulation
from mpipic.scene.records import Scene
from mpipic.scene.table import keys_as_markdown
from scene_helpers import message

CHOOSERS = [slot for slot in parts.slots("acoustics") if "." in slot]
every_part = pytest.mark.parametrize("part", parts.registered(), ids=lambda part: f"{part.slot} {part.kind}".strip())


# ---------------------------------------------------------------- all of them


@every_part
def test_a_part_says_what_it_is_and_what_its_keys_must_be(part: type[Part]) -> None:
    assert part.about and "\n" not in part.about and not part.about.endswith(".")
    for name, one in part.keys().items():
        assert one.dotted == f"{part.section()}.{name}" and one.rule and one.meaning
        assert one.meaning[0] not in " (" and not one.meaning.endswith(".")


@pytest.mark.parametrize("slot", CHOOSERS)
def test_every_choice_has_one_default(slot: str) -> None:
    found = [kind for kind, part in parts.choices(slot, "acoustics").items() if vars(part).get("is_default")]
    assert found == [parts.default_of(slot, "acoustics")]


def test_no_two_parts_of_a_scene_take_the_same_key() -> None:
    for one, other in combinations(parts.registered(), 2):
        if one.section() == other.section() and one.slot != other.slot:
            own = {*one.keys(), one.slot.split(".")[-1]}
            assert own.isdisjoint({*other.keys(), other.slot.split(".")[-1]}), (one, other)


@every_part
def test_rules_name_keys_that_there_are(part: type[Part]) -> None:
    known = {f"{section}.{name}" for section, names in parts.sections().items() for name in names}
    assert all(set(one.keys) <= known for one in part.rules())


def test_every_physics_that_scenes_can_name_has_a_builder() -> None:
    assert set(PHYSICS) == set(KINDS) == set(parts.choices("physics.kind", None))


def test_a_second_part_of_the_same_name_is_refused() -> None:
    before = parts.registered()
    with pytest.raises(ValueError, match=r"there is a part filter\.kind = 'local' already"):

        class Again(NodalFilter):
            kind = "local"

    assert parts.registered() == before


# ---------------------------------------------------------------- a new one


@pytest.fixture
def toy() -> Iterator[type[NodalFilter]]:
    """A filter as somebody else might write it: the local one, `times` over."""

    class TwiceFilter(NodalFilter):
        kind = "twice"
        about = "the local filter, several times over"
        brings_in = ("filter", "patience")

        class Settings(Keys):
            times: Count = key(ByScene("1, in 3D 2", lambda v: 1 + (v.dim == 3), ("grid.cells",)), FROM_1, "how often")

        @rule("filter.times", "grid.cells")
        @staticmethod
        def not_more_often_than_cells(v: Values) -> parts.Broken | None:
            most = v.cell_count
            return ("filter.times", f"must be at most {most}") if v["filter.times"] > most else None

        @classmethod
        def describe(cls, v: Values) -> str:
            return f"twice: {v['filter.times']} times"

        @classmethod
        def node_doubles(cls, v: Values) -> int:
            return 1000

        def __init__(self, mapping, times=1):
            super().__init__(mapping)
            self.times = times

        def coefficients(self, sums, out=None, series=None):
            means = self.mapping.divide(sums)
            for _ in range(1, self.times):
                means = self.mapping.divide(self.mapping.gram.apply(means))
            if out is None:
                return means
            out[...] = means
            return out

    yield TwiceFilter
    parts.forget(TwiceFilter)
    assert "twice" not in FILTERS


TOY = ["filter.kind=twice", "filter.times=2"]


def test_a_new_filter_is_a_choice_with_its_own_keys_defaults_and_rules(toy: type[NodalFilter]) -> None:
    scene = Scene.load(None, TOY)
    assert scene.to_dict()["filter"] == {"kind": "twice", "times": 2} and Scene.from_toml(scene.to_toml()) == scene
    assert scene.part("filter.kind") is toy and scene.settings("filter.kind") == {"times": 2}
    for dim in (1, 2, 3):
        other = Scene.from_dict({"grid": {"cells": [4] * dim}, "filter": {"kind": "twice"}})
        assert other.filter.times == (2 if dim == 3 else 1)
    assert message("filter.kind=twice", "filter.times=0") == "filter.times = 0: must be a whole number, 1 or above"
    assert message("filter.kind=twice", "filter.times=101") == "filter.times = 101: must be at most 100"
    assert "chebyshev, exact, svd, twice" in message("filter.kind=twise")
    (unused,) = Scene.load(None, ["filter.times=3"]).unused
    assert str(unused) == 'filter.times = 3 is not used: filter.kind = "local" takes no times; twice does'


def test_a_new_filter_is_in_what_check_says(toy: type[NodalFilter]) -> None:
    scene = Scene.load(None, TOY)
    lines = dict(describe(scene, MPI.COMM_SELF))
    assert lines["filter"] == "twice: 2 times"
    assert "patience" not in lines["left out"].split(", ") and "patience" in left_out(Scene())
    bare = dict(describe(Scene(), MPI.COMM_SELF))
    node_bytes = [int(text["memory"].split(" bytes a node")[0].split()[-1]) for text in (lines, bare)]
    assert node_bytes[0] - node_bytes[1] == 8000


def test_a_new_filter_is_in_the_table_of_keys(toy: type[NodalFilter]) -> None:
    table = keys_as_markdown().splitlines()
    assert "| `filter.times` | 1, in 3D 2 | a whole number, 1 or above | twice | how often |" in table
    assert "| `twice` | the local filter, several times over |" in table


def test_a_new_filter_is_in_the_registry_and_runs(toy: type[NodalFilter]) -> None:
    assert FILTERS["twice"] is toy and list(FILTERS)[-1] == "twice" and "none" not in FILTERS
    simulation = Simulation(Scene.load(None, [*TOY, "time.steps=2"]), MPI.COMM_SELF)
    mapping = Mapping.at(simulation.grid, simulation.particles)
    q = np.sin(np.arange(200.0))
    local = create("local", mapping, {})
    np.testing.assert_allclose(create("twice", mapping, {"times": 2}).apply(q), local.apply(local.apply(q)), atol=1e-14)
    simulation.physics.step()
    assert np.any(simulation.particles["velocity"])
    simulation.close()


# ---------------------------------------------------------------- another physics


@pytest.fixture
def waterless() -> Iterator[None]:
    """A physics with a section of its own, whose signals are not known."""

    class Waterless(Part):
        slot = "physics.kind"
        kind = "waterless"
        about = "nothing moves"

    class Desert(Part):
        slot = "desert"
        physics = "waterless"
        about = "sand"

        class Settings(Keys):
            dunes: Count = key(3, FROM_1, "dunes on the way")

    yield
    parts.forget(Desert)
    parts.forget(Waterless)


def test_a_physics_brings_sections_of_its_own_and_those_of_others_are_unused(waterless: None) -> None:
    scene = Scene.load(None, ["physics.kind=waterless", "desert.dunes=5", "gas.density=2.0"])
    assert scene.desert.dunes == 5 and "gas" not in scene.to_dict() and "initial" not in scene.to_dict()
    assert list(scene.to_dict()) == ["physics", "grid", "particles", "desert", "mapping", "filter", "time", "output"]
    assert Scene.from_toml(scene.to_toml()) == scene
    (unused,) = scene.unused
    assert str(unused) == 'gas.density = 2.0 is not used: physics.kind = "waterless" has no gas.density'
    (unused,) = Scene.load(None, ["desert.dunes=5"]).unused
    assert str(unused) == 'desert.dunes = 5 is not used: physics.kind = "acoustics" has no desert.dunes'
    assert message("desert.dunes=0") == "desert.dunes = 0: must be a whole number, 1 or above"
    assert message("desert.dune=1").endswith('[desert] has dunes. Did you mean "desert.dunes"?')


def test_a_step_in_cells_that_signals_travel_needs_signals(waterless: None) -> None:
    assert message("physics.kind=waterless", "time.cfl=0.1") == (
        'time.cfl = 0.1: needs signals, which physics.kind = "waterless" has none of: give time.dt'
    )
    assert Scene.load(None, ["physics.kind=waterless", "time.dt=0.1"]).dt == 0.1


# ---------------------------------------------------------------- the door and the table


def test_the_public_scene_knows_every_part() -> None:
    assert mpipic.Scene is Scene
    scene = mpipic.Scene.load(None, preset="recommended")
    assert pickle.loads(pickle.dumps(scene)) == scene


def test_the_table_in_the_documentation_is_that_of_the_code() -> None:
    file = ROOT / "docs" / "scene-keys.md"
    assert file.read_text() == keys_as_markdown(), "write it anew: mpipic check --keys > docs/scene-keys.md"
    ended = command("check", "--keys", timeout=60)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, file.read_text(), "")
    assert all(f"`{section}.{name}`" in ended.stdout for section, names in parts.sections().items() for name in names)
