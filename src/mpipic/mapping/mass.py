"""The mass of a scheme: what solves for nodal fields from the sums Φᵀq of particle values.

    lumped          diag(d)⁻¹ Φᵀq, d = Φᵀ1      weighted means
    least squares   G⁺ Φᵀq, G = ΦᵀΦ             the field that fits the particles best
    penalised       (G + penalty)⁻¹ Φᵀq         the same, smooth where particles say little

Stages of a step run on nodal fields, while what they find goes to the particles. So a mass also says what its fields
`gained` from that: fields(sums + G a) = fields(sums) + gained(Φ a) for the lumped mass, and for least squares, where
gained(Φ a) = a, up to what no particle sees. With a penalty the method is defined by gained(Φ a) = a all the same.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from mpipic.arrays import FloatArray

if TYPE_CHECKING:
    from mpipic.mapping.base import NodalMapping
    from mpipic.mapping.gram_stencil import Penalty


@dataclass(frozen=True)
class Gain:
    """What particle values gain in a stage, times a factor of the equation and of time.

    Attributes
    ----------
    coefficients : (local_nodes, k), right on own and ghost nodes
        Particles gain Φ times these; or, if not `spanned`, a gradient of them (see `ParticleSweep.advance`).
    spanned : bool
        Whether the gain is Φ coefficients.
    map_to_nodes : function of coefficients, linear
        Makes Φᵀ of the gain, (local_nodes, k'), right on own and ghost nodes. Collective.
    name : str
        Tells series of solves apart.
    """

    coefficients: FloatArray
    spanned: bool
    map_to_nodes: Callable[[FloatArray], FloatArray]
    name: str

    def sums(self) -> FloatArray:
        """Return Φᵀ of the gain; the array may be overwritten. Collective."""
        return self.map_to_nodes(self.coefficients)


class Field:
    """A nodal field at the start of a step: its sums, and its values once somebody looks.

    Parameters
    ----------
    sums : (local_nodes, k), right on own and ghost nodes
    make
        Makes the values from the sums.
    """

    def __init__(self, sums: FloatArray, make: Callable[[FloatArray], FloatArray]) -> None:
        self.sums, self._make = sums, make
        self._values: FloatArray | None = None

    @property
    def values(self) -> FloatArray:
        """The field, (local_nodes, k), C-contiguous. Local or collective, as the mass is."""
        if self._values is None:
            self._values = self._make(self.sums)
        return self._values


class Mass(ABC):
    """How particle values become nodal fields."""

    @abstractmethod
    def fields(self, sums: FloatArray, name: str, quantities: Sequence[int] | None = None) -> FloatArray:
        """Return nodal fields from Φᵀq, (local_nodes, k); `name` tells series apart. Collective.

        `quantities` are the numbers of columns that make up a scalar or a vector, one after the other; by default all
        make up one.
        """

    @abstractmethod
    def start(self, sums: FloatArray, name: str, quantities: Sequence[int], work: Workspace) -> list[Field]:
        """Return one field a quantity from sums (local_nodes, k). Collective."""

    @abstractmethod
    def gained(self, gain: Gain) -> FloatArray:
        """Return what the nodal fields gain when particles gain `gain`. Collective."""

    def after(self, field: Field, scale: float, gain: Gain) -> FloatArray:
        """Return the field once particles have gained `scale` times `gain`. Collective."""
        return field.values + scale * self.gained(gain)

    def forget(self) -> None:
        """Begin every series anew. Local."""
        return

    @property
    def nbytes(self) -> int:
        """Bytes held."""
        return 0


class Workspace:
    """Nodal arrays for what a step finds on its way.

    Parameters
    ----------
    rows : int
        Nodes, own and ghosts.
    again : bool
        Hand out the same array again for every use of a name: for steps that look at nothing twice.
    """

    def __init__(self, rows: int, again: bool = False) -> None:
        self._rows = rows
        self._kept: dict[str, FloatArray] | None = {} if again else None

    def __call__(self, name: str, columns: int) -> FloatArray:
        """Return an array (rows, columns), not initialised. Local."""
        if self._kept is None:
            return np.empty((self._rows, columns))
        if name not in self._kept:
            self._kept[name] = np.empty((self._rows, columns))
        return self._kept[name]

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays that are kept."""
        return sum(array.nbytes for array in (self._kept or {}).values())


class LumpedMass(Mass):
    """S = diag(d)⁻¹ Φᵀ, weighted means."""

    def __init__(self, mapping: NodalMapping) -> None:
        self.mapping = mapping

    def fields(self, sums: FloatArray, name: str, quantities: Sequence[int] | None = None) -> FloatArray:
        """Return diag(d)⁻¹ sums. Local."""
        return self.mapping.divide(sums, np.empty(sums.shape))

    def start(self, sums: FloatArray, name: str, quantities: Sequence[int], work: Workspace) -> list[Field]:
        """Return means that are divided when somebody looks. Local."""

        def means(own: FloatArray) -> FloatArray:
            return self.mapping.divide(own, work("scalar" if own is parts[0] else "vector", own.shape[1]))

        ends = np.cumsum([0, *quantities])
        parts = [sums[:, first:end] for first, end in pairwise(ends)]
        return [Field(part, means) for part in parts]

    def gained(self, gain: Gain) -> FloatArray:
        """Return diag(d)⁻¹ of the sums of the gain. Collective on neighbours."""
        sums = gain.sums()
        return self.mapping.divide(sums, sums)

    def after(self, field: Field, scale: float, gain: Gain) -> FloatArray:
        """Return diag(d)⁻¹ (sums + scale times the sums of the gain), one pass. Collective on neighbours."""
        sums = gain.sums()
        return self.mapping.divide_changed(field.sums, scale, sums, out=sums)


class LeastSquaresMass(Mass):
    """(G + penalty)⁻¹ Φᵀ: the field that fits the particles best, and if penalised, is smooth where they say little.

    Without a penalty, G⁺ΦᵀΦ = 1 but for what no particle sees: the fields gain the coefficients themselves. With one,
    the method is defined so.
    """

    def __init__(self, mapping: NodalMapping, tolerance: float, penalty: Penalty | None = None) -> None:
        from mpipic.mapping.solver import GramSolver

        self.solver = GramSolver(mapping, tolerance, "mass_", penalty)
        self.penalised = penalty is not None

    def fields(self, sums: FloatArray, name: str, quantities: Sequence[int] | None = None) -> FloatArray:
        """Return (G + penalty)⁻¹ sums, all columns together. Collective.

        On a singular G what no particle sees is left as small as the solver leaves it that begins at zero; only a
        penalty, which leaves one solution, allows a guess from earlier steps.
        """
        return self.solver.solve(sums, name if self.penalised else None, quantities or (sums.shape[1],))

    def start(self, sums: FloatArray, name: str, quantities: Sequence[int], work: Workspace) -> list[Field]:
        """Return the fields of one solve for all quantities. Collective."""
        fields, ends = self.fields(sums, name, quantities), np.cumsum([0, *quantities])
        return [Field(np.ascontiguousarray(fields[:, first:end]), _itself) for first, end in pairwise(ends)]

    def gained(self, gain: Gain) -> FloatArray:
        """Return the coefficients, or where the gain is not spanned, a solve for its sums. Local or collective."""
        return gain.coefficients if gain.spanned else self.fields(gain.sums(), gain.name)

    def forget(self) -> None:
        """Begin every series anew. Local."""
        self.solver.forget()

    @property
    def nbytes(self) -> int:
        """Bytes of the solver."""
        return self.solver.nbytes


def _itself(fields: FloatArray) -> FloatArray:
    return fields


def penalty_of(settings: Any) -> Penalty | None:
    """Return the penalty that a record like the scene's [mapping] section asks for."""
    from mpipic.mapping.gram_stencil import Penalty

    return Penalty(settings.penalty, settings.penalty_order) if settings.mass == "penalised" else None
