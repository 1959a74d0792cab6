"""The undisturbed state that sound runs through."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Gas:
    """Constants of the gas: sound speed c, uniform flow v (one entry per axis) and undisturbed density ρ₀."""

    sound_speed: float
    flow: tuple[float, ...]
    density: float

    @property
    def stiffness(self) -> float:
        """The factor c²/ρ₀ of the density gradient in the equation of motion."""
        return self.sound_speed**2 / self.density
