"""What each rank runs for `test_option_ranks.py`: every solver type of PETSc, then an end with a solver half made."""

from __future__ import annotations

import sys

from mpipic.runtime import start

comm = start()

from petsc4py import PETSc  # noqa: E402

from option_helpers import failures, options, outcomes  # noqa: E402


class Preconditioner:
    """Written in Python, which PETSc calls back when it destroys it."""

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        x.copy(y)

    def destroy(self, pc: PETSc.PC) -> None:
        return


def leave_half_made() -> None:
    """End in an error of PETSc that keeps a solver alive until Python has gone."""
    ksp = PETSc.KSP().create(comm)
    ksp.getPC().setType("python")
    ksp.getPC().setPythonContext(Preconditioner())
    ring: list[object] = [ksp]
    ring.append(ring)
    with options(ksp_rtol="abc"):
        try:
            ksp.setFromOptions()
        except PETSc.Error as error:
            sys.last_value = error
            raise SystemExit(7) from None


wrong = failures(outcomes(comm))
if wrong:
    raise SystemExit("\n".join(wrong))
print(f"rank {comm.rank} tried all")
leave_half_made()
