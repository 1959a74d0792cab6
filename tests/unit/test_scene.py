"""Reading scenes: defaults, dimensions, overrides, round trip, derived quantities, and the scenes in configs/."""

import math
import os
import pickle
import subprocess
import sys
import tomllib
from dataclasses import FrozenInstanceError
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mpipic import parts
from mpipic.decomposition import process_grid
from mpipic.run.ranks import check_ranks
from mpipic.scene.records import Scene, SceneError

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = sorted((ROOT / "configs").glob("*.toml"))
DEFAULTS = {
    "physics": {"kind": "acoustics"},
    "grid": {"cells": [100], "length": [1.0]},
    "particles": {"layout": "lattice", "per_cell": [2]},
    "gas": {"sound_speed": 1.0, "flow": [0.05], "density": 1.0},
    "initial": {"profile": "gaussian", "center": [0.5], "sharpness": 60.0},
    "mapping": {"basis": "linear", "mass": "lumped", "gradient": "direct"},
    "filter": {"kind": "local"},
    "damping": {"order": 0, "null_space": 0.0},
    "time": {"dt": 1.25e-3, "blow_up": 100.0, "steps": 1000, "integrator": "symplectic"},
    "output": {"every": 0, "checkpoint_every": 0, "report_at": []},
}


def test_the_defaults_are_the_reference_scene():
    scene = Scene.load(None)
    assert scene.to_dict() == DEFAULTS and list(scene.to_dict()) == list(DEFAULTS)
    assert (scene.name, scene.dim, scene.h, scene.cell_count, scene.particle_count) == ("paper", 1, (0.01,), 100, 200)
    assert scene.time.cfl is None
    assert (scene.dt, scene.cfl, scene.duration) == (1.25e-3, pytest.approx(0.125), pytest.approx(1.25))
    assert Scene.from_toml("") == scene == Scene()


def test_a_scene_and_its_sections_cannot_be_changed():
    scene = Scene.load(None)
    with pytest.raises(FrozenInstanceError):
        scene.grid = None
    with pytest.raises(AttributeError, match="frozen"):
        scene.grid.cells = (3,)
    with pytest.raises(AttributeError, match="no section grids"):
        scene.grids  # noqa: B018
    with pytest.raises(AttributeError, match="no chosen part has a key order"):
        scene.filter.order  # noqa: B018
    assert isinstance(scene.grid.cells, tuple) and isinstance(scene.output.report_at, tuple)
    assert hash(scene) == hash(Scene.load(None))


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_what_is_not_given_gets_a_default_for_the_dimension(dim):
    scene = Scene.from_dict({"grid": {"cells": [8] * dim}})
    assert scene.dim == dim
    assert scene.grid.length == (1.0,) * dim
    assert scene.gas.flow == (0.05, 0.0, 0.0)[:dim]
    assert scene.initial.center == (0.5,) * dim
    plane = Scene.from_dict({"grid": {"cells": [8] * dim}, "initial": {"profile": "plane-wave"}})
    assert plane.initial.wave == (1, 0, 0)[:dim]
    assert scene.particles.per_cell == (2,) * dim
    assert (scene.cell_count, scene.particle_count) == (8**dim, 16**dim)
    standing = Scene.from_dict({"grid": {"cells": [8] * dim}, "initial": {"profile": "standing-wave"}})
    assert standing.initial.wave == (1,) * dim
    random = Scene.from_dict({"grid": {"cells": [8] * dim}, "particles": {"layout": "random"}})
    assert random.particles.per_cell == ((2,) if dim == 1 else (4,))
    assert random.particle_count == 8**dim * random.particles.per_cell[0]


def test_the_center_is_the_middle_of_the_box_in_1d_too():
    assert Scene.from_toml("[grid]\nlength = [3]").initial.center == (1.5,)
    assert Scene.from_toml("[grid]\ncells = [4, 4]\nlength = [3, 5.0]").initial.center == (1.5, 2.5)


def test_a_whole_number_serves_where_a_float_is_meant_and_is_stored_as_float():
    scene = Scene.load(None, ["gas.density=2", "gas.flow=[1]"])
    assert type(scene.gas.density) is float and type(scene.gas.flow[0]) is float
    assert "density = 2.0" in scene.to_toml()


