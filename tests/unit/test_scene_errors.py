"""What is refused in a scene, what is only pointed out, and in which words."""

import pytest

from mpipic import parts
from mpipic.scene.records import Problem, Scene, SceneError
from mpipic.wording import closest
from scene_helpers import message, refused

CHOOSERS = [slot for slot in parts.slots("acoustics") if "." in slot]


def test_a_misspelt_choice_names_key_value_choices_and_the_closest():
    assert message("filter.kind=locale") == (
        'filter.kind = "locale": must be one of none, local, order, chebyshev, exact, svd. Did you mean "local"?'
    )
    (problem,) = refused({"filter": {"kind": "locale"}}).problems
    assert isinstance(problem, Problem)
    assert (problem.key, problem.value, problem.choices, problem.suggestion) == (
        *("filter.kind", "locale"),
        *(("none", "local", "order", "chebyshev", "exact", "svd"), "local"),
    )


def test_choices_are_those_that_this_version_can_do():
    assert {key: tuple(parts.choices(key, "acoustics")) for key in CHOOSERS} == {
        "physics.kind": ("acoustics",),
        "particles.layout": ("lattice", "jittered", "random", "file"),
        "initial.profile": ("gaussian", "plane-gaussian", "plane-wave", "standing-wave", "file"),
        "mapping.basis": ("linear", "quadratic", "cubic"),
        "mapping.mass": ("lumped", "consistent", "penalised"),
        "mapping.gradient": ("direct", "grid", "skew"),
        "filter.kind": ("none", "local", "order", "chebyshev", "exact", "svd"),
        "time.integrator": ("symplectic", "rk4", "midpoint"),
    }
    assert message("physics.kind=gas") == 'physics.kind = "gas": must be acoustics'


def test_what_cannot_be_done_yet_is_said_in_one_place():
    assert (
        message("output.checkpoint_every=4")
        == "output.checkpoint_every = 4: must be 0: checkpoints cannot be written yet"
    )
    assert Scene.load(None, ["output.checkpoint_every=0"]).output.checkpoint_every == 0
    assert "yet" not in message("particles.layout=clustered")


# --- keys that nothing uses -------------------------------------------------------------------------------------------

UNUSED = [
    (["particles.jitter=0.4"], 'particles.layout = "lattice" takes no jitter; jittered does'),
    (["particles.seed=3"], 'particles.layout = "lattice" takes no seed; jittered and random do'),
    (["particles.path=/x.h5"], 'particles.layout = "lattice" takes no path; file does'),
    (['particles.records=["velocity=vel"]'], 'particles.layout = "lattice" takes no records; file does'),
    (["particles.iteration=3"], 'particles.layout = "lattice" takes no iteration; file does'),
    (["particles.species=e"], 'particles.layout = "lattice" takes no species; file does'),
    (['particles.axes=["x"]'], 'particles.layout = "lattice" takes no axes; file does'),
    (
        ["initial.wave=[2]"],
        'initial.profile = "gaussian" takes no wave; plane-gaussian, plane-wave and standing-wave do',
    ),
    (
        ["initial.sharpness=3", "initial.profile=plane-wave"],
        'initial.profile = "plane-wave" takes no sharpness; gaussian and plane-gaussian do',
    ),
    (
        ["initial.center=[7.5]", "initial.profile=standing-wave"],
        'initial.profile = "standing-wave" takes no center; gaussian and plane-gaussian do',
    ),
    (["mapping.penalty=0.2"], 'mapping.mass = "lumped" takes no penalty; penalised does'),
    (["mapping.penalty_order=3"], 'mapping.mass = "lumped" takes no penalty_order; penalised does'),
    (["mapping.tolerance=0.001"], 'mapping.mass = "lumped" takes no tolerance; consistent and penalised do'),
    (["mapping.gradient_order=4"], 'mapping.gradient = "direct" takes no gradient_order; grid does'),
    (["filter.order=2"], 'filter.kind = "local" takes no order; order and chebyshev do'),
    (["filter.order=2", "filter.kind=svd"], 'filter.kind = "svd" takes no order; order and chebyshev do'),
    (["filter.tolerance=0.001"], 'filter.kind = "local" takes no tolerance; exact does'),
    (
        ["filter.tolerance=0.001", "mapping.mass=consistent", "time.integrator=midpoint"],
        'filter.kind = "local" takes no tolerance; exact does',
    ),
    (["damping.strength=2.0"], "damping.order = 0 takes no strength"),
    (["time.tolerance=0.001"], 'time.integrator = "symplectic" takes no tolerance; midpoint does'),
]


