"""A step takes something away on purpose: waves too short for the grid, and what no node sees."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mpipic.keys import ABOVE_0, NOT_BELOW_0, Keys, NotNegative, Positive, UpTo8OrZero, key
from mpipic.parts import A_FILTER, LEAST_SQUARES, NODAL_GRADIENTS, Broken, Part, Values, kinds_with, rule
from mpipic.wording import listed, show

if TYPE_CHECKING:
    from mpipic.mesh.differences import LowPass
    from mpipic.mesh.grid import Grid


def _broken(dotted: str, v: Values) -> Broken | None:
    """Return what damping misses: it changes particles by what interpolates from least-squares fields."""
    if not v[dotted]:
        return None
    if not v.has(LEAST_SQUARES):
        kinds = kinds_with("mapping.mass", LEAST_SQUARES, v["physics.kind"])
        return dotted, f"needs mapping.mass = {listed(kinds, 'or')}; it is {show(v['mapping.mass'])}"
    if not v.has(A_FILTER) and not v.has(NODAL_GRADIENTS):
        return dotted, f'needs a filter, or mapping.gradient = "grid": filter.kind is {show(v["filter.kind"])}'
    return None


@dataclass(frozen=True)
class Damping(Part):
    """Takes away in every step, on purpose: waves too short for the grid, and what no node sees.

    Attributes
    ----------
    low_pass
        Takes grid-scale waves from the nodal fields: particles get Φ times what is taken from these.
    null_space
        The share of q - Φ a that particle values q lose, a their least-squares field: of what no node sees, and with a
        penalty, of what is rough. Where the grid moves past the particles such noise turns into sound and back, and can
        grow however well waves are damped; this makes the step without gradients a contraction, which it need not be
        otherwise.
    """

    slot = "damping"
    physics = "acoustics"
    about = "what a step takes away on purpose"

    class Settings(Keys):
        """Keys of [damping]. Both rates are per cell that sound travels, and a step takes all at most."""

        order: UpTo8OrZero = key(0, "a whole number from 0 to 8", "second differences of the low-pass; 0: none")
        strength: Positive = key(
            1.0, ABOVE_0, "with order above 0: of the shortest wave a step takes strength c dt / h"
        )
        null_space: NotNegative = key(
            0.0,
            NOT_BELOW_0,
            "of what particles hold beside their fields a step takes the share null_space c dt / h",
        )

    @rule("damping.order", "mapping.mass", "mapping.gradient", "filter.kind")
    @staticmethod
    def waves_are_in_fields_that_particles_can_take(v: Values) -> Broken | None:
        """See `_broken`."""
        return _broken("damping.order", v)

    @rule("damping.null_space", "mapping.mass", "mapping.gradient", "filter.kind")
    @staticmethod
    def so_is_what_is_kept_of_the_null_space(v: Values) -> Broken | None:
        """See `_broken`."""
        return _broken("damping.null_space", v)

    @classmethod
    def idle(cls, v: Values) -> Mapping[str, str]:
        """Return the strength of no low-pass."""
        return {} if v["damping.order"] else {"strength": "damping.order = 0 takes no strength"}

    @classmethod
    def describe(cls, v: Values) -> str:
        """Return what is damped; empty if nothing is."""
        order, share = v["damping.order"], v["damping.null_space"]
        waves = f", damped with {order} second differences" if order else ""
        return waves + (f", null space damped at rate {share:g}" if share else "")

    @classmethod
    def create(cls, v: Values, grid: Grid) -> Damping:
        """Return the damping of a scene. Local."""
        low_pass = None
        if v["damping.order"]:
            from mpipic.mesh.differences import LowPass

            travel = v["damping.strength"] * v.signal_speed * v.dt / np.array(grid.h)
            low_pass = LowPass(grid, v["damping.order"], np.minimum(1.0, travel))
        return cls(low_pass, min(1.0, v["damping.null_space"] * v.cfl))

    low_pass: LowPass | None = None
    null_space: float = 0.0

    @property
    def acts(self) -> bool:
        """Whether it takes anything."""
        return self.low_pass is not None or self.null_space != 0.0

    @property
    def nbytes(self) -> int:
        """Bytes held."""
        return self.low_pass.nbytes if self.low_pass else 0
