"""What must hold between the values of a scene, one function a rule, registered in `RULES`.

A rule is called with all values by dotted key when none of the keys that it names is wrong. It returns None, or the key
to blame and what that key has to satisfy.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mpipic.scene.text import show

CELL_LIMIT = 2**31
PARTICLE_LIMIT = 2**53

Values = dict[str, Any]
Broken = tuple[str, str]
Rule = Callable[[Values], Broken | None]

RULES: list[tuple[tuple[str, ...], Rule]] = []


def particle_count(cells: tuple[int, ...], per_cell: tuple[int, ...]) -> int:
    """Return the number of particles; `per_cell` has an entry per axis, or one for the whole cell."""
    return math.prod(cells) * math.prod(per_cell)


def spacing(length: tuple[float, ...], cells: tuple[int, ...]) -> tuple[float, ...]:
    """Return the node spacing h per axis, length / cells."""
    return tuple(extent / count for extent, count in zip(length, cells, strict=True))


def time_step(v: Values) -> float:
    """Return the time step: time.dt, or cfl min(h) / sound_speed."""
    if v["time.cfl"] is None:
        return float(v["time.dt"])
    return float(v["time.cfl"] * min(spacing(v["grid.length"], v["grid.cells"])) / v["gas.sound_speed"])


def _rule(*keys: str) -> Callable[[Rule], Rule]:
    def register(function: Rule) -> Rule:
        RULES.append((keys, function))
        return function

    return register


def _is_normal(*numbers: float) -> bool:
    """Whether all are above 0 and neither they nor their inverses overflow."""
    return all(number > 0 and math.isfinite(number) and math.isfinite(1 / number) for number in numbers)


@_rule("grid.cells")
def cells_fit_an_index(v: Values) -> Broken | None:
    """Nodes are numbered with 32 bits."""
    count = math.prod(v["grid.cells"])
    if count < CELL_LIMIT:
        return None
    return "grid.cells", f"must be fewer than 2^31 = {CELL_LIMIT} cells in all (32-bit indices); it is {show(count)}"


@_rule("grid.cells", "grid.length")
def spacing_is_a_number(v: Values) -> Broken | None:
    """The spacing, its inverse and the cell volume are ordinary numbers."""
    h = spacing(v["grid.length"], v["grid.cells"])
    if _is_normal(*h, math.prod(h)):
        return None
    return "grid.length", f"is out of the range of floating point: length / cells is {show(h)}"


@_rule("initial.center", "grid.length")
def center_is_in_the_box(v: Values) -> Broken | None:
    """A point outside is far more often a forgotten center than a periodic image."""
    lengths = v["grid.length"]
    if all(0 <= x <= length for x, length in zip(v["initial.center"], lengths, strict=True)):
        return None
    return "initial.center", f"must lie in the box, from 0 to grid.length = {show(lengths)} on every axis"


@_rule("initial.profile", "initial.sharpness", "grid.length")
def sharpness_is_a_number(v: Values) -> Broken | None:
    """The exponent across the box, sharpness length^2, is an ordinary number."""
    if v["initial.profile"] not in ("gaussian", "plane-gaussian"):
        return None
    if _is_normal(*(v["initial.sharpness"] * length * length for length in v["grid.length"])):
        return None
    return "initial.sharpness", "is out of the range of floating point: sharpness length^2 overflows or vanishes"


@_rule("initial.profile", "initial.wave")
def wave_has_a_direction(v: Values) -> Broken | None:
    """Without a period on any axis there is no wave."""
    if any(v["initial.wave"]):
        return None
    return "initial.wave", f"must not be zero on every axis with initial.profile = {show(v['initial.profile'])}"


@_rule("particles.layout", "particles.per_cell", "grid.cells")
def particles_can_be_counted(v: Values) -> Broken | None:
    """Counts stay exact as floating-point numbers."""
    if v["particles.layout"] == "file" or particle_count(v["grid.cells"], v["particles.per_cell"]) < PARTICLE_LIMIT:
        return None
    return "particles.per_cell", f"must give fewer than 2^53 particles in all, grid.cells = {show(v['grid.cells'])}"


@_rule("particles.layout", "particles.per_cell", "particles.jitter", "grid.cells")
def jitter_stays_in_the_box(v: Values) -> Broken | None:
    """No displacement is longer than the box."""
    if v["particles.layout"] != "jittered":
        return None
    most = min(cells * count for cells, count in zip(v["grid.cells"], v["particles.per_cell"], strict=True))
    if v["particles.jitter"] <= most:
        return None
    return "particles.jitter", f"must be at most {most} particle spacings, the width of the box"


@_rule("particles.layout", "particles.path")
def particle_file_can_be_read(v: Values) -> Broken | None:
    """Layout file needs a file; what is in it is for its reader to check."""
    key, name = "particles.path", v["particles.path"]
    if v["particles.layout"] != "file":
        return None
    if not name:
        return key, 'must name an HDF5 file with particles.layout = "file"'
    try:
        name.encode("utf-8")  # else the resolved scene could not be written
        path = Path(name)
        if path.exists() and not path.is_file():
            return key, "must name a file, not a folder or a device"
        with path.open("rb"):
            return None
    except OSError as error:
        return key, f"cannot be read: {error.strerror or error}"
    except ValueError:
        return key, "is not a usable file name"


@_rule("particles.layout", "initial.profile")
def file_profile_needs_file_layout(v: Values) -> Broken | None:
    """Initial values per particle come with the particles."""
    if v["initial.profile"] != "file" or v["particles.layout"] == "file":
        return None
    return "initial.profile", f'needs particles.layout = "file"; it is {show(v["particles.layout"])}'


@_rule("gas.sound_speed", "gas.density")
def stiffness_is_a_number(v: Values) -> Broken | None:
    """The factor c^2 / rho_0 of the velocity equation neither overflows nor vanishes."""
    if _is_normal(v["gas.sound_speed"] * v["gas.sound_speed"] / v["gas.density"]):
        return None
    return "gas.sound_speed", "is out of the range of floating point: sound_speed^2 / density overflows or vanishes"


@_rule("grid.cells", "grid.length", "gas.sound_speed", "gas.flow", "time.dt", "time.cfl", "time.steps")
def time_step_is_a_number(v: Values) -> Broken | None:
    """The step, what sound and flow travel in it per cell, and the run's duration are ordinary numbers."""
    h = spacing(v["grid.length"], v["grid.cells"])
    dt = time_step(v)
    cfl = v["gas.sound_speed"] * dt / min(h)
    travel = [abs(flow) * dt / width for flow, width in zip(v["gas.flow"], h, strict=True)]
    if _is_normal(dt, dt / min(h), cfl) and all(map(math.isfinite, [*travel, dt * v["time.steps"]])):
        return None
    key = "time.dt" if v["time.cfl"] is None else "time.cfl"
    return key, f"is out of the range of floating point: dt = {dt}, sound_speed dt / h = {cfl}, flow dt / h = {travel}"