@pytest.mark.parametrize(
    ("overrides", "why"), UNUSED, ids=lambda value: " ".join(value) if isinstance(value, list) else ""
)
def test_a_key_that_nothing_uses_is_pointed_out_and_changes_nothing(overrides, why):
    scene = Scene.load(None, overrides)
    (unused,) = scene.unused
    key, value = overrides[0].split("=", 1)
    assert unused.key == key
    assert str(unused) in (f"{key} = {value} is not used: {why}", f'{key} = "{value}" is not used: {why}')
    assert scene == Scene.load(None, overrides[1:]) and not Scene.load(None, overrides[1:]).unused
    section, name = key.split(".")
    assert name not in scene.to_dict()[section] and not hasattr(getattr(scene, section), name)
    assert Scene.from_toml(scene.to_toml()).unused == ()


def test_every_key_that_some_choice_does_not_take_is_among_the_cases_above(tmp_path):
    (tmp_path / "p.h5").write_bytes(b"x")
    file = ["particles.layout=file", f"particles.path={tmp_path / 'p.h5'}"]
    never = set()
    for slot in CHOOSERS:
        for kind, part in parts.choices(slot, "acoustics").items():
            others = {
                one.dotted for other in parts.choices(slot, "acoustics").values() for one in other.keys().values()
            }
            assert Scene.load(None, [*(file if kind == "file" else []), f"{slot}={kind}"]).unused == ()
            never |= others - {one.dotted for one in part.keys().values()}
    assert never - {"particles.per_cell"} == {overrides[0].split("=")[0] for overrides, _ in UNUSED} - {
        "damping.strength"
    }


def test_particles_per_cell_are_not_used_for_particles_from_a_file(tmp_path):
    (tmp_path / "p.h5").write_bytes(b"x")
    more = ["particles.layout=file", f"particles.path={tmp_path / 'p.h5'}", "particles.per_cell=[3]"]
    (unused,) = Scene.load(None, more).unused
    assert str(unused).endswith('particles.layout = "file" takes no per_cell; lattice, jittered and random do')


def test_changing_the_filter_of_a_scene_leaves_its_settings_unused_and_valid():
    text = '[filter]\nkind = "order"\norder = 5\n'
    assert Scene.from_toml(text).filter.order == 5
    for kind in ("none", "local", "exact", "svd"):
        scene = Scene.from_toml(text, [f"filter.kind={kind}"])
        assert [one.key for one in scene.unused] == ["filter.order"] and scene == Scene.load(
            None, [f"filter.kind={kind}"]
        )


def test_what_nothing_uses_must_still_be_right():
    assert message("filter.order=0") == "filter.order = 0: must be a whole number from 1 to 1000"
    error = refused({}, ["filter.order=zero", "filter.tolerance=2", "mapping.penalty=-1"])
    assert [problem.key for problem in error.problems] == ["mapping.penalty", "filter.order", "filter.tolerance"]


def test_nothing_is_called_unused_while_what_would_use_it_is_wrong():
    assert [p.key for p in refused({}, ["filter.kind=ordr", "filter.order=3"]).problems] == ["filter.kind"]
    assert (
        Scene.load(None, ["damping.order=2", "mapping.mass=consistent", "damping.strength=2"]).damping.strength == 2.0
    )


# --- values that are wrong --------------------------------------------------------------------------------------------

