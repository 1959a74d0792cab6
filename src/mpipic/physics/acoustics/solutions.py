"""Initial data and exact solutions of linearised gas dynamics on a periodic box, as one function of (x, t).

About density ρ₀ and uniform flow v, with D/Dt = ∂/∂t + v·∇ and sound speed c, the perturbations obey

    Dρ/Dt = -ρ₀ ∇·u,    Du/Dt = -(c²/ρ₀) ∇ρ,    ρ(x, 0) = f(x),  u(x, 0) = 0.

In the moving frame ξ = x - vt every mode of f keeps its shape and swings at the frequency c|k|: cos(k·ξ) gives

    ρ = cos(k·ξ) cos(c|k|t),    u = (k/|k|) (c/ρ₀) sin(k·ξ) sin(c|k|t).

A profile is a part, a class in `PROFILES`; an object of it is called with (x, t), and t = 0 gives the initial data. Any
consistent set of units serves. Everything here is local: each rank evaluates its own particles.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mpipic.arrays import FloatArray
from mpipic.keys import ABOVE_0, ByScene, Finite, Keys, Positive, is_normal, key
from mpipic.parts import EXACT_SOLUTION, Broken, Choices, Part, Values, rule
from mpipic.physics.acoustics.cosines import (
    CHUNK,
    EXPONENT,
    CosineSeries,
    Fields,
    chunks,
    gaussian_waves,
    periodic_gaussian,
    prepare,
    remainder,
    total_of,
    wave_count,
    wrap,
)
from mpipic.physics.acoustics.gas import Gas
from mpipic.wording import show

# Waves per axis that the series of a Gaussian may have, by dimension; each point costs their product.
MOST_WAVES = {2: 8192, 3: 512}

WAVE = "a list of whole numbers, periods per axis, for example [1]"


def _center() -> Any:
    default = ByScene("middle of the box", lambda v: tuple(x / 2 for x in v["grid.length"]), ("grid.length",))
    rule = "a list of finite numbers, one per axis, for example [0.5]"
    return key(default, rule, "where the pulse is largest", unit="length", per_axis=True)


def _sharpness() -> Any:
    return key(60.0, ABOVE_0, "exp(-sharpness distance^2), summed over periodic images", unit="1 / length^2")


def _direction() -> Any:
    default = ByScene("1 along x, 0 along the others", lambda v: (1, 0, 0)[: v.dim], ("grid.cells",))
    return key(default, WAVE, "direction: whole periods along each axis", per_axis=True)


class Profile(Part):
    """A run starts from one of these."""

    slot = "initial.profile"
    physics = "acoustics"

    @rule("initial.center", "grid.length")
    @staticmethod
    def center_is_in_the_box(v: Values) -> Broken | None:
        """A point outside is far more often a forgotten center than a periodic image."""
        lengths = v["grid.length"]
        if all(0 <= x <= length for x, length in zip(v["initial.center"], lengths, strict=True)):
            return None
        return "initial.center", f"must lie in the box, from 0 to grid.length = {show(lengths)} on every axis"

    @rule("initial.sharpness", "grid.length")
    @staticmethod
    def sharpness_is_a_number(v: Values) -> Broken | None:
        """The exponent across the box, sharpness length², is an ordinary number."""
        if is_normal(*(v["initial.sharpness"] * length * length for length in v["grid.length"])):
            return None
        return "initial.sharpness", "is out of the range of floating point: sharpness length^2 overflows or vanishes"

    @rule("initial.wave")
    @staticmethod
    def wave_has_a_direction(v: Values) -> Broken | None:
        """Without a period on any axis there is no wave."""
        if any(v["initial.wave"]):
            return None
        return "initial.wave", f"must not be zero on every axis with initial.profile = {show(v['initial.profile'])}"


class Solution(Profile, ABC):
    """An exact solution; a profile uses those of the keywords that its formula names, the keys of its `Settings`.

    Parameters
    ----------
    length : d numbers
        Box lengths L_a; the box is [0, L_a) along axis a. Their number is the dimension d.
    gas : Gas
    center : d numbers, length
    sharpness : float, 1/length²
    wave : d whole numbers
        Periods per axis: k_a = 2π wave_a / L_a.

    Raises
    ------
    ValueError
        An entry that the profile uses is missing or out of range.
    """

    brings_in = ("exact solution and errors", "linear solvers")
    traits = (EXACT_SOLUTION,)

    @classmethod
    def brings(cls, v: Values) -> tuple[str, ...]:
        """Return the solution, and for reports the solver that finds what no node sees."""
        return cls.brings_in if v["output.report_at"] else cls.brings_in[:1]

    def __init__(
        self,
        *,
        length: Sequence[float],
        gas: Gas,
        center: Sequence[float] = (),
        sharpness: float = math.nan,
        wave: Sequence[int] = (),
    ) -> None:
        self.length = tuple(map(float, length))
        self.gas = gas
        self.center, self.sharpness, self.wave = center, sharpness, wave
        _per_axis("flow", gas.flow, len(self.length))
        self._set_up()

    @abstractmethod
    def _set_up(self) -> None:
        """Check the entries that the profile uses and compute what does not depend on (x, t)."""

    @abstractmethod
    def __call__(self, x: ArrayLike, t: float) -> Fields:
        """Evaluate the solution.

        Parameters
        ----------
        x : (n, d), length
            Positions, in the box or not, in any memory layout. Not modified.
        t : float, time

        Returns
        -------
        density : (n,), unit of ρ
            Perturbation ρ.
        velocity : (n, d), velocity
            Perturbation u, exactly zero at t = 0.
        """


class Gaussian(Solution):
    """A Gaussian about a point: f(x) = Σ over periodic images of exp(-sharpness |x - center|²), largest at `center`.

    In 1D two pulses travel apart (`PlaneGaussian` with wave 1). In 2D and 3D, where a ring or shell spreads, f is a
    product of 1D Gaussians, hence of cosine series, whose modes `CosineSeries` moves; at t = 0 the product serves.

    Raises
    ------
    ValueError
        sharpness is not positive, or so large that an axis needs more than 8192 waves in 2D, 512 in 3D.

    Notes
    -----
    Accurate to 1e-12 of the largest initial value (velocity: times c/ρ₀). Waves per axis: about 2 L_a √sharpness.
    """

    kind = "gaussian"
    about = "a round pulse"
    is_default = True

    class Settings(Keys):
        """Keys of the profile."""

        center: tuple[Finite, ...] = _center()
        sharpness: Positive = _sharpness()

    @classmethod
    def describe(cls, v: Values) -> str:
        """Return place and width."""
        return f"gaussian at {list(v['initial.center'])}, sharpness {v['initial.sharpness']:g}"

    def _set_up(self) -> None:
        d = len(self.length)
        self.origin = _per_axis("center", self.center, d)
        self.exponents = [_positive(self.sharpness) * box**2 for box in self.length]
        self.moving: PlaneGaussian | CosineSeries
        if d == 1:
            box, gas, center = self.length, self.gas, self.origin
            self.moving = PlaneGaussian(length=box, gas=gas, center=center, sharpness=self.sharpness, wave=(1,))
            return
        most = max(map(wave_count, self.exponents))
        if most > MOST_WAVES[d]:
            allowed = (math.pi * MOST_WAVES[d] / max(self.length)) ** 2 / EXPONENT
            raise ValueError(
                f"sharpness = {self.sharpness:g} needs {most} waves on an axis; the limit in {d}D is {MOST_WAVES[d]}: "
                f"this box allows sharpness up to {allowed:.3g}"
            )
        waves, amplitudes = zip(*map(gaussian_waves, self.exponents))
        self.moving = CosineSeries(self.length, self.gas, self.origin, waves, amplitudes)

    def __call__(self, x: ArrayLike, t: float) -> Fields:
        """Evaluate at positions x (n, d) and time t, as `Solution` describes."""
        if t != 0.0 or len(self.length) == 1:
            return self.moving(x, t)
        x, density, velocity = prepare(x, len(self.length))
        for rows in chunks(len(x), CHUNK // 8):
            density[rows] = 1.0
            for a, (origin, box, exponent) in enumerate(zip(self.origin, self.length, self.exponents)):
                density[rows] *= periodic_gaussian(wrap((x[rows, a] - origin) / box), exponent)
        return density, velocity


class Plane(Solution):
    """Waves along one direction: ρ = ½[f(s - ct) + f(s + ct)], u = k̂ (c/2ρ₀)[f(s - ct) - f(s + ct)] (d'Alembert).

    s = k̂·(x - center - vt) is the distance along k̂ = k/|k|, and f repeats with the wavelength λ = 2π/|k|. In 1D
    ρ = ½[f(x - (v+c)t) + f(x - (v-c)t)], u = (c/2ρ₀)[f(x - (v+c)t) - f(x - (v-c)t)]; the printed equation has (c - u₀)
    in both terms, where the first must be (c + u₀): the wave that moves with the flow is the faster one.

    Notes
    -----
    Shifts are reduced modulo their period in exact rational arithmetic, so that a long time costs no accuracy.
    O(n), at most 5 terms of f a point.

    References
    ----------
    Gritton, Berzins, Kirby (2015), eq. 7.
    """

    def _set_up(self) -> None:
        self.periods = _whole(self.wave, len(self.length))
        if not any(self.periods):
            raise ValueError("wave must have an entry other than 0: it gives the direction")
        waves_per_length = [w / box for w, box in zip(self.periods, self.length)]
        self.wavelength = 1.0 / math.hypot(*waves_per_length)
        self.direction = np.array(waves_per_length) * self.wavelength
        self.origin = (0.0,) * len(self.length)

    @abstractmethod
    def shape(self, s: FloatArray) -> FloatArray:
        """Return f at the distances s, counted in wavelengths, -½ <= s <= ½."""

    def __call__(self, x: ArrayLike, t: float) -> Fields:
        """Evaluate at positions x (n, d) and time t, as `Solution` describes."""
        x, density, velocity = prepare(x, len(self.length))
        travelled = remainder(0.0, self.gas.sound_speed, t, self.wavelength) / self.wavelength
        origin = [remainder(o, v, t, box) for o, v, box in zip(self.origin, self.gas.flow, self.length)]
        speed = 0.5 * self.gas.sound_speed / self.gas.density * self.direction
        for rows in chunks(len(x), CHUNK // 8):
            s = total_of([w * ((x[rows, a] - origin[a]) / self.length[a]) for a, w in enumerate(self.periods) if w])
            forward = self.shape(wrap(s - travelled))
            backward = self.shape(wrap(s + travelled))
            density[rows] = 0.5 * (forward + backward)
            np.multiply.outer(forward - backward, speed, out=velocity[rows])
        return density, velocity


class PlaneGaussian(Plane):
    """A Gaussian of the distance from a plane: f(s) = Σ_m exp(-sharpness (s - mλ)²), moved by `Plane`."""

    kind = "plane-gaussian"
    about = "a Gaussian of the distance from a plane"

    class Settings(Keys):
        """Keys of the profile."""

        center: tuple[Finite, ...] = _center()
        sharpness: Positive = _sharpness()
        wave: tuple[int, ...] = _direction()

    @classmethod
    def describe(cls, v: Values) -> str:
        """Return direction and width."""
        return f"{cls.kind}, periods {list(v['initial.wave'])}, sharpness {v['initial.sharpness']:g}"

    def _set_up(self) -> None:
        super()._set_up()
        self.origin = _per_axis("center", self.center, len(self.length))
        self.exponent = _positive(self.sharpness) * self.wavelength**2

    def shape(self, s: FloatArray) -> FloatArray:
        """Return Σ_m exp(-sharpness λ² (s - m)²)."""
        return periodic_gaussian(s, self.exponent)


class PlaneWave(Plane):
    """One mode at rest: f = cos(k·x), ρ = cos(k·ξ) cos(c|k|t), u = (k/|k|) (c/ρ₀) sin(k·ξ) sin(c|k|t), ξ = x - vt."""

    kind = "plane-wave"
    about = "one cosine along a direction, at rest"

    class Settings(Keys):
        """Keys of the profile."""

        wave: tuple[int, ...] = _direction()

    @classmethod
    def describe(cls, v: Values) -> str:
        """Return the periods."""
        return f"{cls.kind}, periods {list(v['initial.wave'])}"

    def shape(self, s: FloatArray) -> FloatArray:
        """Return cos(2πs)."""
        return np.asarray(np.cos(2.0 * np.pi * s))


class StandingWave(Solution):
    """The product f(x) = Π_a cos(k_a x_a), one mode of `CosineSeries`; axes with wave 0 contribute 1."""

    kind = "standing-wave"
    about = "a product of cosines along the axes"

    class Settings(Keys):
        """Keys of the profile."""

        wave: tuple[int, ...] = key(
            ByScene("1 per axis", lambda v: (1,) * v.dim, ("grid.cells",)),
            WAVE,
            "periods along each axis",
            per_axis=True,
        )

    @classmethod
    def describe(cls, v: Values) -> str:
        """Return the periods."""
        return f"{cls.kind}, periods {list(v['initial.wave'])}"

    def _set_up(self) -> None:
        waves = [np.array([w]) for w in _whole(self.wave, len(self.length))]
        self.series = CosineSeries(self.length, self.gas, (0.0,) * len(waves), waves, [np.ones(1)] * len(waves))

    def __call__(self, x: ArrayLike, t: float) -> Fields:
        """Evaluate at positions x (n, d) and time t, as `Solution` describes."""
        return self.series(x, t)


class StateFromFile(Profile):
    """No profile: density and velocity come with the particles of a file, zero where it has none."""

    kind = "file"
    about = "density and velocity of the particle file; there is no exact solution to compare with"

    @rule("initial.profile", "particles.layout")
    @staticmethod
    def comes_with_the_particles(v: Values) -> Broken | None:
        """Initial values per particle come with the particles."""
        if v["particles.layout"] == "file":
            return None
        return "initial.profile", f'needs particles.layout = "file"; it is {show(v["particles.layout"])}'

    @classmethod
    def describe(cls, v: Values) -> str:
        """Return the file."""
        return f"from {v['particles.path']}"


PROFILES: Choices[Solution] = Choices(Solution)
"""Kind to class."""


def solution(profile: str, *, length: Sequence[float], gas: Gas, **settings: Any) -> Solution:
    """Return the named profile; see `Solution` for the settings. ValueError for an unknown name, with the choices."""
    if profile not in PROFILES:
        raise ValueError(f"profile = {profile!r} is unknown; choose one of {', '.join(PROFILES)}")
    return PROFILES[profile](length=length, gas=gas, **settings)


def _per_axis(name: str, values: Sequence[float], d: int) -> tuple[float, ...]:
    if len(values) != d:
        raise ValueError(f"{name} has {len(values)} entries, expected one per axis, {d}")
    return tuple(map(float, values))


def _whole(wave: Sequence[int], d: int) -> tuple[float, ...]:
    values = _per_axis("wave", wave, d)
    if not all(w.is_integer() for w in values):
        raise ValueError(f"wave = {list(wave)} must be whole numbers: whole periods per axis")
    return values


def _positive(sharpness: float) -> float:
    if not sharpness > 0.0:
        raise ValueError(f"sharpness = {sharpness:g} must be positive")
    return float(sharpness)
