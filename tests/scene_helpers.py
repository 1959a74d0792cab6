"""Helpers of the scene tests: a scene that must be refused, and what then holds for every message."""

import pytest

from mpipic.scene.records import Scene, SceneError

JARGON = ("pydantic", "input_value", "type=", "Traceback", "validation error", "None", "tuple", "dict", "Input should")


def refused(data, overrides=()):
    """Return the error of a scene that must be refused, after checks that hold for every message."""
    with pytest.raises(SceneError) as caught:
        Scene.from_dict(data, overrides) if isinstance(data, dict) else Scene.from_toml(data, overrides)
    error = caught.value
    lines = str(error).split("\n")
    assert lines == [str(problem) for problem in error.problems]
    for line in lines:
        assert line.isprintable() and not any(word in line for word in JARGON), line
    return error


def message(*overrides):
    """Return the one message that the overrides of the default scene lead to."""
    (problem,) = refused({}, overrides).problems
    return str(problem)
