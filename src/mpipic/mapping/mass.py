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
from typing import TYPE_CHECKING

import numpy as np

from mpipic.arrays import FloatArray
from mpipic.keys import ABOVE_0, IN_0_1, Keys, Positive, Share, UpTo8, key
from mpipic.mesh.basis import BASES
from mpipic.parts import GRAM_SOLVER, LEAST_SQUARES, PENALTY, Choices, Part, Values

if TYPE_CHECKING:
    from mpipic.mapping.base import NodalMapping
    from mpipic.mapping.gram_stencil import Penalty


@dataclass(frozen=True)
class Gain:
    """Particle values gain this in a stage, times a factor of the equation and of time.

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


class Mass(Part, ABC):
    """How particle values become nodal fields.

    A class takes the keys of its `Settings` as keywords after the mapping.
    """

    slot = "mapping.mass"

    def __init__(self, mapping: NodalMapping, **settings: float) -> None:
        """Take a mapping, and the keys of `Settings`."""

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

    kind = "lumped"
    about = "weighted means of the particles around a node"
    is_default = True

    @classmethod
    def describe(cls, v: Values) -> str:
        """Return the name."""
        return "lumped mass"

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

    brings_in = ("linear solvers",)
    traits = (LEAST_SQUARES,)

    @classmethod
    def solvers(cls, v: Values) -> tuple[str, ...]:
        """Return the Gram solver's options."""
        return ("mass_ksp",)

    @classmethod
    def node_doubles(cls, v: Values) -> int:
        """Return the solver, and two earlier answers for each column."""
        return gram_doubles(v) + 2 * (1 + v.dim)

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


class ConsistentMass(LeastSquaresMass):
    """G⁺ Φᵀ: the field that fits the particles best, by conjugate gradients."""

    kind = "consistent"
    about = "the field that fits the particles best (least squares)"
    traits = (GRAM_SOLVER,)

    class Settings(Keys):
        """Keys of the mass."""

        tolerance: Share = key(1e-10, IN_0_1, "relative residual of the solve")

    def __init__(self, mapping: NodalMapping, tolerance: float = 1e-10) -> None:
        super().__init__(mapping, tolerance)

    @classmethod
    def describe(cls, v: Values) -> str:
        """Return the name."""
        return "least squares"


class PenalisedMass(LeastSquaresMass):
    """(G + penalty)⁻¹ Φᵀ: the best fit that is smooth where particles say little."""

    kind = "penalised"
    about = "the best fit that is smooth where particles say little (P-splines)"
    traits = (PENALTY,)

    class Settings(Keys):
        """Keys of the mass."""

        penalty: Positive = key(0.1, ABOVE_0, "weight of the penalty")
        penalty_order: UpTo8 = key(4, "a whole number from 1 to 8", "order of the differences that it is put on")
        tolerance: Share = key(1e-10, IN_0_1, "relative residual of the solve")

    def __init__(
        self, mapping: NodalMapping, penalty: float = 0.1, penalty_order: int = 4, tolerance: float = 1e-10
    ) -> None:
        from mpipic.mapping.gram_stencil import Penalty

        super().__init__(mapping, tolerance, Penalty(penalty, penalty_order))

    @classmethod
    def describe(cls, v: Values) -> str:
        """Return the name, and the penalty."""
        penalty, order = v["mapping.penalty"], v["mapping.penalty_order"]
        return f"least squares with a penalty of {penalty:g} on differences of order {order}"

    @classmethod
    def node_doubles(cls, v: Values) -> int:
        """Return what least squares keep, and the neighbours along the axes that only the penalty couples."""
        beyond = max(0, v["mapping.penalty_order"] - BASES[v["mapping.basis"]].degree)
        return int(super().node_doubles(v) + 2 * v.dim * beyond)


MASSES: Choices[Mass] = Choices(Mass)
"""Kind to class."""


def gram_doubles(v: Values) -> int:
    """Return the numbers that a solver with the Gram matrix keeps on a node.

    They are the stencil by rows and by diagonals, and for every column that is solved for PETSc's vectors.
    """
    half = ((2 * BASES[v["mapping.basis"]].degree + 1) ** v.dim + 1) // 2
    return int(2 * half + 2 + 5 * (1 + v.dim))


def _itself(fields: FloatArray) -> FloatArray:
    return fields
