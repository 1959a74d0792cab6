"""Input that cannot be read, messages that stay plain, and arbitrary input: a scene or a SceneError, nothing else."""

import os
import pickle
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from mpipic import parts
from mpipic.scene.records import Scene, SceneError
from scene_helpers import message, refused


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("[grid\n", "at line 1, column 6: "),
        ("[time]\ndt = 1\ndt = 2\n", r"at line 3, column \d+: this key is set a second time"),
        ("[time]\n[grid]\n[time]\n", r"at line 3, column \d+: this section appears a second time"),
        ("[time]\nsteps = ", "at line 2, column 9: "),
        ("[time]\ncells = [1,\n2", "at line 3, column 2: "),
        ("[time]\nsteps = 03", "at line 2, column 10"),
        ('x = "a\x01b"', r"at line 1, column 7: illegal character '\\x01'"),
        ("[time]\nsteps = 1" + "0" * 5000, "at line 2, column 9: a number has too many digits"),
        ("x = " + "[" * 5000, "nested too deeply"),
    ],
)
def test_malformed_toml_is_one_problem_with_line_and_column(text, place):
    with pytest.raises(SceneError, match=place):
        Scene.from_toml(text)
    (problem,) = refused(text).problems
    assert problem.key == "scene"


def test_a_malformed_file_is_named(tmp_path):
    file = tmp_path / "bad.toml"
    file.write_text("[grid]\ncells = [8\n")
    with pytest.raises(SceneError) as caught:
        Scene.load(file)
    assert str(caught.value).startswith(f"{file}: not valid TOML at line 3, column 1")


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("foo", "must have the form section.key=value"),
        ("", "must have the form section.key=value"),
        ("=3", "must have the form section.key=value"),
        ("kind=none", "must have the form section.key=value"),
        ("a.b.c=3", "must have the form section.key=value"),
        ("filter kind=none", "must have the form section.key=value"),
        (".kind=none", "must have the form section.key=value"),
        ("grid.cells=[8, 8", "the value is not valid TOML"),
        ('filter.kind="none', "the value is not valid TOML"),
        ("filter.kind=none\n[grid]", "the value is not valid TOML"),
        ("time.steps=3\nother=4", "the value is not valid TOML"),
        ("grid.cells=" + "[" * 5000, "the value is not valid TOML"),
    ],
)
def test_a_bad_override_is_named_with_its_text(text, rule):
    found = message(text)
    assert found.startswith("--set " + text[:7].split("\n")[0]) and rule in found


def test_an_override_of_an_unknown_key_suggests_the_closest():
    assert message("filter.knd=none").endswith('[filter] has kind, order, tolerance. Did you mean "filter.kind"?')
    assert message("filtr.kind=none").endswith('Did you mean "filter"?')


def test_a_file_that_cannot_be_read_is_named_with_the_reason(tmp_path):
    (tmp_path / "paper.toml").write_text("")
    (tmp_path / "latin.toml").write_bytes(b"# \xff")
    cases = {
        "papr.toml": rf'papr.toml: cannot be read: No such file.*Did you mean "{tmp_path / "paper.toml"}"',
        "": "cannot be read: Is a directory",
        "latin.toml": "not a text file in UTF-8",
        "a\x00b": r"a\\x00b: cannot be read",
        "nothing/here.toml": "cannot be read: No such file",
    }
    for name, expected in cases.items():
        with pytest.raises(SceneError, match=expected) as caught:
            Scene.load(tmp_path / name)
        assert len(caught.value.problems) == 1 and str(caught.value).isprintable()