def test_cfl_and_dt_follow_from_each_other_over_the_smallest_spacing():
    data = {"grid": {"cells": [10, 40], "length": [1.0, 2.0]}, "gas": {"sound_speed": 2.0}}
    by_cfl = Scene.from_dict({**data, "time": {"cfl": 0.4, "steps": 10}})
    assert by_cfl.dt == pytest.approx(0.4 * 0.05 / 2.0) and by_cfl.cfl == 0.4
    assert by_cfl.time.dt is None and by_cfl.duration == 10 * by_cfl.dt
    assert Scene.from_dict({**data, "time": {"dt": by_cfl.dt}}).cfl == pytest.approx(0.4)


def test_numbers_of_numpy_are_numbers():
    data = {"grid": {"cells": np.array([8, 4])}, "gas": {"flow": [np.float64(0.1), np.float32(0.5)]}}
    data |= {"time": {"steps": np.int64(7), "dt": np.float64(1e-3)}, "output": {"report_at": np.arange(3)}}
    scene = Scene.from_dict(data)
    assert scene.to_dict()["grid"]["cells"] == [8, 4] and scene.gas.flow == (0.1, 0.5)
    assert (type(scene.time.steps), type(scene.time.dt), type(scene.output.report_at[1])) == (int, float, int)
    assert Scene.from_toml(scene.to_toml()) == scene


def test_other_values_take_the_place_of_those_that_a_scene_has():
    scene = Scene.load(None, ["filter.order=3"])
    small = scene.having(grid={"cells": (4,), "length": (2.0,)})
    assert (small.grid.cells, small.h, small.name, small.unused) == ((4,), (0.5,), scene.name, scene.unused)
    assert scene.grid.cells == (100,) and small.filter == scene.filter


def test_report_steps_are_stored_sorted_and_once():
    assert Scene.load(None, ["output.report_at=[600, 100, 1000, 0, 100]"]).output.report_at == (0, 100, 600, 1000)


def test_the_last_override_wins_over_the_file_and_the_others():
    scene = Scene.from_toml("[time]\nsteps = 5\n", ["time.steps=6", " time . steps = 7 "])
    assert scene.time.steps == 7


@pytest.mark.parametrize("text", ["filter.kind=none", 'filter.kind="none"', "filter.kind='none'", "filter.kind = none"])
def test_an_override_takes_a_bare_word_as_a_string(text):
    assert Scene.load(None, [text]).filter.kind == "none"


def test_an_override_takes_lists_numbers_and_text_with_equals_signs(tmp_path):
    particles = tmp_path / "a=b.h5"
    particles.write_bytes(b"x")
    texts = ["grid.cells=[8, 4]", "time.dt=1e-3", "particles.layout=file", f"particles.path={particles}"]
    scene = Scene.load(None, texts)
    assert (scene.grid.cells, scene.dt, scene.particles.path) == ((8, 4), 1e-3, str(particles))


@pytest.mark.parametrize(
    ("given", "override", "kept"), [("dt = 1e-3", "cfl=0.2", "cfl"), ("cfl = 0.2", "dt=0.5", "dt")]
)
def test_an_override_of_dt_or_cfl_replaces_the_other_one_of_the_file(given, override, kept):
    time = Scene.from_toml(f"[time]\n{given}", [f"time.{override}"]).to_dict()["time"]
    assert [key for key in ("dt", "cfl") if key in time] == [kept]


def test_a_relative_particle_file_is_found_beside_its_scene_or_in_the_working_directory(tmp_path, monkeypatch):
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "a.h5").write_bytes(b"a")
    (tmp_path / "b.h5").write_bytes(b"b")
    file = tmp_path / "scenes" / "mine.toml"
    file.write_text('[particles]\nlayout = "file"\npath = "a.h5"\n')
    monkeypatch.chdir(tmp_path)
    scene = Scene.load(Path("scenes/mine.toml"))
    assert scene.particles.path == str(tmp_path / "scenes" / "a.h5")
    assert scene.name == "mine" and scene.particle_count is None
    assert Scene.load(file, ["particles.path=b.h5"]).particles.path == str(tmp_path / "b.h5")
    monkeypatch.chdir("/")
    assert Scene.from_toml(scene.to_toml()) == scene


def test_a_scene_file_may_have_a_byte_order_mark_and_windows_line_ends(tmp_path):
    file = tmp_path / "win.toml"
    file.write_bytes(b"\xef\xbb\xbf[time]\r\nsteps = 3\r\n")
    assert Scene.load(file).time.steps == 3


