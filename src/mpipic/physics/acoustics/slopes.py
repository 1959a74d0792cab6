"""Gradients of nodal fields, as what particle values gain: at the particles, filtered, skew, or on the nodes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar

from mpipic.arrays import FloatArray
from mpipic.keys import EvenUpTo12, Keys, key
from mpipic.mapping.mass import Gain, Workspace
from mpipic.parts import NODAL_FILTER, NODAL_GRADIENTS, Broken, Choices, Part, Values, kinds_with, rule
from mpipic.wording import listed, show

if TYPE_CHECKING:
    from mpipic.filters.family import NodalFilter
    from mpipic.mapping.spline_sweep import SplineSweep
    from mpipic.mapping.sweep import ParticleSweep


class Slopes(Part, ABC):
    """Divergence and gradient of nodal fields as gains of particle values.

    Parameters
    ----------
    sweep
        The particles, mapped.
    work
        Where sums on the way go.

    Attributes
    ----------
    direct : bool
        Whether gains are not spanned: coefficients are nodal fields that particles take the gradient of themselves.
    transposed : bool
        Whether the sweep must know the transposed gradient.
    """

    slot = "mapping.gradient"
    physics = "acoustics"
    direct: ClassVar[bool] = False
    transposed: ClassVar[bool] = False

    def __init__(self, sweep: ParticleSweep, work: Workspace) -> None:
        self.sweep, self.work = sweep, work

    @classmethod
    @abstractmethod
    def create(cls, sweep: ParticleSweep, work: Workspace, filter_: NodalFilter | None, **settings: Any) -> Slopes:
        """Return the slopes of a scene that names this part, with its filter if that acts. Local."""

    @abstractmethod
    def divergence(self, u: FloatArray, stage: int, out: FloatArray | None = None) -> Gain:
        """Return the gain ∇·u of a nodal velocity (local_nodes, d), ghosts filled. Collective.

        out : (local_nodes, 1), where coefficients may go that are made anew.
        """

    @abstractmethod
    def gradient(self, rho: FloatArray, stage: int, out: FloatArray | None = None) -> Gain:
        """Return the gain ∇ρ of a nodal density (local_nodes, 1), ghosts filled. Collective.

        out : (local_nodes, d), where coefficients may go that are made anew.
        """

    def forget(self) -> None:
        """Begin every series anew. Local."""
        return

    def remarks(self) -> list[str]:
        """Return what whoever uses the results should know of. Local."""
        return []

    @property
    def nbytes(self) -> int:
        """Bytes held."""
        return 0

    def divergence_sums(self, u: FloatArray) -> FloatArray:
        """Return Σ_a ΦᵀD^a u_a, right on own and ghost nodes, (local_nodes, 1). Collective."""
        out = self.work("scalar", 1)
        out.fill(0.0)
        return self.sweep.complete(self.sweep.divergence_sums(u, out))

    def gradient_sums(self, rho: FloatArray) -> FloatArray:
        """Return ΦᵀD^a ρ, right on own and ghost nodes, (local_nodes, d). Collective."""
        out = self.work("vector", self.sweep.grid.dim)
        out.fill(0.0)
        return self.sweep.complete(self.sweep.gradient_sums(rho, out))

    def gram(self, coefficients: FloatArray) -> FloatArray:
        """Return G coefficients, (local_nodes, k). Collective."""
        columns = coefficients.shape[1]
        return self.sweep.gram.apply(coefficients, self.work("scalar" if columns == 1 else "vector", columns))


class UnfilteredSlopes(Slopes):
    """D at the particles, unfiltered: each particle takes the gradient of the nodal fields itself."""

    direct = True

    @classmethod
    def create(cls, sweep: ParticleSweep, work: Workspace, filter_: NodalFilter | None, **settings: Any) -> Slopes:
        """Return the slopes. Local."""
        return cls(sweep, work)

    def divergence(self, u: FloatArray, stage: int, out: FloatArray | None = None) -> Gain:
        """Return the gain with coefficients u. Local."""
        return Gain(u, False, self.divergence_sums, f"divergence {stage}")

    def gradient(self, rho: FloatArray, stage: int, out: FloatArray | None = None) -> Gain:
        """Return the gain with coefficients ρ. Local."""
        return Gain(rho, False, self.gradient_sums, f"gradient {stage}")


class FilteredSlopes(Slopes):
    """F D at the particles (the paper): coefficients N ΦᵀD^a of the filter F = Φ N Φᵀ."""

    kind = "direct"
    about = "at the particles, then filtered, as in the paper"
    is_default = True

    @classmethod
    def create(cls, sweep: ParticleSweep, work: Workspace, filter_: NodalFilter | None, **settings: Any) -> Slopes:
        """Return the slopes, unfiltered ones without a filter. Local."""
        return UnfilteredSlopes(sweep, work) if filter_ is None else cls(sweep, work, filter_)

    @classmethod
    def describe(cls, v: Values) -> str:
        """Return where gradients are taken."""
        return "gradient at the particles"

    def __init__(self, sweep: ParticleSweep, work: Workspace, filter_: NodalFilter) -> None:
        super().__init__(sweep, work)
        self.filter = filter_

    def divergence(self, u: FloatArray, stage: int, out: FloatArray | None = None) -> Gain:
        """Return the gain with coefficients N Σ_a C^a u_a, C = ΦᵀD. Collective."""
        return self._filtered(self.divergence_sums(u), f"divergence {stage}", out)

    def gradient(self, rho: FloatArray, stage: int, out: FloatArray | None = None) -> Gain:
        """Return the gain with coefficients N C^a ρ. Collective."""
        return self._filtered(self.gradient_sums(rho), f"gradient {stage}", out)

    def _filtered(self, sums: FloatArray, series: str, out: FloatArray | None) -> Gain:
        return Gain(self.filter.coefficients(sums, out, series), True, self.gram, series)

    def forget(self) -> None:
        """Begin every series anew. Local."""
        self.filter.forget()

    def remarks(self) -> list[str]:
        """Return those of the filter. Local."""
        return self.filter.remarks()

    @property
    def nbytes(self) -> int:
        """Bytes that the filter holds."""
        return self.filter.nbytes


class GridSlopes(Slopes):
    """Derivatives taken on the nodal arrays, by central differences: particles get Φ times them.

    What they get is in range(Φ) already, so that the exact projection and its equals change nothing and are left out;
    any other filter acts on it: N G in place of 1.
    """

    kind = "grid"
    about = "central differences of nodal fields: what particles get is seen by the nodes"
    traits = (NODAL_GRADIENTS,)

    class Settings(Keys):
        """Keys of the gradient."""

        gradient_order: EvenUpTo12 = key(10, "an even whole number from 2 to 12", "order of the central differences")

    @classmethod
    def create(cls, sweep: ParticleSweep, work: Workspace, filter_: NodalFilter | None, **settings: Any) -> Slopes:
        """Return the slopes. Local."""
        return cls(sweep, work, settings["gradient_order"], filter_)

    @classmethod
    def describe(cls, v: Values) -> str:
        """Return where gradients are taken, and their order."""
        return f"central differences of order {v['mapping.gradient_order']} on the nodes"

    @classmethod
    def node_doubles(cls, v: Values) -> int:
        """Return a vector, padded, and its differences."""
        return 2 * v.dim

    def __init__(self, sweep: ParticleSweep, work: Workspace, order: int, filter_: NodalFilter | None = None) -> None:
        from mpipic.mesh.differences import CentralDifference

        super().__init__(sweep, work)
        self.filter, self.difference = filter_, CentralDifference(sweep.grid, order)

    def divergence(self, u: FloatArray, stage: int, out: FloatArray | None = None) -> Gain:
        """Return the gain with coefficients Σ_a ∂_a u_a. Collective."""
        return self._filtered(self.difference.divergence(u), f"divergence {stage}", out)

    def gradient(self, rho: FloatArray, stage: int, out: FloatArray | None = None) -> Gain:
        """Return the gain with coefficients ∂_a ρ. Collective."""
        return self._filtered(self.difference.gradient(rho), f"gradient {stage}", out)

    def _filtered(self, slopes: FloatArray, series: str, out: FloatArray | None) -> Gain:
        if self.filter is not None:
            slopes = self.filter.coefficients(self.gram(slopes), out, series)
        return Gain(slopes, True, self.gram, series)

    def forget(self) -> None:
        """Begin every series anew. Local."""
        if self.filter is not None:
            self.filter.forget()

    def remarks(self) -> list[str]:
        """Return those of the filter. Local."""
        return self.filter.remarks() if self.filter else []

    @property
    def nbytes(self) -> int:
        """Bytes of the differences, and of the filter if there is one."""
        return self.difference.nbytes + (self.filter.nbytes if self.filter else 0)


class SkewSlopes(FilteredSlopes):
    """F of ½(D - (Dᵀ)ᵀ): ½(C - Cᵀ) in place of C = ΦᵀD.

    With least-squares fields and the exact projection, the rates are then a skew-symmetric operator on particle values:
    no integrator that is stable on the imaginary axis can make it grow. Its price is consistency on disordered
    particles.
    """

    kind = "skew"
    about = "at the particles, made skew-symmetric: stable with exact and least squares, less accurate on disorder"
    transposed = True
    sweep: SplineSweep

    @rule("mapping.gradient", "filter.kind")
    @staticmethod
    def needs_a_nodal_filter(v: Values) -> Broken | None:
        """The skew gradient is made of nodal sums, which a filter takes to coefficients."""
        if v.has(NODAL_FILTER):
            return None
        nodal = kinds_with("filter.kind", NODAL_FILTER, v["physics.kind"])
        return "mapping.gradient", f"needs filter.kind = {listed(nodal, 'or')}; it is {show(v['filter.kind'])}"

    @classmethod
    def describe(cls, v: Values) -> str:
        """Return the name."""
        return "skew gradient"

    def divergence_sums(self, u: FloatArray) -> FloatArray:
        """Return ½ Σ_a (C^a - (C^a)ᵀ) u_a, right on own and ghost nodes, (local_nodes, 1). Collective."""
        zeros = self.sweep.grid.zeros
        difference = self.sweep.divergence_sums(u, zeros(1)) - self.sweep.transposed_divergence_sums(u, zeros(1))
        return self.sweep.complete(0.5 * difference)

    def gradient_sums(self, rho: FloatArray) -> FloatArray:
        """Return ½ (C^a - (C^a)ᵀ) ρ, right on own and ghost nodes, (local_nodes, d). Collective."""
        zeros, dim = self.sweep.grid.zeros, self.sweep.grid.dim
        difference = self.sweep.gradient_sums(rho, zeros(dim)) - self.sweep.transposed_gradient_sums(rho, zeros(dim))
        return self.sweep.complete(0.5 * difference)


GRADIENTS: Choices[Slopes] = Choices(Slopes)
"""Kind to class."""
