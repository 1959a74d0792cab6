"""The undisturbed state that sound runs through."""

from __future__ import annotations

import math
from dataclasses import dataclass

from mpipic.keys import ABOVE_0, ByScene, Finite, Keys, Positive, is_normal, key
from mpipic.parts import Broken, Part, Values, rule


@dataclass(frozen=True)
class Gas(Part):
    """Constants of the gas: sound speed c, uniform flow v (one entry per axis) and undisturbed density ρ₀."""

    slot = "gas"
    physics = "acoustics"
    about = "undisturbed state that sound runs through"
    brings_in = ("migration",)

    class Settings(Keys):
        """Keys of [gas]."""

        sound_speed: Positive = key(1.0, ABOVE_0, "sound speed c", unit="length / time")
        flow: tuple[Finite, ...] = key(
            ByScene("0.05 along x, 0 along the others", lambda v: (0.05, 0.0, 0.0)[: v.dim], ("grid.cells",)),
            "a list of finite numbers, one per axis, for example [0.05]",
            "uniform velocity v that everything moves with",
            unit="length / time",
            per_axis=True,
        )
        density: Positive = key(1.0, ABOVE_0, "undisturbed density ρ₀")

    sound_speed: float
    flow: tuple[float, ...]
    density: float

    @rule("gas.sound_speed", "gas.density")
    @staticmethod
    def stiffness_is_a_number(v: Values) -> Broken | None:
        """The factor c²/ρ₀ of the velocity equation neither overflows nor vanishes."""
        if is_normal(v["gas.sound_speed"] * v["gas.sound_speed"] / v["gas.density"]):
            return None
        return "gas.sound_speed", "is out of the range of floating point: sound_speed^2 / density overflows or vanishes"

    @rule("grid.cells", "grid.length", "gas.sound_speed", "gas.flow", "time.dt", "time.cfl", "time.steps")
    @staticmethod
    def time_step_is_a_number(v: Values) -> Broken | None:
        """The step, what sound and flow travel in it per cell, and the run's duration are ordinary numbers."""
        h, dt = v.h, v.dt
        cfl = v["gas.sound_speed"] * dt / min(h)
        travel = [abs(flow) * dt / width for flow, width in zip(v["gas.flow"], h, strict=True)]
        if is_normal(dt, dt / min(h), cfl) and all(map(math.isfinite, [*travel, dt * v["time.steps"]])):
            return None
        dotted = "time.dt" if v["time.cfl"] is None else "time.cfl"
        numbers = f"dt = {dt}, sound_speed dt / h = {cfl}, flow dt / h = {travel}"
        return dotted, f"is out of the range of floating point: {numbers}"

    @classmethod
    def brings(cls, v: Values) -> tuple[str, ...]:
        """Return migration where particles move."""
        return cls.brings_in if any(v["gas.flow"]) else ()

    @classmethod
    def describe(cls, v: Values) -> str:
        """Return when particles move, and so have to be mapped anew."""
        return "updated every step" if any(v["gas.flow"]) else "built once: the flow is 0"

    @property
    def stiffness(self) -> float:
        """The factor c²/ρ₀ of the density gradient in the equation of motion."""
        return self.sound_speed**2 / self.density
