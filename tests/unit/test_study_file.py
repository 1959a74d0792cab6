"""Claims about study files: every mistake at once, and points that all end at the same time."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mpipic.scene.records import Scene, SceneError
from mpipic.study.file import Study, load
from mpipic.study.points import differing, fit_steps, unused, words

AXES = """
until = 0.5
[axes]
filter.kind = ["local", "exact"]
"grid.cells" = [[8], [16]]
ranks = [1, 2]
"""


def study_of(folder: Path, text: str) -> Study:
    path = folder / "sweep.toml"
    path.write_text(text)
    return load(path)


def refused(folder: Path, text: str) -> list[str]:
    with pytest.raises(SceneError) as caught:
        study_of(folder, text)
    lines = str(caught.value).split("\n")
    assert len(lines) == len(caught.value.problems) and all(line.isprintable() for line in lines)
    return lines


def test_axes_make_their_full_product(tmp_path: Path) -> None:
    study = study_of(tmp_path, AXES)
    assert study.name == study.title == "sweep"
    found = [(point.scene.filter.kind, point.scene.grid.cells, point.ranks) for point in study.points]
    assert found == [(k, (n,), r) for k in ("local", "exact") for n in (8, 16) for r in (1, 2)]
    assert study.points[0].values == {"filter.kind": "local", "grid.cells": [8], "ranks": 1}
    assert study.points[3].label == "local, 2 ranks, 16 cells"
    assert len({point.id for point in study.points}) == 8


def test_schemes_set_several_keys_together_and_meet_every_axis(tmp_path: Path) -> None:
    text = """
    until = 0.5
    [base]
    time.cfl = 0.25
    ranks = 2
    [axes]
    grid.cells = [[8], [16]]
    layout = [
        { name = "ordered" },
        { name = "wild", particles.layout = "jittered", "particles.jitter" = 0.3 },
    ]
    [[scheme]]
    name = "plain"
    filter.kind = "none"
    [[scheme]]
    name = "many terms"
    "filter.kind" = "order"
    [scheme.filter]
    order = 5
    """
    with pytest.raises(SceneError, match=r"set twice|already|second"):
        study_of(tmp_path, text.replace("[scheme.filter]", '[scheme.filter]\nkind = "order"'))
    study = study_of(tmp_path, text)
    assert [point.label for point in study.points[:3]] == [
        "plain, ordered, 8 cells", "plain, wild, 8 cells", "plain, ordered, 16 cells",
    ]  # fmt: skip
    last = study.points[-1]
    assert (last.scene.filter.order, last.scene.particles.jitter, last.ranks) == (5, 0.3, 2)
    assert last.values == {"scheme": "many terms", "grid.cells": [16], "layout": "wild"}
    assert list(differing(study.points)) == [
        "grid.cells", "particles.layout", "particles.jitter", "particles.seed", "filter.kind", "filter.order",
        "time.dt", "time.steps",
    ]  # fmt: skip


def test_every_point_ends_at_until_with_no_longer_steps_than_asked(tmp_path: Path) -> None:
    text = (
        "until = 0.7\n[axes]\ntime.cfl = [0.1, 0.3, 0.9]\ngrid.cells = [[7], [13], [100]]\ngas.sound_speed = [1.0, 3.0]"
    )
    for point in study_of(tmp_path, text).points:
        time = point.scene.time
        assert time.dt is not None and time.steps * time.dt == 0.7
        asked = point.values["time.cfl"] / point.values["grid.cells"][0] / point.values["gas.sound_speed"]
        assert asked / 1.05 < time.dt <= asked * (1 + 1e-12) or time.steps < 20
        assert (time.steps - 10) * asked < 0.7, "hardly more steps than needed"
        assert point.scene.output.report_at == ()


@given(st.floats(1e-6, 1e6), st.floats(1e-4, 2.0))
def test_steps_times_dt_is_until_to_the_last_bit(until: float, share: float) -> None:
    steps, dt = fit_steps(until, share * until)
    assert steps * dt == until
    assert dt <= share * until * (1 + 1e-11) and (steps - 40) * share < 1


def test_a_base_scene_is_found_from_the_study_file_and_loses_its_reports(tmp_path: Path) -> None:
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "a.toml").write_text(
        "[grid]\ncells = [20]\n[time]\ncfl = 0.5\nsteps = 900\n[output]\nreport_at = [800]\nevery = 7"
    )
    (tmp_path / "studies").mkdir()
    study = study_of(tmp_path / "studies", 'scene = "../scenes/a.toml"\nuntil = 1.0\n[base]\ntime.dt = 0.1')
    (point,) = study.points
    assert point.scene.grid.cells == (20,) and point.scene.time.steps == 10
    assert point.scene.output == Scene.from_dict({}).output
    assert point.label == "the only point"


def test_the_digest_knows_scene_and_ranks_and_nothing_else(tmp_path: Path) -> None:
    first = study_of(tmp_path, AXES)
    renamed = study_of(tmp_path, AXES.replace("until", 'title = "x"\ntimeout = 5\nrepeats = 9\nuntil'))
    assert [p.id for p in first.points] == [p.id for p in renamed.points]
    later = study_of(tmp_path, AXES.replace("0.5", "0.75"))
    assert {p.id for p in first.points}.isdisjoint(p.id for p in later.points)


def test_what_nothing_uses_is_said_once_with_the_points_that_say_it(tmp_path: Path) -> None:
    study = study_of(tmp_path, 'until = 0.5\n[axes]\nfilter.kind = ["order", "local"]\nfilter.order = [2, 5]')
    assert [point.scene.filter.to_dict() for point in study.points] == [
        {"kind": "order", "order": 2}, {"kind": "order", "order": 5}, {"kind": "local"}, {"kind": "local"},
    ]  # fmt: skip
    why = 'is not used: filter.kind = "local" takes no order; order and chebyshev do'
    assert unused(study.points) == [
        f'filter.order = 2 {why} (in 1 of 4 points, such as "local, order 2")',
        f'filter.order = 5 {why} (in 1 of 4 points, such as "local, order 5")',
    ]


def test_every_mistake_is_named_once_with_key_value_and_rule(tmp_path: Path) -> None:
    text = """
    untill = 1.0
    repeats = 0
    error = "density.l3"
    timeout = "long"
    scene = "nothere.toml"
    [axes]
    filter.kind = []
    particles.per_cell = [[2], [2]]
    layout = ["lattice"]
    time.steps = [10]
    [base]
    output.every = 5
    kind = "local"
    [[scheme]]
    filter.kind = "none"
    """
    lines = refused(tmp_path, text)
    expected = [
        "untill: there is no such key; a study has title, scene, until,",
        "until: must be a finite number above 0, the physical time",
        "repeats = 0: must be a whole number from 1 to 1000",
        'error = "density.l3": must be one of density.l1, density.l2',
        'timeout = "long": must be a finite number of seconds above 0',
        "nothere.toml: cannot be read: No such file or directory",
        "axes: filter.kind = []: must be a list of at least one value",
        "axes: particles.per_cell = [[2], [2]]: must not hold a value twice",
        'axes: layout = ["lattice"]: must be a scene key, ranks, or a list of tables',
        "axes: time.steps = [10]: is the study's own",
        "base: output.every = 5: is the study's own",
        'base: kind = "local": must be a scene key, section.key',
        "[[scheme]]",
    ]
    for text in expected:
        assert sum(text in line for line in lines) == 1, (text, lines)
    assert len(lines) == len(expected)


def test_bad_points_are_all_found_before_anything_runs_and_each_mistake_appears_once(tmp_path: Path) -> None:
    text = """
    until = 1.0
    repeats = -1
    [base]
    gas.flwo = [1.0]
    [axes]
    filter.kind = ["local", "locl"]
    filter.order = [2, 5]
    grid.cells = [[8], [8, 8], 8]
    ranks = [1, 0, 7]
    """
    lines = refused(tmp_path, text)
    expected = [
        "repeats = -1",
        "gas.flwo = [1.0]: there is no such key",
        'filter.kind = "locl": must be one of',
        "grid.cells = 8: must be a list",
    ]
    for part in expected:
        assert sum(part in line for line in lines) == 1, (part, lines)
    assert "(in every point)" in next(line for line in lines if "flwo" in line)
    assert "(in 18 of 36 points, such as" in next(line for line in lines if "locl" in line)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("ranks = [1, 0]", "ranks = 0: must be a whole number, 1 or above (in 1 of 2 points"),
        ("ranks = [true]", "ranks = true: must be a whole number"),
        ("ranks = [101]", "number of ranks = 101: cannot divide"),
        ("initial.profile = ['file']", 'needs particles.layout = "file"'),
        ("time.dt = [1e-12]", "makes more than 1000000000 steps"),
        ("'a.b.c' = [1]", "axes: a.b.c = [1]: must be a scene key"),
        ("layout = [{ name = 'a' }, { name = 'a' }]", "every one needs a name"),
        (
            "layout = [{ name = 'a', filter.kind = 'none' }]\nfilter.kind = ['local']",
            "is set by layout and by filter.kind",
        ),
    ],
)
def test_what_a_point_cannot_have_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (line,) = refused(tmp_path, f"until = 1.0\n[axes]\n{text}")
    assert message in line


def test_a_file_that_is_no_toml_is_refused_with_its_line(tmp_path: Path) -> None:
    (line,) = refused(tmp_path, "until = 1.0\n[axes\n")
    assert "sweep.toml: not valid TOML at line 2" in line
    with pytest.raises(SceneError, match="cannot be read"):
        load(tmp_path / "none.toml")


@pytest.mark.parametrize(
    ("key", "value", "text"),
    [
        ("grid.cells", [64], "64 cells"),
        ("grid.cells", [8, 4], "8 x 4 cells"),
        ("particles.per_cell", [2, 2], "2 x 2 a cell"),
        ("time.cfl", 0.1, "CFL 0.1"),
        ("ranks", 1, "1 rank"),
        ("ranks", 2, "2 ranks"),
        ("filter.kind", "exact", "exact"),
        ("mapping.penalty_order", 4, "penalty order 4"),
    ],
)
def test_labels_are_words(key: str, value: object, text: str) -> None:
    assert words(key, value) == text


def test_the_studies_that_come_with_the_package_are_right() -> None:
    folder = Path(__file__).parents[2] / "configs" / "studies"
    names = {path.stem for path in folder.glob("*.toml")}
    assert {"filters-1d", "family-1d", "standing-wave-2d", "plane-wave-3d", "low-mach"} <= names
    for path in folder.glob("*.toml"):
        study = load(path)
        assert len(study.points) > 1 and study.settings.title
        assert path.read_text().startswith("# ")
