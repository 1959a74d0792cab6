"""A second physics, for tests of the border: tracers in a swirling flow that carry a mass and a tensor."""

from __future__ import annotations

import numpy as np

from mpipic.mapping.mapping import Mapping
from mpipic.particles.motion import Motion
from mpipic.physics.base import Physics


def swirl(position, length):
    """The velocity (n, 2) of a steady flow with vortices of a quarter box each, which no particle leaves for long."""
    x, y = (2.0 * np.pi * position / np.array(length)).T
    return np.stack([np.sin(x) * np.cos(y), -np.cos(x) * np.sin(y)], axis=1) + np.array([0.35, 0.15])


class Swirl(Physics):
    """Dx/Dt = v(x): every particle moves by a displacement of its own; mass m and stress σ stay as they are."""

    watched = "mass"
    compared = ("mass", "stress")

    def __init__(self, length, dt):
        self.length, self.dt = length, dt

    def fields(self, dim):
        """A scalar, a vector and a tensor."""
        return {"mass": (), "velocity": (dim,), "stress": (dim, dim)}

    def initial(self, position):
        """Values that differ from particle to particle, no component equal to another."""
        x, y = (position / np.array(self.length)).T
        stress = np.stack([1.0 + x, x - y, 3.0 * x * y, y - 2.0], axis=1).reshape(-1, 2, 2)
        return {"mass": 1.0 + x + 2.0 * y, "velocity": swirl(position, self.length), "stress": stress}

    def exact(self, position, time):
        """Known at the start alone, where it is the initial state."""
        return self.initial(position) if time == 0.0 else None

    def place(self, grid, particles, phase):
        """A motion, and a mapping weighted by the mass."""
        self.grid, self.particles, self.phase = grid, particles, phase
        self.motion = Motion(grid, particles)
        self.mapping = Mapping.at(grid, particles, weight=particles["mass"], phase=phase)

    def step(self):
        """Follow the flow by a step of Euler's method, and map the particles where they have come."""
        p = self.particles
        p["velocity"] = swirl(p.position, self.length)
        self.motion.move(self.dt * p["velocity"])
        self.mapping.follow(p, weight=p["mass"])

    def restart(self):
        """Map the particles anew."""
        self.mapping.follow(self.particles, weight=self.particles["mass"])

    def close(self):
        """Give the routes back."""
        self.motion.close()

    @property
    def peak(self):
        """Largest mass."""
        return float(np.abs(self.particles["mass"]).max(initial=0.0))

    def signal_speed(self):
        """Tracers hear nothing."""
        return 0.0

    def conserved(self):
        """Σ m and Σ σ."""
        return {"mass": self.particles["mass"].sum(), "stress": self.particles["stress"].sum(axis=0)}

    def nodal(self):
        """The mean velocity, by mass, and the mean stress at the nodes."""
        means = {name: self.mapping.p2g(self.particles[name]) for name in ("velocity", "stress")}
        return {name: self.grid.owned(mean) for name, mean in means.items()}