BAD_VALUES = {
    "grid.cells": ["0", "[0]", "[]", "[1, 2, 3, 4]", "[1.0]", "[true]", '["8"]', "8", "[[8]]", "[9223372036854775808]"],
    "grid.length": ["[0]", "[-1]", "[inf]", "[nan]", "1.0", '["1"]', "[]"],
    "particles.per_cell": ["[0]", "[2.0]", "2", "[false]"],
    "particles.jitter": ["-0.1", "nan", "inf", "true", "[1]", "x"],
    "particles.seed": ["-1", "1.0", "9223372036854775808", "true"],
    "particles.path": ["3", "[]"],
    "particles.records": ["3", "[3]", "density=rho"],
    "particles.iteration": ["-1", "1.0", "true", "last"],
    "particles.species": ["3", "[]"],
    "particles.axes": ["x", "[1]", "[[]]"],
    "gas.sound_speed": ["0", "-1", "inf", "nan", "false"],
    "gas.density": ["0", "-1.5", "inf", "{a = 1}", "1979-05-27", "1" + "0" * 400],
    "gas.flow": ["[inf]", "[nan]", "0.05", "[true]", "[]"],
    "initial.center": ["[nan]", "0.5", '["a"]'],
    "initial.sharpness": ["0", "-60", "inf"],
    "initial.wave": ["[1.0]", "1", "[true]"],
    "mapping.penalty": ["0", "-1", "inf"],
    "mapping.penalty_order": ["0", "1.5"],
    "mapping.tolerance": ["0", "1", "nan"],
    "mapping.gradient_order": ["0", "3", "14", "10.0"],
    "filter.order": ["0", "-1", "2.0"],
    "filter.tolerance": ["0", "1", "nan", "-1e-10"],
    "damping.order": ["-1", "0.5", "true"],
    "damping.strength": ["0", "-1", "inf"],
    "damping.null_space": ["-1e-9", "inf", "nan"],
    "time.dt": ["0", "-1e-3", "inf", "nan", "[1]", "true"],
    "time.cfl": ["0", "-0.1", "inf", "nan"],
    "time.blow_up": ["1", "0.5", "inf", "-100", "nan"],
    "time.tolerance": ["0", "1", "x"],
    "time.steps": ["-1", "10.0", "1e3", "true", "many"],
    "output.every": ["-1", "1.5", "true"],
    "output.checkpoint_every": ["-1", "x"],
    "output.report_at": ["5", "[-1]", "[1.0]", "[true]"],
}


def test_every_key_that_is_not_a_choice_is_among_the_bad_values():
    keys = {f"{section}.{key}" for section, keys in parts.sections().items() for key in keys}
    assert set(BAD_VALUES) == keys - set(CHOOSERS)


@pytest.mark.parametrize("key", BAD_VALUES)
def test_a_value_of_the_wrong_type_or_range_is_refused_by_name(key):
    for value in BAD_VALUES[key]:
        text = message(f"{key}={value}")
        assert text.startswith(f"{key} = ") and ": must be " in text, value


@pytest.mark.parametrize("key", CHOOSERS)
def test_a_choice_that_is_no_name_is_refused_with_the_choices(key):
    for value in ("3", "true", '""', "[]"):
        text = message(f"{key}={value}")
        assert all(name in text for name in parts.choices(key, "acoustics")), value


def test_a_number_in_quotes_is_recognised():
    assert message("time.dt=.5").endswith("must be a finite number above 0; this is text, the number is 0.5")
    assert message('time.steps="80"').endswith("this is text, the number is 80")


