"""The cases of the verb `trials`: scenes, what is done to their particles, and what may come of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mpipic.arrays import FloatArray
from mpipic.scene.presets import PRESETS

if TYPE_CHECKING:
    from mpipic.mesh.grid import Grid

Sections = Mapping[str, Mapping[str, object]]
"""Name of a section to its keys and values."""
Place = Callable[["Grid", np.random.Generator], FloatArray]
"""From a grid to coordinates in cells, (n, d)."""


@dataclass(frozen=True)
class Case:
    """One case.

    Attributes
    ----------
    scene
        Sections and keys.
    expect
        completed, unstable, refused, or any: whatever is stated.
    error
        Largest l2 error of the density, relative to the amplitude, of a completed run.
    amplitude
        Factor of the initial state.
    place
        Coordinates in cells for the particles, in place of the scene's layout.
    predict
        Whether the run is held against its computed growth.
    short
        Whether the case is part of the short form.
    """

    name: str
    scene: Sections
    expect: str = "completed"
    error: float = 0.3
    amplitude: float = 1.0
    place: Place | None = None
    predict: bool = False
    short: bool = False


SCHEMES: dict[str, Sections] = {
    "local": {"filter": {"kind": "local"}},
    "order 2": {"filter": {"kind": "order", "order": 2}},
    "exact": {"filter": {"kind": "exact", "tolerance": 1e-12}},
    "recommended": PRESETS["recommended"],
}


def _merged(*parts: Sections) -> dict[str, dict[str, object]]:
    """Return the sections of all parts; of a key that several have, the last counts."""
    result: dict[str, dict[str, object]] = {}
    for part in parts:
        for section, values in part.items():
            result[section] = {**result.get(section, {}), **values}
    return result


WAVE_1D: Sections = {
    "grid": {"cells": [32]}, "initial": {"profile": "plane-wave"}, "time": {"cfl": 0.2, "steps": 160},
}  # fmt: skip
WAVE_2D: Sections = {
    "grid": {"cells": [12, 12]}, "initial": {"profile": "standing-wave"}, "gas": {"flow": [0.13, 0.07]},
    "time": {"cfl": 0.2, "steps": 60},
}  # fmt: skip


def _stiff() -> list[Case]:
    """Return cases of sound much faster than the flow, time steps around the limit, implicit steps far above it."""
    cases = [
        Case(f"c/v = 1e{power}, {name}", _merged(WAVE_1D, scheme, {"gas": {"flow": [10.0**-power]}}), short=power == 8)
        for power in (2, 4, 6, 8)
        for name, scheme in SCHEMES.items()
    ]
    still: Sections = {"gas": {"flow": [0.0]}, "time": {"steps": 400}}
    for cfl, expect in ((0.01, "completed"), (1.99, "completed"), (2.02, "unstable")):
        scene = _merged(WAVE_1D, SCHEMES["exact"], still, {"time": {"cfl": cfl}})
        cases.append(Case(f"CFL {cfl} of 2, exact", scene, expect, error=1.0, short=cfl > 1))
    for cfl, expect in ((2.79, "completed"), (2.85, "unstable")):
        scene = _merged(WAVE_1D, SCHEMES["local"], still, {"time": {"cfl": cfl}})
        cases.append(Case(f"CFL {cfl} of 2.82, local", scene, expect, error=2.0))
    for cfl in (1.0, 10.0, 100.0, 1000.0):
        implicit: Sections = {"time": {"cfl": cfl, "steps": 40, "integrator": "midpoint"}, "gas": {"flow": [1e-4]}}
        scene = _merged(WAVE_1D, SCHEMES["recommended"], implicit)
        cases.append(Case(f"midpoint, CFL {cfl:g}", scene, error=2.0, short=cfl == 100.0))
    return cases


PLACES: dict[str, Place] = {
    "fewer particles than nodes": lambda grid, rng: rng.random((7, 1)) * 32,
    "half the box empty": lambda grid, rng: rng.random((64, 1)) * 16,
    "all in one cell": lambda grid, rng: 5 + rng.random((40, 1)),
    "all on nodes": lambda grid, rng: np.repeat(np.arange(32.0), 2)[:, None],
    "all on the box's edge": lambda grid, rng: np.zeros((20, 1)),
    "coincident": lambda grid, rng: np.full((20, 1), 7.3),
    "one particle": lambda grid, rng: np.full((1, 1), 7.3),
}
"""Name to coordinates in cells, on 32 cells."""


def _counts() -> list[Case]:
    """Return cases of many and few particles, and in bad places; growth to twice the start is to be stated."""
    cases = []
    for name, scheme in SCHEMES.items():
        base = _merged(WAVE_1D, scheme, {"time": {"blow_up": 2.0}})
        random = _merged(
            WAVE_2D, scheme, {"particles": {"layout": "random", "per_cell": [1]}, "time": {"blow_up": 2.0}}
        )
        cases += [
            Case(f"64 particles a cell, {name}", _merged(base, {"particles": {"per_cell": [64]}})),
            Case(f"1 particle a cell, {name}", _merged(base, {"particles": {"per_cell": [1]}})),
            Case(f"1 random particle a cell, {name}", random, "any", short=name == "recommended"),
        ]
        cases += [
            Case(f"{what}, {name}", base, "any", 1.5, place=place, short=what == "all in one cell" and name == "exact")
            for what, place in PLACES.items()
        ]
    return cases


def _sizes() -> list[Case]:
    """Return cases of tiny and huge numbers in state, gas and box."""
    cases = []
    for name, scheme in SCHEMES.items():
        base = _merged(WAVE_1D, scheme)
        cases += [
            Case(f"amplitude {size:g}, {name}", base, amplitude=size, short=name == "exact") for size in (1e-300, 1e150)
        ]
        for density in (1e-12, 1e12):
            cases.append(Case(f"density {density:g}, {name}", _merged(base, {"gas": {"density": density}})))
        for speed in (1e-12, 1e12):
            gas = {"sound_speed": speed, "flow": [0.05 * speed]}
            cases.append(Case(f"sound speed {speed:g}, {name}", _merged(base, {"gas": gas})))
        box: Sections = {"grid": {"length": [1.0, 1e6]}, "gas": {"flow": [0.1, 0.0]}, "initial": {"wave": [1, 0]}}
        wave: Sections = {"initial": {"profile": "plane-wave"}}
        cases.append(Case(f"cells of 1 to 1e6, {name}", _merged(WAVE_2D, scheme, box, wave)))
    return cases


def _motion() -> list[Case]:
    """Return cases of no flow, flow faster than sound, very many steps, the smallest boxes."""
    cases = []
    for name, scheme in SCHEMES.items():
        base = _merged(WAVE_1D, scheme)
        cases += [
            Case(f"v = 0, {name}", _merged(base, {"gas": {"flow": [0.0]}})),
            Case(f"v = 50 c, {name}", _merged(base, {"gas": {"flow": [50.0]}}), "any", short=name == "local"),
            Case(f"one cell, {name}", _merged(base, {"grid": {"cells": [1]}}), "any", error=1.5),
            Case(f"four cells, {name}", _merged(base, {"grid": {"cells": [4]}}), "any", error=1.5),
        ]
    small: Sections = {"grid": {"cells": [8]}, "gas": {"flow": [0.0]}, "time": {"cfl": 0.2, "steps": 300_000}}
    cases.append(Case("300 000 steps in a small box, local", _merged(WAVE_1D, SCHEMES["local"], small), error=2.0))
    return cases


def _predicted() -> list[Case]:
    """Return runs against their computed growth, long enough to show it."""
    far = {"blow_up": 1e200}
    pulse: Sections = {"grid": {"cells": [24]}, "time": {"dt": 1.25e-3 * 100 / 24, "steps": 1500, **far}}
    loose: Sections = {"particles": {"layout": "jittered", "jitter": 0.4}, "time": {"steps": 6000}}
    kinds = {"none": {"filter": {"kind": "none"}}, **{k: v for k, v in SCHEMES.items() if k != "order 2"}}
    lattice = [
        Case(f"growth on a lattice, {name}", _merged(pulse, scheme), predict=True, short=name == "none")
        for name, scheme in kinds.items()
    ]
    dear = {"exact": {"time": {"steps": 2500}}, "recommended": {"time": {"steps": 1500}}}
    jittered = [
        Case(f"growth on jittered particles, {name}", _merged(pulse, loose, scheme, dear.get(name, {})), predict=True)
        for name, scheme in kinds.items()
    ]
    return lattice + jittered


CASES: list[Case] = [*_stiff(), *_counts(), *_sizes(), *_motion(), *_predicted()]