def test_the_caller_s_data_is_not_modified():
    data = {"time": {"cfl": 0.1}, "particles": {"per_cell": [3]}}
    Scene.from_dict(data, ["time.dt=0.01", "particles.per_cell=[2]"])
    assert data == {"time": {"cfl": 0.1}, "particles": {"per_cell": [3]}}


def test_a_scene_survives_pickling_with_its_name():
    scene = Scene.from_dict({"grid": {"cells": [4, 4]}}, name="mine")
    copy = pickle.loads(pickle.dumps(scene))
    assert copy == scene and copy.name == "mine"


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_every_scene_in_configs_loads_and_says_what_it_shows(path):
    scene = Scene.load(path)
    assert scene.name == path.stem
    assert Scene.from_toml(scene.to_toml()) == scene
    assert scene.particle_count <= 50_000
    assert scene.output.report_at, "a scene that ships shows its errors over time"
    text = path.read_text()
    assert text.startswith("# ") and f"configs/{path.name}" in text and "Expect" in text


def test_configs_hold_the_scenes_that_the_documentation_names():
    assert {path.stem for path in CONFIGS} >= {
        *("paper", "paper-unfiltered", "paper-5000", "gaussian-2d", "gaussian-3d", "standing-wave-2d"),
        *("plane-wave-3d", "random-2d"),
    }


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("paper", ["output.report_at=[100, 600, 700, 1000]"]),
        ("paper-unfiltered", ["output.report_at=[100, 600, 700, 1000]", "filter.kind=none"]),
        ("paper-5000", ["output.report_at=[100, 1000, 5000]", "time.steps=5000"]),
    ],
)
def test_the_paper_scenes_differ_from_the_defaults_only_in_what_their_names_say(name, overrides):
    assert Scene.load(ROOT / "configs" / f"{name}.toml") == Scene.load(None, overrides)


def test_reading_a_scene_imports_no_mpi_no_petsc_no_hdf5_and_no_numba():
    code = (
        "import sys; from mpipic import Scene; Scene.load(None).to_toml();"
        "heavy = ('mpi4py', 'petsc4py', 'slepc4py', 'h5py', 'numba', 'matplotlib');"
        "print([name for name in heavy if name in sys.modules])"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, timeout=60)
    assert (done.stdout.strip(), done.stderr) == ("[]", "")


# --- round trip -------------------------------------------------------------------------------------------------------


def _floats(low, high):
    return st.floats(low, high, allow_nan=False)


@st.composite
def scenes(draw):
    """Draw the data of a valid scene of any dimension, some keys given and some not."""
    dim = draw(st.integers(1, 3))
    layout = draw(st.sampled_from(["lattice", "jittered", "random"]))
    profile = draw(st.sampled_from(["gaussian", "plane-gaussian", "plane-wave", "standing-wave"]))

    def axes(entries, size=dim):
        return st.lists(entries, min_size=size, max_size=size)

    steps = draw(st.integers(0, 10**9))
    length = draw(axes(_floats(1e-3, 1e3)))
    particles = {"per_cell": axes(st.integers(1, 100), 1 if layout == "random" else dim)}
    if layout == "jittered":
        particles["jitter"] = _floats(0, 1)
    if layout != "lattice":
        particles["seed"] = st.integers(0, 2**63 - 1)
    initial = {}
    if "gaussian" in profile:
        initial = {"center": st.tuples(*(_floats(0, x) for x in length)).map(list), "sharpness": _floats(1e-3, 1e6)}
    if profile != "gaussian":
        initial["wave"] = axes(st.integers(-50, 50)).filter(any)
    times = {"blow_up": st.floats(1, 1e300, exclude_min=True)}
    times[draw(st.sampled_from(["dt", "cfl"]))] = _floats(1e-9, 1e3)
    options = {
        "particles": particles,
        "gas": {"sound_speed": _floats(1e-3, 1e3), "flow": axes(_floats(-1e3, 1e3)), "density": _floats(1e-3, 1e3)},
        "initial": initial,
        "filter": {"kind": st.sampled_from(["none", "local"])},
        "time": times,
        "output": {"every": st.integers(0, 2**40), "report_at": st.lists(st.integers(0, steps), max_size=5)},
    }
    data = {name: draw(st.fixed_dictionaries({}, optional=keys)) for name, keys in options.items()}
    data["grid"] = {"cells": draw(axes(st.integers(1, 1000))), "length": length}
    data["particles"]["layout"] = layout
    data["initial"]["profile"] = profile
    data["time"]["steps"] = steps
    return data


