"""The sections of a scene that are no choice and belong to no room: box, time and output."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import AfterValidator, Field

from mpipic.keys import ABOVE_0, FROM_0, ByScene, Count, CountOrZero, Keys, Positive, is_normal, key
from mpipic.parts import SIGNALS, Broken, Part, Values, rule
from mpipic.wording import show

CELL_LIMIT = 2**31

AboveOne = Annotated[float, Field(gt=1, allow_inf_nan=False)]
Zero = Annotated[int, Field(ge=0, le=0)]
Steps = Annotated[tuple[CountOrZero, ...], AfterValidator(lambda steps: tuple(sorted(set(steps))))]


class Box(Part):
    """Periodic box of uniform cells; the number of entries of `cells` is the dimension of the scene."""

    slot = "grid"
    about = "periodic box of uniform cells"
    brings_in = ("y", "z")

    class Settings(Keys):
        """Keys of [grid]."""

        cells: tuple[Count, ...] = key(
            (100,),
            "a list of 1 to 3 whole numbers, each 1 or above, for example [100]",
            "cells per axis; the number of entries is the dimension",
            per_axis=True,
        )
        length: tuple[Positive, ...] = key(
            ByScene("1 per axis", lambda v: (1.0,) * v.dim, ("grid.cells",)),
            "a list of finite numbers above 0, one per axis, for example [1.0]",
            "size of the box",
            unit="length",
            per_axis=True,
        )

    @rule("grid.cells")
    @staticmethod
    def cells_fit_an_index(v: Values) -> Broken | None:
        """Nodes are numbered with 32 bits."""
        if v.cell_count < CELL_LIMIT:
            return None
        rest = f"cells in all (32-bit indices); it is {show(v.cell_count)}"
        return "grid.cells", f"must be fewer than 2^31 = {CELL_LIMIT} {rest}"

    @rule("grid.cells", "grid.length")
    @staticmethod
    def spacing_is_a_number(v: Values) -> Broken | None:
        """The spacing, its inverse and the cell volume are ordinary numbers."""
        if is_normal(*v.h, math.prod(v.h)):
            return None
        return "grid.length", f"is out of the range of floating point: length / cells is {show(v.h)}"

    @classmethod
    def describe(cls, v: Values) -> str:
        """Return dimension and cells."""
        return f"{v.dim}D, {' x '.join(map(str, v['grid.cells']))} cells, periodic"

    @classmethod
    def brings(cls, v: Values) -> tuple[str, ...]:
        """Return the axes beyond x."""
        return cls.brings_in[: v.dim - 1]


class Time(Part):
    """How far and how fast a run goes."""

    slot = "time"
    about = "steps, and what ends a run"
    either = ("dt", "cfl")

    class Settings(Keys):
        """Keys of [time], without those of its integrator."""

        dt: Positive | None = key(1.25e-3, ABOVE_0, "time step, or give cfl", unit="time")
        cfl: Positive | None = key(None, ABOVE_0, "cells that sound travels in a step; in place of dt")
        blow_up: AboveOne = key(
            100.0, "a finite number above 1", "|density| this many times its start ends a run as unstable"
        )
        steps: CountOrZero = key(1000, FROM_0, "steps of the run")

    @rule("time.cfl", "physics.kind")
    @staticmethod
    def cells_travelled_need_a_speed(v: Values) -> Broken | None:
        """A physics without signals cannot say how long a step is that takes them so many cells on."""
        if v["time.cfl"] is None or v.has(SIGNALS):
            return None
        return "time.cfl", f"needs signals, which physics.kind = {show(v['physics.kind'])} has none of: give time.dt"


class Output(Part):
    """Holds what a run writes and reports beside its summary."""

    slot = "output"
    about = "snapshots and reports"
    brings_in = ("snapshots", "h5py")

    class Settings(Keys):
        """Keys of [output]."""

        every: CountOrZero = key(0, FROM_0, "steps between snapshots; 0: none")
        checkpoint_every: Zero = key(0, "0: checkpoints cannot be written yet", "steps between checkpoints; 0: none")
        report_at: Steps = key(
            (),
            "a list of whole numbers, each 0 or above, for example [100, 1000]",
            "steps at which errors and null-space shares are recorded; errors of the last step always are",
        )

    @rule("time.steps", "output.report_at")
    @staticmethod
    def reports_are_within_the_run(v: Values) -> Broken | None:
        """A report after the last step would never be written."""
        if all(step <= v["time.steps"] for step in v["output.report_at"]):
            return None
        return "output.report_at", f"must hold steps from 0 to time.steps = {v['time.steps']}"

    @classmethod
    def brings(cls, v: Values) -> tuple[str, ...]:
        """Return the files of snapshots."""
        return cls.brings_in if v["output.every"] else ()