@_rule("mapping.gradient", "filter.kind")
def skew_needs_a_nodal_filter(v: Values) -> Broken | None:
    """The skew gradient is made of nodal sums, which a filter takes to coefficients."""
    if v["mapping.gradient"] != "skew" or v["filter.kind"] not in ("none", "svd"):
        return None
    also = "; exact is the same operator" if v["filter.kind"] == "svd" else ""
    return "mapping.gradient", f"needs a filter other than none and svd; it is {show(v['filter.kind'])}{also}"


@_rule("mapping.mass", "mapping.gradient", "filter.kind")
def svd_knows_no_penalty(v: Values) -> Broken | None:
    """The reference works on particle values, where the penalised scheme is not defined."""
    if v["filter.kind"] != "svd" or v["mapping.mass"] != "penalised" or v["mapping.gradient"] == "grid":
        return None
    return "filter.kind", 'svd needs mapping.mass = lumped or consistent, or mapping.gradient = "grid"; use exact'


def _damping_rule(key: str, v: Values) -> Broken | None:
    """Damping changes particles by what interpolates from least-squares fields."""
    if not v[key]:
        return None
    if v["mapping.mass"] == "lumped":
        return key, 'needs mapping.mass = consistent or penalised; it is "lumped"'
    if v["filter.kind"] == "none" and v["mapping.gradient"] == "direct":
        return key, 'needs a filter, or mapping.gradient = "grid": filter.kind is "none"'
    return None


@_rule("damping.order", "mapping.mass", "mapping.gradient", "filter.kind")
def damping_of_waves_needs_fields_that_particles_can_take(v: Values) -> Broken | None:
    """See `_damping_rule`."""
    return _damping_rule("damping.order", v)


@_rule("damping.null_space", "mapping.mass", "mapping.gradient", "filter.kind")
def damping_of_the_null_space_does_too(v: Values) -> Broken | None:
    """See `_damping_rule`."""
    return _damping_rule("damping.null_space", v)


@_rule("time.steps", "output.report_at")
def reports_are_within_the_run(v: Values) -> Broken | None:
    """A report after the last step would never be written."""
    if all(step <= v["time.steps"] for step in v["output.report_at"]):
        return None
    return "output.report_at", f"must hold steps from 0 to time.steps = {v['time.steps']}"
