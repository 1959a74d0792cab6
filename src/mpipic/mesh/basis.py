"""The bases of the grid: B-splines centred on nodes. Their values and slopes are in `kernels.spline`."""

from __future__ import annotations

from typing import ClassVar

from mpipic.parts import Choices, Part, Values


class Basis(Part):
    """A B-spline basis.

    Attributes
    ----------
    degree
        Polynomial degree.
    reach
        Nodes below and above the lower node of its cell that a particle touches at most.
    """

    slot = "mapping.basis"
    degree: ClassVar[int]
    reach: ClassVar[tuple[int, int]]

    @classmethod
    def describe(cls, v: Values) -> str:
        """Return the name."""
        return f"{cls.kind} basis"


class Linear(Basis):
    """Hats: the basis of the paper."""

    kind = "linear"
    about = "hats, B-splines of degree 1"
    is_default = True
    degree, reach = 1, (0, 1)

    @classmethod
    def node_doubles(cls, v: Values) -> int:
        """Return the moments of the particles, which pairs of neighbouring nodes share."""
        return int(3**v.dim)


class Quadratic(Basis):
    """B-splines of degree 2."""

    kind = "quadratic"
    about = "B-splines of degree 2"
    degree, reach = 2, (1, 2)


class Cubic(Basis):
    """B-splines of degree 3."""

    kind = "cubic"
    about = "B-splines of degree 3"
    degree, reach = 3, (1, 2)


BASES: Choices[Basis] = Choices(Basis)
"""Kind to class."""
