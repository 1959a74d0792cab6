"""Schemes by name, and the rules on which parts of a scheme go together."""

import copy

import pytest

from helpers import ROOT, mpipic
from mpipic import parts
from mpipic.scene.presets import PRESETS, with_preset
from mpipic.scene.records import Scene, SceneError
from scene_helpers import message, refused
from scheme_helpers import PARTS, covering, label, scene_of_scheme
from spline_helpers import Gas

SCHEME_SECTIONS = ("mapping", "filter", "damping")
every_preset = pytest.mark.parametrize("name", PRESETS)

OTHER = {
    "grid": {"cells": [12, 8]},
    "gas": {"flow": [0.3, -0.2]},
    "mapping": {
        "basis": "quadratic",
        "mass": "penalised",
        "penalty": 0.5,
        "tolerance": 1e-7,
        "gradient": "grid",
        "gradient_order": 4,
    },
    "filter": {"kind": "exact", "tolerance": 1e-6},
    "damping": {"order": 2, "strength": 3.0, "null_space": 0.25},
    "time": {"cfl": 0.1, "steps": 7, "integrator": "midpoint"},
}
"""A scene with a scheme that no preset has."""


def scheme_of(scene):
    """What a preset decides."""
    return *(getattr(scene, section) for section in SCHEME_SECTIONS), scene.time.integrator


# ---------------------------------------------------------------- presets


@every_preset
def test_a_preset_takes_the_place_of_the_scheme_and_of_nothing_else(name):
    scene, own = Scene.from_dict(with_preset(OTHER, name)), Scene.from_dict(OTHER)
    assert scheme_of(scene) == scheme_of(Scene.from_dict(PRESETS[name])) != scheme_of(own)
    assert (scene.grid, scene.gas, scene.initial, scene.particles) == (own.grid, own.gas, own.initial, own.particles)
    assert (scene.time.cfl, scene.time.dt, scene.time.steps) == (0.1, None, 7)


@every_preset
def test_a_preset_changes_neither_the_scene_s_data_nor_itself(name):
    data, presets = copy.deepcopy(OTHER), copy.deepcopy(PRESETS)
    with_preset(data, name)["time"]["steps"] = 9
    assert data == OTHER and presets == PRESETS


@every_preset
@pytest.mark.parametrize("cells", [[16], [8, 8], [4, 4, 4]])
def test_every_preset_makes_a_scene_in_any_dimension(name, cells):
    scene = Scene.load(None, [f"grid.cells={cells}"], preset=name)
    assert scene.dim == len(cells) and Scene.from_toml(scene.to_toml()) == scene


def test_the_recommended_scheme_is_the_one_that_it_says():
    scene = Scene.load(None, preset="recommended")
    mapping = {"basis": "cubic", "mass": "penalised", "penalty": 3.0, "penalty_order": 4}
    mapping |= {"tolerance": 1e-10, "gradient": "grid", "gradient_order": 10}
    assert scene.to_dict()["mapping"] == mapping
    assert scene.filter.kind == "exact" and scene.time.integrator == "rk4"
    assert (scene.damping.order, scene.damping.null_space) == (0, 1.0)


def test_the_paper_s_scheme_is_that_of_the_defaults():
    assert Scene.load(None, preset="paper") == Scene()
    assert scheme_of(Scene.from_dict(with_preset(OTHER, "paper"))) == scheme_of(Scene())