def test_a_particle_file_must_be_named_exist_and_be_a_readable_file(tmp_path):
    def layout_file(path):
        return str(refused({"particles": {"layout": "file", "path": path}}))

    assert layout_file("") == 'particles.path = "": must name an HDF5 file with particles.layout = "file"'
    assert str(refused({}, ["particles.layout=file"])) == layout_file("")
    assert layout_file(str(tmp_path / "no.h5")).endswith("cannot be read: No such file or directory")
    assert layout_file(str(tmp_path)).endswith("must name a file, not a folder or a device")
    assert layout_file("a\x00b").endswith("is not a usable file name")
    assert layout_file("a\udc80b").endswith("is not a usable file name")
    os.mkfifo(tmp_path / "fifo")
    assert "not a folder or a device" in layout_file(str(tmp_path / "fifo"))


def test_a_particle_file_without_permission_is_refused(tmp_path, monkeypatch):
    (tmp_path / "p.h5").write_bytes(b"x")

    def no_permission(self, mode):
        raise PermissionError(13, os.strerror(13))

    monkeypatch.setattr(Path, "open", no_permission)
    error = refused({"particles": {"layout": "file", "path": str(tmp_path / "p.h5")}})
    assert str(error).endswith("cannot be read: Permission denied")


def test_control_characters_in_values_are_escaped():
    text = message("filter.kind=a\x1b[31m\u202eb")
    assert "--set" in text and r"\x1b[31m\u202e" in text
    assert r'"a\x1b\n\"\\"' in str(refused({"filter": {"kind": 'a\x1b\n"\\'}}))


def test_huge_values_are_shortened():
    data = {"filter": {"kind": "x" * 10**5}, "time": {"steps": 10**5000}, "grid": {"cells": [1] * 10**5}}
    assert max(map(len, str(refused(data)).split("\n"))) < 400


def test_an_error_survives_pickling():
    error = refused({}, ["filter.kind=x", "time.steps=-1"])
    copy = pickle.loads(pickle.dumps(error))
    assert copy.problems == error.problems and str(copy) == str(error)


# --- anything at all --------------------------------------------------------------------------------------------------

SECTIONS = list(parts.sections())
KEYS = sorted({key for keys in parts.sections().values() for key in keys})
NAMES = sorted({part.kind for part in parts.registered() if part.kind})
scalars = (
    st.booleans()
    | st.integers()
    | st.integers(min_value=10**300)
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(NAMES)
    | st.dates()
    | st.times()
    | st.datetimes()
)
trees = st.recursive(
    scalars,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=8,
)
documents = st.dictionaries(
    st.sampled_from(SECTIONS) | st.text(max_size=6),
    st.dictionaries(st.sampled_from(KEYS) | st.text(max_size=6), trees, max_size=5) | trees,
    max_size=6,
)


@given(documents)
@example({"time": {"dt": None}, "grid": None})
@example({"": {"": ""}})
def test_any_document_gives_a_scene_or_a_scene_error(data):
    _scene_or_error(lambda: Scene.from_dict(data))


@st.composite
def plausible(draw):
    """Draw known keys with values that are often of the right type and sometimes extreme."""
    number = st.sampled_from([0, 1, -1, 2, 0.5, 1e-320, 1e308, 5e-324, -0.0, 2**31, 2**62, 10**400])
    value = number | st.lists(number, min_size=1, max_size=3) | st.sampled_from(NAMES)
    dotted = [f"{section}.{key}" for section, keys in parts.sections().items() for key in keys]
    return [f"{draw(st.sampled_from(dotted))}={draw(value)}" for _ in range(draw(st.integers(1, 6)))]


@given(plausible())
def test_any_overrides_of_known_keys_give_a_scene_or_a_scene_error(overrides):
    _scene_or_error(lambda: Scene.load(None, overrides))


@given(st.text(), st.lists(st.text(), max_size=3))
def test_any_text_gives_a_scene_or_a_scene_error(text, overrides):
    _scene_or_error(lambda: Scene.from_toml(text, overrides))


def _scene_or_error(make):
    try:
        scene = make()
    except SceneError as error:
        assert error.problems and all(line.isprintable() for line in str(error).split("\n"))
    else:
        assert Scene.from_toml(scene.to_toml()) == scene
        assert scene.dt > 0 and scene.cfl > 0