CROSS = [
    (["grid.cells=[8, 8]", "grid.length=[1.0]"], "grid.length", "must have as many entries as grid.cells, 2; it has 1"),
    (["gas.flow=[1, 1]"], "gas.flow", "must have as many entries as grid.cells, 1; it has 2"),
    (["initial.center=[0.1, 0.1]"], "initial.center", "must have as many entries as grid.cells"),
    (["initial.profile=plane-wave", "initial.wave=[1, 0]"], "initial.wave", "must have as many entries as grid.cells"),
    (["particles.per_cell=[2, 2]"], "particles.per_cell", "must have as many entries as grid.cells"),
    (["particles.layout=jittered", "particles.per_cell=[2, 2]"], "particles.per_cell", "must have as many entries"),
    (
        ["grid.cells=[8, 8]", "particles.layout=random", "particles.per_cell=[2, 2]"],
        *("particles.per_cell", "must be a list of exactly 1 entry, a whole number, 1 or above, for example [4]"),
    ),
    (["grid.cells=[2147483648]"], "grid.cells", "must be fewer than 2^31 = 2147483648 cells"),
    (["grid.cells=[2048, 1024, 1024]"], "grid.cells", "must be fewer than 2^31"),
    (["grid.length=[5e-324]"], "grid.length", "is out of the range of floating point"),
    (["grid.cells=[2, 2]", "grid.length=[1e-200, 1e-200]"], "grid.length", "is out of the range of floating point"),
    (
        ["grid.cells=[1]", "particles.per_cell=[9007199254740992]"],
        "particles.per_cell",
        "must give fewer than 2^53 particles",
    ),
    (
        ["particles.layout=jittered", "particles.jitter=201"],
        "particles.jitter",
        "must be at most 200 particle spacings",
    ),
    (["initial.profile=plane-wave", "initial.wave=[0]"], "initial.wave", "must not be zero on every axis"),
    (["initial.profile=plane-gaussian", "initial.wave=[0]"], "initial.wave", 'initial.profile = "plane-gaussian"'),
    (["initial.profile=standing-wave", "initial.wave=[0]"], "initial.wave", "must not be zero on every axis"),
    (["initial.center=[1.5]"], "initial.center", "must lie in the box, from 0 to grid.length = [1.0]"),
    (["initial.sharpness=1e308", "grid.length=[10]"], "initial.sharpness", "is out of the range of floating point"),
    (["initial.profile=file"], "initial.profile", 'needs particles.layout = "file"; it is "lattice"'),
    (["gas.sound_speed=1e200"], "gas.sound_speed", "is out of the range of floating point"),
    (["gas.sound_speed=1e-200"], "gas.sound_speed", "is out of the range of floating point"),
    (["time.dt=1e-3", "time.cfl=0.1"], "time.cfl", "give either time.dt or time.cfl, not both; time.dt is 0.001"),
    (["time.dt=5e-324"], "time.dt", "is out of the range of floating point"),
    (["time.dt=1e307"], "time.dt", "is out of the range of floating point"),
    (["time.cfl=1e-310"], "time.cfl", "is out of the range of floating point"),
    (["gas.flow=[1e308]", "time.dt=1e3"], "time.dt", "is out of the range of floating point"),
    (["output.report_at=[3, 1001]"], "output.report_at", "must hold steps from 0 to time.steps = 1000"),
    (["time.steps=0", "output.report_at=[1]"], "output.report_at", "must hold steps from 0 to time.steps = 0"),
]


@pytest.mark.parametrize(
    ("overrides", "key", "rule"), CROSS, ids=lambda value: value[-1] if isinstance(value, list) else ""
)
def test_values_that_do_not_go_together_are_refused(overrides, key, rule):
    text = message(*overrides)
    assert text.startswith(f"{key} = ") and rule in text


@pytest.mark.parametrize(
    "overrides",
    [
        ["grid.cells=[2147483647]"],
        ["grid.cells=[1]", "particles.per_cell=[9007199254740991]"],
        ["particles.layout=jittered", "particles.jitter=200"],
        ["particles.layout=jittered", "particles.seed=9223372036854775807"],
        ["initial.center=[1.0]"],
        ["initial.profile=standing-wave", "grid.cells=[4, 4]", "initial.wave=[0, -3]"],
        ["time.steps=0", "output.report_at=[0]"],
        ["gas.flow=[-3.5]"],
        ["output.every=5000"],
    ],
    ids=lambda overrides: overrides[-1],
)
def test_the_last_allowed_value_is_allowed(overrides):
    assert Scene.load(None, overrides).to_toml()


def test_both_time_steps_in_one_file_are_refused():
    assert "not both" in str(refused("[time]\ndt = 1e-3\ncfl = 0.1\n"))