@given(scenes())
def test_a_resolved_scene_reads_back_equal_and_holds_what_was_given(data):
    scene = Scene.from_dict(data)
    text = scene.to_toml()
    assert Scene.from_toml(text) == scene
    assert tomllib.loads(text) == scene.to_dict() == Scene.from_dict(scene.to_dict()).to_dict()
    assert Scene.from_toml(text).to_toml() == text
    for section, table in data.items():
        for key, value in table.items():
            expected = sorted(set(value)) if key == "report_at" else value
            assert scene.to_dict()[section][key] == expected


@given(scenes())
def test_derived_quantities_are_finite_and_consistent(data):
    scene = Scene.from_dict(data)
    assert scene.dt > 0 and math.isfinite(scene.duration) and math.isfinite(scene.cfl)
    assert scene.cfl == pytest.approx(scene.gas.sound_speed * scene.dt / min(scene.h))
    assert [h * n for h, n in zip(scene.h, scene.grid.cells)] == pytest.approx(list(scene.grid.length))


@pytest.mark.parametrize("name", ['a"b', "a\\b", "a\x01b\x7f", "ünï \U0001f600", "a\nb\tc", "#'''"])
def test_any_file_name_survives_the_round_trip(tmp_path, name):
    (tmp_path / name).write_bytes(b"x")
    scene = Scene.from_dict({"particles": {"layout": "file", "path": str(tmp_path / name)}})
    assert Scene.from_toml(scene.to_toml()) == scene
    assert scene.particles.path == str(tmp_path / name)


def test_every_choice_makes_a_scene(tmp_path):
    (tmp_path / "p.h5").write_bytes(b"x")
    file = ["particles.layout=file", f"particles.path={tmp_path / 'p.h5'}"]
    for key in (slot for slot in parts.slots("acoustics") if "." in slot):
        for choice in parts.choices(key, "acoustics"):
            section, name = key.split(".")
            scene = Scene.load(None, [*(file if choice == "file" else []), f"{key}={choice}"])
            assert scene.to_dict()[section][name] == choice and scene.part(key).kind == choice
            assert Scene.from_toml(scene.to_toml()) == scene


# --- process grid -----------------------------------------------------------------------------------------------------


def _surface(cells, grid):
    block = [n / p for n, p in zip(cells, grid)]
    return sum(math.prod(block) / block[a] for a in range(len(cells)) if grid[a] > 1)


@settings(max_examples=200)
@given(st.lists(st.integers(1, 12), min_size=1, max_size=3), st.integers(1, 40))
def test_the_process_grid_has_the_least_halo_surface_of_all(cells, size):
    fitting = [grid for grid in product(*(range(1, n + 1) for n in cells)) if math.prod(grid) == size]
    grid = process_grid(cells, size)
    assert (grid is None) == (not fitting)
    if grid is not None:
        assert grid in fitting
        assert _surface(cells, grid) <= min(_surface(cells, other) for other in fitting) * (1 + 1e-12)


@pytest.mark.parametrize(
    ("cells", "size", "grid"),
    [
        ((100,), 3, (3,)),
        ((8, 8), 1, (1, 1)),
        ((8, 8), 2, (1, 2)),
        ((8, 8), 4, (1, 4)),  # as much surface as (2, 2), fewer neighbours
        ((8, 8), 16, (4, 4)),
        ((64, 4), 4, (4, 1)),
        ((8, 8, 8), 2, (1, 1, 2)),
        ((8, 8, 8), 64, (4, 4, 4)),
        ((2, 2, 2), 9, None),
        ((4,), 0, None),
        ((4,), 10**30, None),
    ],
)
def test_the_process_grid_splits_long_axes_and_spares_x(cells, size, grid):
    assert process_grid(cells, size) == grid


@pytest.mark.parametrize(
    ("cells", "size", "fewer"), [([5, 7], 11, 10), ([3], 4, 3), ([2, 2, 2], 10**9, 8), ([7, 3], 17, 15)]
)
def test_an_impossible_number_of_ranks_names_the_nearest_smaller_one(cells, size, fewer):
    scene = Scene.from_dict({"grid": {"cells": cells}})
    with pytest.raises(SceneError, match=rf"= {size}: .* nearest smaller number that can is {fewer}$"):
        check_ranks(scene, size)
    check_ranks(scene, fewer)
    assert all(process_grid(cells, n) is None for n in range(fewer + 1, min(size, 1000) + 1))


def test_no_ranks_are_refused():
    with pytest.raises(SceneError, match="at least 1"):
        check_ranks(Scene(), 0)