def test_a_preset_is_put_in_place_of_a_file_s_scheme_and_overrides_change_it(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text(Scene.from_dict(OTHER).to_toml())
    scene = Scene.load(file, ["damping.order=3", "filter.tolerance=1e-8", "time.dt=0.01"], preset="recommended")
    assert scene.name == "mine" and scene.grid.cells == (12, 8) and scene.time.steps == 7
    assert scene.mapping == Scene.load(None, preset="recommended").mapping
    assert (scene.damping.order, scene.damping.null_space, scene.filter.tolerance) == (3, 1.0, 1e-8)
    assert (scene.time.dt, scene.time.cfl, scene.time.integrator) == (0.01, None, "rk4")
    assert Scene.load(file) == Scene.from_dict(OTHER), "without one, the file's own holds"


def test_a_preset_does_not_hide_what_is_wrong_elsewhere_in_a_scene():
    broken = {**OTHER, "time": 3, "grid": {"cells": [0, 8]}}
    with pytest.raises(SceneError) as caught:
        Scene.from_dict(with_preset(broken, "recommended"))
    assert {problem.key for problem in caught.value.problems} == {"time", "grid.cells"}


@pytest.mark.parametrize(
    "name, suggestion",
    [("recomended", "recommended"), ("Paper", "paper"), ("papers", "paper"), ("qqq", None), ("", None)],
)
def test_an_unknown_preset_is_one_error_that_names_the_known_ones(name, suggestion, tmp_path):
    for path in (None, tmp_path / "not-there.toml"):
        with pytest.raises(SceneError) as caught:
            Scene.load(path, ["filter.kind=nonsense"], preset=name)
        (problem,) = caught.value.problems
        assert (problem.key, problem.choices, problem.suggestion) == ("--preset", tuple(PRESETS), suggestion)
        assert "must be one of recommended, paper" in str(problem)


def test_the_command_line_refuses_an_unknown_preset_in_one_line():
    ended = mpipic("check", "--preset", "recomended", timeout=60)
    assert ended.returncode == 2
    (line,) = ended.stderr.splitlines()
    assert '--preset = "recomended"' in line and 'Did you mean "recommended"?' in line


def test_the_recommended_configuration_holds_the_recommended_scheme():
    path = ROOT / "configs" / "recommended.toml"
    scene = Scene.load(path)
    assert scheme_of(scene) == scheme_of(Scene.load(None, preset="recommended"))
    assert Scene.load(path, preset="recommended") == scene
    assert scheme_of(Scene.load(path, preset="paper")) == scheme_of(Scene())


# ---------------------------------------------------------------- which parts go together


@pytest.mark.parametrize("scheme", covering(2), ids=label)
def test_schemes_whose_parts_go_together_make_scenes(scheme):
    scene = scene_of_scheme(scheme, (8,), (1.0,), Gas(1.0, 1.0, (0.1,)), 1e-3)
    assert Scene.from_toml(scene.to_toml()) == scene
    assert (scene.mapping.basis, scene.mapping.mass, scene.filter.kind) == (scheme.basis, scheme.mass, scheme.filter)
    assert (scene.mapping.gradient, scene.time.integrator) == (scheme.gradient, scheme.integrator)


def test_every_choice_is_among_the_parts():
    keys = {"basis": "mapping.basis", "mass": "mapping.mass", "gradient": "mapping.gradient"}
    keys |= {"filter": "filter.kind", "integrator": "time.integrator"}
    for part, key in keys.items():
        assert set(PARTS[part]) == set(parts.choices(key, "acoustics"))


RULES = [
    (
        ["mapping.gradient=skew", "filter.kind=none"],
        'mapping.gradient = "skew": needs filter.kind = local, order, chebyshev or exact; it is "none"',
    ),
    (["mapping.gradient=skew", "filter.kind=svd"], 'needs filter.kind = local, order, chebyshev or exact; it is "svd"'),
    (
        ["filter.kind=svd", "mapping.mass=penalised"],
        'filter.kind = "svd": svd needs mapping.mass = lumped or consistent',
    ),
    (["filter.kind=svd", "mapping.mass=penalised"], "use exact"),
    (["damping.order=4"], "damping.order = 4: needs mapping.mass = consistent or penalised"),
    (["damping.order=4", "mapping.gradient=grid"], "damping.order = 4: needs mapping.mass = consistent or penalised"),
    (["damping.order=2", "mapping.mass=consistent", "filter.kind=none"], "damping.order = 2: needs a filter"),
    (["damping.order=2", "mapping.mass=penalised", "filter.kind=none"], 'or mapping.gradient = "grid"'),
    (["damping.null_space=1"], "damping.null_space = 1.0: needs mapping.mass = consistent or penalised"),
    (
        ["damping.null_space=1", "mapping.mass=consistent", "filter.kind=none"],
        "damping.null_space = 1.0: needs a filter",
    ),
]


@pytest.mark.parametrize(
    "overrides, expected", RULES, ids=lambda value: " ".join(value) if isinstance(value, list) else ""
)
def test_parts_that_do_not_go_together_are_refused_and_say_what_would(overrides, expected):
    assert expected in message(*overrides)


ALLOWED = [
    ["mapping.gradient=skew", "filter.kind=local"],
    ["filter.kind=svd", "mapping.mass=consistent"],
    ["filter.kind=svd", "mapping.mass=penalised", "mapping.gradient=grid"],
    ["damping.order=4", "mapping.mass=consistent"],
    ["damping.null_space=0.5", "mapping.mass=consistent"],
    ["damping.null_space=0.5", "mapping.mass=consistent", "mapping.gradient=skew", "filter.kind=exact"],
    ["damping.order=4", "mapping.mass=penalised", "mapping.gradient=grid", "filter.kind=none"],
]


@pytest.mark.parametrize("overrides", ALLOWED, ids=" ".join)
def test_what_is_next_to_a_refusal_is_allowed(overrides):
    Scene.load(None, overrides)


def test_a_rule_is_silent_while_one_of_its_parts_is_wrong():
    error = refused({}, ["mapping.gradient=skew", "filter.kind=nothing", "damping.order=9"])
    assert [problem.key for problem in error.problems] == ["filter.kind", "damping.order"]


# ---------------------------------------------------------------- ranges

RANGES = {
    "mapping.penalty_order": (["mapping.mass=penalised"], (1, 8), (0, 9, -1), "a whole number from 1 to 8"),
    "damping.order": (["mapping.mass=penalised"], (0, 1, 8), (-1, 9), "a whole number from 0 to 8"),
    "mapping.gradient_order": (["mapping.gradient=grid"], (2, 12), (0, 3, 11, 14), "an even whole number from 2 to 12"),
}


@pytest.mark.parametrize("key", RANGES)
def test_orders_have_a_first_and_a_last_value(key):
    needed, good, bad, rule = RANGES[key]
    section, name = key.split(".")
    for value in good:
        assert getattr(getattr(Scene.load(None, [*needed, f"{key}={value}"]), section), name) == value
    for value in (*bad, 2.5, '"2"'):
        assert f"must be {rule}" in message(*needed, f"{key}={value}")
