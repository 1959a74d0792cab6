"""Gradients of nodal fields, as changes of particle values: at the particles, filtered, skew, or on the nodes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

from mpipic.arrays import FloatArray
from mpipic.filters import NodalFilter
from mpipic.mapping.mapping import NodalMapping
from mpipic.mapping.mass import Mass
from mpipic.mapping.sweep import ParticleSweep, SplineSweep
from mpipic.mesh.differences import CentralDifference


class Rate(NamedTuple):
    """Of one field: coefficients of the particles' change, and the change of the nodal field; (local_nodes, k)."""

    coefficients: FloatArray
    field: FloatArray


class Slopes(ABC):
    """Divergence and gradient of nodal fields as changes of particle values."""

    direct = False
    """Whether coefficients are nodal fields that particles take the gradient of themselves."""

    @abstractmethod
    def divergence(self, u: FloatArray, stage: int) -> Rate:
        """Of (local_nodes, d)."""

    @abstractmethod
    def gradient(self, rho: FloatArray, stage: int) -> Rate:
        """Of (local_nodes, 1)."""

    def forget(self) -> None:
        """Begin every series anew. Local."""
        return

    @property
    def nbytes(self) -> int:
        """Bytes held."""
        return 0


class UnfilteredSlopes(Slopes):
    """D at the particles, unfiltered: each particle takes the gradient of the nodal fields itself."""

    direct = True

    def __init__(self, sweep: ParticleSweep, mass: Mass) -> None:
        self.sweep, self.mass = sweep, mass

    def divergence(self, u: FloatArray, stage: int) -> Rate:
        """Coefficients u."""
        sums = self.sweep.complete(self.sweep.divergence_sums(u, out=self.sweep.grid.zeros(1)))
        return Rate(u, self.mass.fields(sums, f"divergence {stage}"))

    def gradient(self, rho: FloatArray, stage: int) -> Rate:
        """Coefficients ρ."""
        sums = self.sweep.complete(self.sweep.gradient_sums(rho, out=self.sweep.grid.zeros(self.sweep.grid.dim)))
        return Rate(rho, self.mass.fields(sums, f"gradient {stage}"))


class FilteredSlopes(Slopes):
    """F D at the particles (the paper), or with `skew`, F of ½(D - (Dᵀ)ᵀ): ½(C - Cᵀ) in place of C = ΦᵀD.

    Skew, with least-squares fields and the exact projection, the rates are a skew-symmetric operator on particle
    values: no integrator that is stable on the imaginary axis can make it grow. Its price is consistency on disordered
    particles.
    """

    def __init__(self, sweep: ParticleSweep, mass: Mass, filter_: NodalFilter, skew: bool = False) -> None:
        self.sweep, self.mass, self.filter, self.skew = sweep, mass, filter_, skew

    def divergence(self, u: FloatArray, stage: int) -> Rate:
        """Coefficients N Σ_a C^a u_a."""
        sums = self.sweep.divergence_sums(u, out=self.sweep.grid.zeros(1))
        if self.skew:
            sums = 0.5 * (sums - self._transposable.transposed_divergence_sums(u, out=self.sweep.grid.zeros(1)))
        return self._rate(sums, f"divergence {stage}")

    def gradient(self, rho: FloatArray, stage: int) -> Rate:
        """Coefficients N C^a ρ."""
        dim = self.sweep.grid.dim
        sums = self.sweep.gradient_sums(rho, out=self.sweep.grid.zeros(dim))
        if self.skew:
            sums = 0.5 * (sums - self._transposable.transposed_gradient_sums(rho, out=self.sweep.grid.zeros(dim)))
        return self._rate(sums, f"gradient {stage}")

    def _rate(self, sums: FloatArray, series: str) -> Rate:
        a = self.filter.coefficients(self.sweep.complete(sums), series=series)
        return Rate(a, self.mass.response(a))

    @property
    def _transposable(self) -> SplineSweep:
        assert isinstance(self.sweep, SplineSweep)
        return self.sweep

    def forget(self) -> None:
        """Begin every series anew. Local."""
        self.filter.forget()

    @property
    def nbytes(self) -> int:
        """Bytes that the filter holds."""
        return self.filter.nbytes


class GridSlopes(Slopes):
    """Derivatives taken on the nodal arrays, by central differences: particles get Φ times them.

    What they get is in range(Φ) already, so that the exact projection and its equals change nothing and are left out;
    any other filter acts on it: N G in place of 1.
    """

    def __init__(self, sweep: NodalMapping, mass: Mass, order: int, filter_: NodalFilter | None = None) -> None:
        self.sweep, self.mass, self.filter = sweep, mass, filter_
        self.difference = CentralDifference(sweep.grid, order)

    def divergence(self, u: FloatArray, stage: int) -> Rate:
        """Coefficients Σ_a ∂_a u_a."""
        return self._rate(self.difference.divergence(u), f"divergence {stage}")

    def gradient(self, rho: FloatArray, stage: int) -> Rate:
        """Coefficients ∂_a ρ."""
        return self._rate(self.difference.gradient(rho), f"gradient {stage}")

    def _rate(self, a: FloatArray, series: str) -> Rate:
        if self.filter is not None:
            a = self.filter.coefficients(self.sweep.apply_gram(a), series=series)
        return Rate(a, self.mass.response(a))

    def forget(self) -> None:
        """Begin every series anew. Local."""
        if self.filter is not None:
            self.filter.forget()

    @property
    def nbytes(self) -> int:
        """Bytes of the differences, and of the filter if there is one."""
        return self.difference.nbytes + (self.filter.nbytes if self.filter else 0)
