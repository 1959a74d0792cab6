"""Sums of cosines and images: how periodic shapes are summed to rounding, and moved as waves; see `solutions`."""

from __future__ import annotations

import math
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
        x, density, velocity = prepare(x, d)
        origin = [remainder(o, v, t, box) for o, v, box in zip(self.center, self.gas.flow, self.length)]
        rest = math.prod(len(w) for w in self.waves[1:])
        width = min(len(self.waves[0]), max(1, CHUNK // (2 * rest)))
        for block in chunks(len(self.waves[0]), width):
            weights = self._weights(block, t)
            for rows in chunks(len(x), max(1, CHUNK // max(8, rest, 2 * width))):
                offset = [wrap((x[rows, a] - origin[a]) / self.length[a]) for a in range(d)]
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


def periodic_gaussian(s: FloatArray, exponent: float) -> FloatArray:
    """Σ_m exp(-exponent (s - m)²) over all whole m, for -½ <= s <= ½, to rounding of its largest value.

    Summed over images or, where those are more, as a Fourier series (Poisson summation): at most 5 terms.
    """
    images = math.ceil(math.sqrt(EXPONENT / exponent) - 0.5)
    if 2 * images + 1 <= wave_count(exponent):
        root = math.sqrt(exponent)
        return total_of([np.exp(-((root * (s - m)) ** 2)) for m in range(-images, images + 1)])
    waves, amplitudes = gaussian_waves(exponent)
    return total_of([amplitude * np.cos((2.0 * np.pi * n) * s) for n, amplitude in zip(waves, amplitudes)])


def gaussian_waves(exponent: float) -> tuple[FloatArray, FloatArray]:
    """Waves n = 0, 1, … and amplitudes A_n with Σ_m exp(-exponent (s - m)²) = Σ_n A_n cos(2πns), to rounding.

    A_n = √(π/exponent) exp(-π²n²/exponent), doubled for n > 0.
    """
    waves = np.arange(wave_count(exponent), dtype=np.float64)
    amplitudes = math.sqrt(np.pi / exponent) * np.exp(-((np.pi * waves) ** 2) / exponent)
    amplitudes[1:] *= 2.0
    return waves, amplitudes


def wave_count(exponent: float) -> int:
    """Return how many waves `gaussian_waves` gives."""
    return max(1, math.ceil(math.sqrt(EXPONENT * exponent) / math.pi))


def total_of(terms: list[FloatArray]) -> FloatArray:
    """Return the sum of the terms."""
    return reduce(np.add, terms)


def _products(tables: list[FloatArray], n: int) -> FloatArray:
    """Return all products of one entry per table, row by row: (n, K_1), … to (n, K_1⋯K_j), last index fastest."""
    result = tables[0] if tables else np.ones((n, 1))
    for table in tables[1:]:
        result = (result[:, :, None] * table[:, None, :]).reshape(n, -1)
    return result


def wrap(s: FloatArray) -> FloatArray:
    """Subtract the nearest whole number."""
    return np.asarray(s - np.rint(s))


def remainder(start: float, speed: float, t: float, period: float) -> float:
    """(start + speed t) modulo period, exact before one final rounding."""
    return float((Fraction(float(start)) + Fraction(float(speed)) * Fraction(float(t))) % Fraction(float(period)))


def chunks(n: int, size: int) -> Iterator[slice]:
    """Yield slices of at most `size` rows that cover n rows."""
    return (slice(first, min(first + size, n)) for first in range(0, n, size))


def prepare(x: ArrayLike, d: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the positions as an array, and zeroed density (n,) and velocity (n, d)."""
    x = np.asarray(x, dtype=np.float64)
    if x.ndim != 2 or x.shape[1] != d:
        raise ValueError(f"x has shape {x.shape}, expected (n, {d})")
    return x, np.zeros(len(x)), np.zeros((len(x), d))
