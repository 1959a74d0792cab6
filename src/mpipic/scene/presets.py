"""Schemes by name, for any scene: whole sections that take the place of the scene's own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mpipic.scene.text import Problem, SceneError
from mpipic.wording import closest

PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    "recommended": {
        "mapping": {"basis": "cubic", "mass": "penalised", "penalty": 3.0, "penalty_order": 4, "gradient": "grid"},
        "filter": {"kind": "exact"},
        "damping": {"order": 0, "null_space": 1.0},
        "time": {"integrator": "rk4"},
    },
    "paper": {
        "mapping": {"basis": "linear", "mass": "lumped", "gradient": "direct"},
        "filter": {"kind": "local"},
        "damping": {"order": 0, "null_space": 0.0},
        "time": {"integrator": "symplectic"},
    },
}
"""Name to sections. Those of `time` are changed key by key, the others replaced."""


def check_preset(name: str) -> None:
    """Raise SceneError for the name of a preset that there is not."""
    if name not in PRESETS:
        choices = tuple(PRESETS)
        rule = "must be one of " + ", ".join(choices)
        raise SceneError([Problem("--preset", name, rule, choices, closest(name, choices))])


def with_preset(data: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return the scene's data with the scheme of the preset; `data` is not modified.

    Raises SceneError for a name that there is not.
    """
    check_preset(name)
    result = dict(data)
    for section, values in PRESETS[name].items():
        own = data.get(section, {}) if section == "time" else {}
        result[section] = {**own, **values} if isinstance(own, Mapping) else own
    return result
