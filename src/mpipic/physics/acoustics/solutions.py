"""Initial data and exact solutions of linearised gas dynamics on a periodic box, as one function of (x, t).

About density ρ₀ and uniform flow v, with D/Dt = ∂/∂t + v·∇ and sound speed c, the perturbations obey

    Dρ/Dt = -ρ₀ ∇·u,    Du/Dt = -(c²/ρ₀) ∇ρ,    ρ(x, 0) = f(x),  u(x, 0) = 0.

In the moving frame ξ = x - vt every mode of f keeps its shape and swings at the frequency c|k|: cos(k·ξ) gives

    ρ = cos(k·ξ) cos(c|k|t),    u = (k/|k|) (c/ρ₀) sin(k·ξ) sin(c|k|t).

A profile is a class in `PROFILES`; an object of it is called with (x, t), and t = 0 gives the initial data. Any
consistent set of units serves. Everything here is local: each rank evaluates its own particles.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from fractions import Fraction
from functools import reduce

import numpy as np
from numpy.typing import ArrayLike

from mpipic.arrays import FloatArray
from mpipic.physics.acoustics.gas import Gas

Fields = tuple[FloatArray, FloatArray]  # density (n,) and velocity (n, d)

# Terms below exp(-EXPONENT), about 1e-17, of the largest value are dropped.
EXPONENT = 39.0
# Doubles in one temporary array: 4 MB, so that a chunk and the weights stay far below 100 MB together.
CHUNK = 1 << 19
# Waves per axis that the series of a Gaussian may have, by dimension; each point costs their product.
MOST_WAVES = {2: 8192, 3: 512}


class Solution(ABC):
    """An exact solution; every profile takes the same keywords and ignores those that its formula does not name.

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

    def __init__(
        self, *, length: Sequence[float], gas: Gas, center: Sequence[float], sharpness: float, wave: Sequence[int]
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
        x, density, velocity = _prepare(x, len(self.length))
        travelled = _remainder(0.0, self.gas.sound_speed, t, self.wavelength) / self.wavelength
        origin = [_remainder(o, v, t, box) for o, v, box in zip(self.origin, self.gas.flow, self.length)]
        speed = 0.5 * self.gas.sound_speed / self.gas.density * self.direction
        for rows in _chunks(len(x), CHUNK // 8):
            s = _total([w * ((x[rows, a] - origin[a]) / self.length[a]) for a, w in enumerate(self.periods) if w])
            forward = self.shape(_wrap(s - travelled))
            backward = self.shape(_wrap(s + travelled))
            density[rows] = 0.5 * (forward + backward)
            np.multiply.outer(forward - backward, speed, out=velocity[rows])
        return density, velocity


class PlaneGaussian(Plane):
    """A Gaussian of the distance from a plane: f(s) = Σ_m exp(-sharpness (s - mλ)²), moved by `Plane`."""

    def _set_up(self) -> None:
        super()._set_up()
        self.origin = _per_axis("center", self.center, len(self.length))
        self.exponent = _positive(self.sharpness) * self.wavelength**2

    def shape(self, s: FloatArray) -> FloatArray:
        """Return Σ_m exp(-sharpness λ² (s - m)²)."""
        return periodic_gaussian(s, self.exponent)


class PlaneWave(Plane):
    """One mode at rest: f = cos(k·x), ρ = cos(k·ξ) cos(c|k|t), u = (k/|k|) (c/ρ₀) sin(k·ξ) sin(c|k|t), ξ = x - vt."""

    def shape(self, s: FloatArray) -> FloatArray:
        """Return cos(2πs)."""
        return np.cos(2.0 * np.pi * s)


class StandingWave(Solution):
    """The product f(x) = Π_a cos(k_a x_a), one mode of `CosineSeries`; axes with wave 0 contribute 1."""

    def _set_up(self) -> None:
        waves = [np.array([w]) for w in _whole(self.wave, len(self.length))]
        self.series = CosineSeries(self.length, self.gas, (0.0,) * len(waves), waves, [np.ones(1)] * len(waves))

    def __call__(self, x: ArrayLike, t: float) -> Fields:
        """Evaluate at positions x (n, d) and time t, as `Solution` describes."""
        return self.series(x, t)


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

    def _set_up(self) -> None:
        d = len(self.length)
        self.origin = _per_axis("center", self.center, d)
        self.exponents = [_positive(self.sharpness) * box**2 for box in self.length]
        self.moving: PlaneGaussian | CosineSeries
        if d == 1:
            box, gas, center = self.length, self.gas, self.origin
            self.moving = PlaneGaussian(length=box, gas=gas, center=center, sharpness=self.sharpness, wave=(1,))
            return
        most = max(map(_wave_count, self.exponents))
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
        x, density, velocity = _prepare(x, len(self.length))
        for rows in _chunks(len(x), CHUNK // 8):
            density[rows] = 1.0
            for a, (origin, box, exponent) in enumerate(zip(self.origin, self.length, self.exponents)):
                density[rows] *= periodic_gaussian(_wrap((x[rows, a] - origin) / box), exponent)
        return density, velocity


class CosineSeries:
    """The solution whose initial data are a product of cosine series, f(x) = Π_a Σ_n A_an cos(k_an (x_a - center_a)).

    With ξ = x - center - vt and the sum over all combinations of one wave per axis, A the product of their amplitudes,

        ρ = Σ A cos(c|k|t) Π_a cos(k_a ξ_a),    u_a = (c/ρ₀) Σ A (k_a/|k|) sin(c|k|t) sin(k_a ξ_a) Π_{b≠a} cos(k_b ξ_b).

    Parameters
    ----------
    length, gas, center
        As in `Solution`.
    waves : per axis (K_a,), whole numbers
        Periods per box length: k_an = 2π waves[a][n] / L_a.
    amplitudes : per axis (K_a,)
        A_an; their product over axes has the unit of ρ.

    Notes
    -----
    About 2(d + 1) K₁⋯K_d flops a point, as matrix products over chunks of points and blocks of waves, so that
    temporaries stay below 100 MB. Evenness about the center along every axis leaves real cosines and one sine.
    """

    def __init__(
        self,
        length: Sequence[float],
        gas: Gas,
        center: Sequence[float],
        waves: Sequence[FloatArray],
        amplitudes: Sequence[FloatArray],
    ) -> None:
        self.length, self.gas, self.center = tuple(length), gas, tuple(center)
        self.waves, self.amplitudes = tuple(waves), tuple(amplitudes)

    def __call__(self, x: ArrayLike, t: float) -> Fields:
        """Density (n,) and velocity (n, d) at the positions x (n, d) and the time t, as in `Solution`."""
        d = len(self.length)
        x, density, velocity = _prepare(x, d)
        origin = [_remainder(o, v, t, box) for o, v, box in zip(self.center, self.gas.flow, self.length)]
        rest = math.prod(len(w) for w in self.waves[1:])
        width = min(len(self.waves[0]), max(1, CHUNK // (2 * rest)))
        for block in _chunks(len(self.waves[0]), width):
            weights = self._weights(block, t)
            for rows in _chunks(len(x), max(1, CHUNK // max(8, rest, 2 * width))):
                offset = [_wrap((x[rows, a] - origin[a]) / self.length[a]) for a in range(d)]
                for field, modes in zip((density, velocity), self._modes(offset, block, weights)):
                    field[rows] += modes
        velocity *= self.gas.sound_speed / self.gas.density
        return density, velocity

    def _weights(self, block: slice, t: float) -> list[FloatArray]:
        """Factors of ρ, u_0, …, u_{d-1} at time t, without c/ρ₀: each (K_1⋯K_{d-1}, waves of axis 0 in `block`)."""
        d = len(self.length)
        order = [*range(1, d), 0]
        k_all = [2.0 * np.pi * w / box for w, box in zip(self.waves, self.length)]
        k_all[0] = k_all[0][block]
        factors = [self.amplitudes[0][block], *self.amplitudes[1:]]
        k = dict(zip(order, np.ix_(*(k_all[a] for a in order))))
        amplitude = math.prod(np.ix_(*(factors[a] for a in order)))
        norm = np.sqrt(sum(k[a] ** 2 for a in range(d)))
        phase = (self.gas.sound_speed * t) * norm
        # The mean has no direction and no velocity: dividing by 1 instead of |k| = 0 leaves k_a = 0 to say so.
        swing = amplitude * np.sin(phase) / np.where(norm == 0.0, 1.0, norm)
        arrays = [amplitude * np.cos(phase), *(k[a] * swing for a in range(d))]
        return [array.reshape(-1, array.shape[-1]) for array in arrays]

    def _modes(self, offset: list[FloatArray], block: slice, weights: list[FloatArray]) -> Fields:
        """Sum of the modes of `block` at the points `offset`, in box lengths: density (n,) and velocity (n, d)."""
        d, n = len(offset), len(offset[0])
        waves = [self.waves[0][block], *self.waves[1:]]
        phases = [np.multiply.outer(2.0 * np.pi * s, w) for s, w in zip(offset, waves)]
        cos, sin = [np.cos(phase) for phase in phases], [np.sin(phase) for phase in phases]
        # The first product serves ρ, even along axis 0, and u_0, odd along it.
        both = _products(cos[1:], n) @ np.hstack(weights[:2])
        width = len(waves[0])
        density = np.einsum("nk,nk->n", both[:, :width], cos[0])
        velocity = [np.einsum("nk,nk->n", both[:, width:], sin[0])]
        for a in range(1, d):
            tables = [sin[b] if b == a else cos[b] for b in range(1, d)]
            velocity.append(np.einsum("nk,nk->n", _products(tables, n) @ weights[a + 1], cos[0]))
        return density, np.stack(velocity, axis=1)


PROFILES: dict[str, type[Solution]] = {
    "gaussian": Gaussian,
    "plane-gaussian": PlaneGaussian,
    "plane-wave": PlaneWave,
    "standing-wave": StandingWave,
}


def solution(
    profile: str, *, length: Sequence[float], gas: Gas, center: Sequence[float], sharpness: float, wave: Sequence[int]
) -> Solution:
    """Build the named profile; see `Solution` for the arguments. ValueError for an unknown name, with the choices."""
    if profile not in PROFILES:
        raise ValueError(f"profile = {profile!r} is unknown; choose one of {', '.join(PROFILES)}")
    return PROFILES[profile](length=length, gas=gas, center=center, sharpness=sharpness, wave=wave)


def periodic_gaussian(s: FloatArray, exponent: float) -> FloatArray:
    """Σ_m exp(-exponent (s - m)²) over all whole m, for -½ <= s <= ½, to rounding of its largest value.

    Summed over images or, where those are more, as a Fourier series (Poisson summation): at most 5 terms.
    """
    images = math.ceil(math.sqrt(EXPONENT / exponent) - 0.5)
    if 2 * images + 1 <= _wave_count(exponent):
        root = math.sqrt(exponent)
        return _total([np.exp(-((root * (s - m)) ** 2)) for m in range(-images, images + 1)])
    waves, amplitudes = gaussian_waves(exponent)
    return _total([amplitude * np.cos((2.0 * np.pi * n) * s) for n, amplitude in zip(waves, amplitudes)])


def gaussian_waves(exponent: float) -> tuple[FloatArray, FloatArray]:
    """Waves n = 0, 1, … and amplitudes A_n with Σ_m exp(-exponent (s - m)²) = Σ_n A_n cos(2πns), to rounding.

    A_n = √(π/exponent) exp(-π²n²/exponent), doubled for n > 0.
    """
    waves = np.arange(_wave_count(exponent), dtype=np.float64)
    amplitudes = math.sqrt(np.pi / exponent) * np.exp(-((np.pi * waves) ** 2) / exponent)
    amplitudes[1:] *= 2.0
    return waves, amplitudes


def _wave_count(exponent: float) -> int:
    return max(1, math.ceil(math.sqrt(EXPONENT * exponent) / math.pi))


def _total(terms: list[FloatArray]) -> FloatArray:
    return reduce(np.add, terms)


def _products(tables: list[FloatArray], n: int) -> FloatArray:
    """Return all products of one entry per table, row by row: (n, K_1), … to (n, K_1⋯K_j), last index fastest."""
    result = tables[0] if tables else np.ones((n, 1))
    for table in tables[1:]:
        result = (result[:, :, None] * table[:, None, :]).reshape(n, -1)
    return result


def _wrap(s: FloatArray) -> FloatArray:
    """Subtract the nearest whole number."""
    return s - np.rint(s)


def _remainder(start: float, speed: float, t: float, period: float) -> float:
    """(start + speed t) modulo period, exact before one final rounding."""
    return float((Fraction(float(start)) + Fraction(float(speed)) * Fraction(float(t))) % Fraction(float(period)))


def _chunks(n: int, size: int) -> Iterator[slice]:
    return (slice(first, min(first + size, n)) for first in range(0, n, size))


def _prepare(x: ArrayLike, d: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the positions as an array, and zeroed density (n,) and velocity (n, d)."""
    x = np.asarray(x, dtype=np.float64)
    if x.ndim != 2 or x.shape[1] != d:
        raise ValueError(f"x has shape {x.shape}, expected (n, {d})")
    return x, np.zeros(len(x)), np.zeros((len(x), d))


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
