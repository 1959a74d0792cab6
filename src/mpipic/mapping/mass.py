"""The mass of a scheme: what solves for nodal fields from the sums Φᵀq of particle values.

    lumped          diag(d)⁻¹ Φᵀq, d = Φᵀ1      weighted means
    least squares   G⁺ Φᵀq, G = ΦᵀΦ             the field that fits the particles best
    penalised       (G + penalty)⁻¹ Φᵀq         the same, smooth where particles say little

Stages of a step run on nodal fields, while their increments Φ a go to the particles. So a mass also has a `response`,
what its fields gain from them: fields(sums + G a) = fields(sums) + response(a) for the lumped mass, and for least
squares up to what no particle sees. With a penalty the method is defined by a response of a all the same.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from mpipic.arrays import FloatArray
from mpipic.mapping.mapping import NodalMapping

if TYPE_CHECKING:
    from mpipic.mapping.gram import Penalty


class Mass(ABC):
    """How particle values become nodal fields."""

    @abstractmethod
    def fields(self, sums: FloatArray, name: str, quantities: Sequence[int] | None = None) -> FloatArray:
        """Nodal fields from Φᵀq, (local_nodes, k); `name` tells series apart. Collective.

        `quantities` are the numbers of columns that make up a scalar or a vector, one after the other; by default all
        make up one.
        """

    @abstractmethod
    def response(self, coefficients: FloatArray) -> FloatArray:
        """What the nodal fields gain when the particles gain Φ times the coefficients. Collective."""

    def forget(self) -> None:
        """Begin every series anew. Local."""
        return

    @property
    def nbytes(self) -> int:
        """Bytes held."""
        return 0


class LumpedMass(Mass):
    """S = diag(d)⁻¹ Φᵀ, weighted means; answers with SΦ."""

    def __init__(self, mapping: NodalMapping) -> None:
        self.mapping = mapping

    def fields(self, sums: FloatArray, name: str, quantities: Sequence[int] | None = None) -> FloatArray:
        """diag(d)⁻¹ sums. Local."""
        return self.mapping.divide(np.ascontiguousarray(sums))

    def response(self, coefficients: FloatArray) -> FloatArray:
        """SΦ coefficients. Collective on neighbours."""
        return self.mapping.divide(self.mapping.apply_gram(coefficients))


class LeastSquaresMass(Mass):
    """(G + penalty)⁻¹ Φᵀ: the field that fits the particles best, and if penalised, is smooth where they say little.

    Without a penalty, G⁺ΦᵀΦ = 1 but for what no particle sees: the fields answer with the coefficients themselves. With
    one, the method is defined so.
    """

    def __init__(self, mapping: NodalMapping, tolerance: float, penalty: Penalty | None = None) -> None:
        from mpipic.mapping.solver import GramSolver

        self.solver = GramSolver(mapping, tolerance, "mass_", penalty)
        self.penalised = penalty is not None

    def fields(self, sums: FloatArray, name: str, quantities: Sequence[int] | None = None) -> FloatArray:
        """(G + penalty)⁻¹ sums, all columns together. Collective.

        On a singular G what no particle sees is left as small as the solver leaves it that begins at zero; only a
        penalty, which leaves one solution, allows a guess from earlier steps.
        """
        return self.solver.solve(sums, name if self.penalised else None, quantities or (sums.shape[1],))

    def response(self, coefficients: FloatArray) -> FloatArray:
        """The coefficients. Local."""
        return coefficients

    def forget(self) -> None:
        """Begin every series anew. Local."""
        self.solver.forget()

    @property
    def nbytes(self) -> int:
        """Bytes of the solver."""
        return self.solver.nbytes


def penalty_of(settings: Any) -> Penalty | None:
    """The penalty that a record like the scene's [mapping] section asks for."""
    from mpipic.mapping.gram import Penalty

    return Penalty(settings.penalty, settings.penalty_order) if settings.mass == "penalised" else None