def test_a_rule_is_silent_while_the_keys_that_it_needs_are_wrong():
    error = refused(
        {}, ["grid.cells=[8, 0]", "time.steps=-1", "output.report_at=[5000]", "filter.kind=x", "filter.order=3"]
    )
    assert [problem.key for problem in error.problems] == ["grid.cells", "filter.kind", "time.steps"]
    error = refused({}, ["grid.cells=[8, 0]", "gas.flow=[1, 2, 3]"])
    assert "as many entries as grid.cells, 2; it has 3" in str(error)


@pytest.mark.parametrize("wrong", [f"{slot}={value}" for slot in CHOOSERS for value in ("nonsense", "[1]", "{a=1}")])
def test_any_wrong_name_leaves_the_rest_checked(wrong):
    """The rules of damping, of the time step and of reports look at other parts."""
    more = ["damping.order=4", "mapping.mass=lumped", "time.cfl=0.1", "output.report_at=[5000]", "grid.length=[0]"]
    more = [text for text in more if text.split("=")[0] != wrong.split("=")[0]]
    found = {problem.key for problem in refused({}, [*more, wrong]).problems}
    assert found >= {wrong.split("=")[0], "grid.length", "output.report_at"}


def test_everything_wrong_is_reported_at_once_in_the_order_of_the_scene():
    text = """
        speed = 3
        [grid]
        cells = [8, 8]
        lenght = [1.0, 1.0]
        [particles]
        layout = "random"
        per_cell = [2, 2]
        [filtr]
        kind = "local"
        [initial]
        sharpness = -1
        [mapping]
        basis = "quintic"
        [time]
        dt = "fast"
        steps = 10
        [output]
        report_at = [11]
    """
    error = refused(text, ["time.blow_up=0", "nonsense", "gas.density=nan"])
    keys = ["--set nonsense", "speed", "filtr", "grid.lenght", "particles.per_cell", "gas.density", "initial.sharpness"]
    keys += ["mapping.basis", "time.dt", "time.blow_up", "output.report_at"]
    assert [problem.key for problem in error.problems] == keys


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            "[filtr]",
            'filtr: there is no such section; the sections are physics, grid, particles, .*Did you mean "filter"',
        ),
        (
            "[grid]\nlenght = [2]",
            r'grid.lenght = \[2\]: there is no such key; \[grid\] has cells, length.*"grid.length"',
        ),
        ("[initial]\nseed = 3", 'Did you mean "particles.seed"'),
        ("steps = 3", 'steps = 3: there is no such section.*Did you mean "time.steps"'),
        ("[Filter]\nkind = 'none'", 'Did you mean "filter"'),
        ("[initial]\nprofile = 'Plane_Wave'", 'Did you mean "plane-wave"'),
        ("[[grid]]", r"grid = \[\{\}\]: must be a section, \[grid\], with cells, length"),
        ("grid = 3", r"grid = 3: must be a section"),
        ("[grid.cells]\nx = 1", r"grid.cells = \{x = 1\}: must be a list"),
        ('["a b\\u001b"]', r'"a b\\x1b": there is no such section'),
        ('[time]\n"\\u202e" = 1', r'time."\\u202e" = 1: there is no such key'),
    ],
)
def test_unknown_names_are_refused_with_the_closest_known_one(text, expected):
    with pytest.raises(SceneError, match=expected):
        Scene.from_toml(text)
    assert len(refused(text).problems) == 1


def test_nothing_far_off_is_suggested():
    assert refused("[zzz]").problems[0].suggestion is None
    assert closest("qqq", ("none", "local")) is None and closest(3, ("none",)) is None
    assert closest("LOCAL ", ("none", "local")) == "local"


def test_of_two_keys_that_exclude_each_other_a_wrong_value_is_blamed_once():
    with pytest.raises(SceneError) as caught:
        Scene.from_dict({"time": {"cfl": -0.1, "dt": "x"}})
    assert sorted(problem.key for problem in caught.value.problems) == ["time.cfl", "time.dt"]


def test_lists_nested_too_deeply_are_a_wrong_value():
    nested: list = []
    for _ in range(5000):
        nested = [nested]
    with pytest.raises(SceneError, match=r"grid.cells = \S+: must be a list of 1 to 3 whole numbers"):
        Scene.from_dict({"grid": {"cells": nested}})
