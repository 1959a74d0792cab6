"""What a step takes away on purpose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mpipic.mesh.differences import LowPass


@dataclass(frozen=True)
class Damping:
    """What a step takes away on purpose.

    Attributes
    ----------
    low_pass
        Takes grid-scale waves from the nodal fields: particles get Φ times what is taken from these.
    null_space
        The share of q - Φ a that particle values q lose, a their least-squares field: of what no node sees, and with a
        penalty, of what is rough. Where the grid moves past the particles such noise turns into sound and back, and can
        grow however well waves are damped; this makes the step without gradients a contraction, which it need not be
        otherwise.
    """

    low_pass: LowPass | None = None
    null_space: float = 0.0

    @property
    def acts(self) -> bool:
        """Whether it takes anything."""
        return self.low_pass is not None or self.null_space != 0.0

    @property
    def nbytes(self) -> int:
        """Bytes held."""
        return self.low_pass.nbytes if self.low_pass else 0
