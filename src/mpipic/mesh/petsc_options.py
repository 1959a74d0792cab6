"""PETSc's options for the solvers of this program: what cannot be right is refused, what nothing reads is said.

Options come from PETSC_OPTIONS, a .petscrc or a program's own `PETSc.Options()`; a solver reads those that begin with
its prefix, such as ``-filter_ksp_type``. A set of options is tried out on a small system before anything is built:
PETSc itself then says which of them it does not take, and which it does not know.
"""

from __future__ import annotations

import ctypes
import math
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Protocol

from mpi4py import MPI
from petsc4py import PETSc

from mpipic.errors import NotConverged, Refused
from mpipic.wording import closest, listed, show

PREFIXES = ("filter_", "mass_", "midpoint_", "stability_", "report_")
MATRIX_FREE = ("midpoint_", "stability_")
"""Prefixes of solvers that never see the entries of their matrix."""
UNKNOWN_TYPE = 86
"""PETSc's number for the name of a type that there is not."""
TRIAL = "mpipic_trial_"
SOLVER_OPTION = re.compile(rf"(?:{'|'.join(PREFIXES)})|(?:.*_)?(?:ksp|pc|svd|eps)_")
SPLIT = re.compile(rf"({'|'.join(PREFIXES)})?(.*?_)??((?:ksp|pc|svd|eps)_.*)$")
"""Matches prefix of a solver, of one inside it, and the name."""
AT_ONCE = re.compile(r"(?:ksp|pc|svd|eps)_(?!view|converged|error|test)")
"""Matches options that are read when a solver is set up; others as it solves, or by a solver that it makes inside."""
KNOWN = """
ksp_type ksp_rtol ksp_atol ksp_divtol ksp_max_it ksp_norm_type ksp_monitor ksp_monitor_true_residual ksp_view
ksp_converged_reason ksp_pc_side ksp_gmres_restart pc_type pc_view pc_factor_levels pc_factor_mat_solver_type
pc_gamg_type pc_gamg_threshold pc_hypre_type pc_mg_levels pc_mg_cycle_type pc_asm_overlap pc_bjacobi_blocks
pc_sor_omega pc_sor_its pc_python_type
svd_type svd_tol svd_max_it svd_nsv svd_ncv svd_mpd svd_monitor svd_view svd_converged_reason
eps_type eps_tol eps_max_it eps_nev eps_ncv eps_mpd eps_monitor eps_view eps_converged_reason
"""
"""Names that a misspelled one is compared with."""
NATURAL = ("cg", "cgne", "cgs", "cr", "fcg", "gltr", "groppcg", "pipecg", "nash", "stcg")
"""Krylov methods that know the natural norm, (r, B r)^½."""
UNCHECKED = {
    "ksp_norm_type": ("none",),
    "ksp_convergence_test": ("skip",),
    "ksp_converged_maxits": (None, "1", "true", "yes", "on"),
}
"""Options with which a solver would never look at its tolerance."""

_said: set[str] = set()
_here: list[str] = []
"""How the options of the solvers of the scene at hand begin, such as filter_ksp."""


class BadOption(Refused):
    """PETSc options that a solver cannot work with; the message has a line for each. Raised on all ranks together."""


class Destroyable(Protocol):
    """An object of PETSc."""

    def destroy(self) -> object:
        """Give it back. Collective."""
        ...


class Solver(Destroyable, Protocol):
    """A KSP of PETSc, an SVD or EPS of SLEPc."""

    def getOptionsPrefix(self) -> str | None:
        """Return how its options begin."""
        ...

    def getComm(self) -> Any:
        """Return its communicator."""
        ...

    def setFromOptions(self) -> object:
        """Take its options. Collective."""
        ...


Solvers = Mapping[str, type[Solver]]
"""How options begin, prefix and class, such as filter_ksp, to the class that reads them."""


# ---------------------------------------------------------------- for solvers


def configure(solver: Solver, *others: Destroyable) -> None:
    """Let a KSP, SVD or EPS take the options of its prefix. Collective.

    Raises
    ------
    BadOption
        Then `solver`, and `others` that only it needs, are destroyed: nothing half made is left to PETSc's end.
    """
    prefix = solver.getOptionsPrefix() or ""
    try:
        if given(prefix):
            bad, _ = _examine(prefix, type(solver), solver.getComm())
            if bad:
                raise BadOption("\n".join(bad))
        with refusing(prefix):
            _take_options(solver)
    except BaseException:
        for item in (solver, *others):
            item.destroy()
        raise


def solve(ksp: PETSc.KSP, b: PETSc.Vec, x: PETSc.Vec) -> None:
    """Solve A x = b, x holding the first guess if the KSP takes one. Collective.

    Some methods and preconditioners that a user can ask for call anything an answer: under options, the residual is
    computed afterwards, and must not be far above the tolerance, in whatever norm that is.

    Raises
    ------
    BadOption
        PETSc does not solve with the options given.
    NotConverged
        It says that it has solved, and has not.
    """
    prefix = ksp.getOptionsPrefix() or ""
    with refusing(prefix):
        ksp.solve(b, x)
    options = given(prefix)
    if options and ksp.getConvergedReason() > 0:
        rest = b.duplicate()
        ksp.getOperators()[0].mult(x, rest)
        rest.axpy(-1.0, b)
        left, size = rest.norm(), b.norm()
        rest.destroy()
        if not left <= math.sqrt(ksp.getTolerances()[0]) * size:
            words = ", ".join(_named(prefix + name, value) for name, value in options.items())
            raise NotConverged(f"PETSc says that it has solved with {words}, but the residual is {left / size:.2g}")


@contextmanager
def refusing(prefix: str) -> Iterator[None]:
    """Turn what PETSc does not do because of options with this prefix into BadOption; other errors stay as they are."""
    try:
        yield
    except PETSc.Error as error:
        options = given(prefix)
        if not options:
            raise
        words = ", ".join(_named(prefix + name, value) for name, value in options.items())
        raise BadOption(f"PETSc cannot solve with {words}: {_reason(error)}") from None


def given(prefix: str) -> dict[str, str | None]:
    """Return the options with this prefix: the rest of the name to the value, None for one without. Local."""
    options: dict[str, str | None] = PETSc.Options().getAll()  # with a prefix, it takes other options for values
    return {name.removeprefix(prefix): value for name, value in options.items() if name.startswith(prefix)}


# ---------------------------------------------------------------- for verbs


def check(solvers: Solvers, comm: MPI.Comm) -> list[str]:
    """Return which options none of these solvers, all that there will be, reads, in words. Collective.

    Raises
    ------
    BadOption
        With every value that one of them cannot take.
    """
    problems, unread = [], {name for name in given("") if SOLVER_OPTION.match(name)}
    for begin, cls in solvers.items():
        prefix = begin.removesuffix(_kind(cls))
        options = given(prefix)
        if options:
            bad, read = _examine(prefix, cls, comm)
            problems += bad
            unread -= {prefix + name for name in options if name in read or not AT_ONCE.match(name)}
    if problems:
        raise BadOption("\n".join(problems))
    _said.clear()
    _here[:] = solvers
    return [_say_unread(name) for name in sorted(unread)]


def left_over() -> list[str]:
    """Return which options of solvers nothing has read until now, in words, but those that were said before. Local."""
    options = (name for name in given("") if SOLVER_OPTION.match(name) and name not in _said)
    return [_say_unread(name) for name in sorted(options) if not was_read(name)]


def was_read(name: str) -> bool:
    """Return whether anything has asked for this option; True where PETSc does not tell. Local."""
    read = ctypes.c_int(0)
    try:
        ctypes.CDLL(PETSc.__file__).PetscOptionsUsed(None, name.encode(), ctypes.byref(read))
    except (OSError, AttributeError):
        return True
    return bool(read.value)


def _say_unread(name: str) -> str:
    """Return that nothing reads an option, and what is near it: the same of another solver, or a name like it."""
    _said.add(name)
    prefixes = sorted({begin[:-3] for begin in _here})
    here = f"those here begin with {listed(f'-{other}' for other in prefixes)}" if prefixes else "there is none here"
    found, hint = SPLIT.match(name), ""
    if found and prefixes:
        first, inner, own = found.groups("")
        known = [word for word in KNOWN.split() if any(word.startswith((begin[-3:], "pc_")) for begin in _here)]
        near = closest(own, known) or own
        begin = first + inner if first in prefixes else closest(first or inner, prefixes) or prefixes[0]
        hint = f'. Did you mean "-{begin}{near}"?' if begin + near != name else ""
    return f"PETSc option -{name}: no solver reads it; {here}{hint}"


# ---------------------------------------------------------------- trying out


def _examine(prefix: str, cls: type[Solver], comm: Any) -> tuple[list[str], set[str]]:
    """Return what is wrong with the options of a prefix, a line each, and the names of those that are read.

    They are tried one after the other, each beside those that were right; first those that others depend on.
    """
    problems, good = [], dict[str, str | None]()
    options = sorted(given(prefix).items(), key=lambda item: (item[0] != "pc_type", item[0] != "ksp_type", item[0]))
    for name, value in options:
        wrong = _wrong(prefix, cls, comm, {**good, name: value}, name)
        if wrong is None:
            good[name] = value
        else:
            problems.append(f"PETSc option {_named(prefix + name, value)}: {wrong}")
    read = set[str]()
    _attempt(prefix, cls, comm, good, read)
    return problems, read


def _wrong(prefix: str, cls: type[Solver], comm: Any, options: dict[str, str | None], name: str) -> str | None:
    """Return what is wrong with the option `name` beside the others, or None."""
    value = options[name]
    if value in UNCHECKED.get(name, ()):
        return "the solver would never look at its tolerance"
    if value is None:
        # a switch takes a truth value, a viewer the name of one; numbers and types take neither
        words = ("true", "ascii")
        if all(_attempt(prefix, cls, comm, {**options, name: word}) for word in words):
            return "needs a value"
    return _attempt(prefix, cls, comm, options)


def _attempt(
    prefix: str, cls: type[Solver], comm: Any, options: Mapping[str, str | None], read: set[str] | None = None
) -> str | None:
    """Return why a small solver does not take these options, None if it does; add to `read` which it asked for."""
    database, made = PETSc.Options(TRIAL), []
    for name, value in options.items():
        database.setValue(name, value)
    try:
        matrix = _small_matrix(comm, prefix in MATRIX_FREE)
        made.append(matrix)
        solver = _small_solver(cls, matrix)
        made.append(solver)
        _take_options(solver)
        if cls is PETSc.KSP:
            solver.setUp()
            return _limit_passed(solver)
    except PETSc.Error as error:
        name, value = list(options.items())[-1]
        if error.ierr == UNKNOWN_TYPE and name.endswith("_type"):
            return _choices(cls, name, value)
        return _reason(error).replace(TRIAL, prefix)
    except Exception as error:  # of a class that pc_python_type names
        return f"{type(error).__name__}: {error}"
    finally:
        for item in reversed(made):
            item.destroy()
        for name in options:
            if read is not None and was_read(TRIAL + name):
                read.add(name)
            database.delValue(name)
    return None


def _small_solver(cls: Any, matrix: PETSc.Mat) -> Any:
    solver = cls().create(matrix.getComm())
    solver.setOptionsPrefix(TRIAL)
    if cls is PETSc.KSP:
        solver.setType(PETSc.KSP.Type.CG)
        solver.setNormType(PETSc.KSP.NormType.NATURAL)
        solver.getPC().setType(PETSc.PC.Type.PYTHON)
        solver.getPC().setPythonContext(_Identity())
    solver.setOperators(matrix)
    return solver


class _Identity:
    """Stands for a matrix or a preconditioner that changes nothing."""

    def mult(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = x, as PETSc calls it."""
        x.copy(y)

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = x, as PETSc calls it."""
        x.copy(y)


def _small_matrix(comm: Any, matrix_free: bool) -> PETSc.Mat:
    """Return a symmetric, positive definite matrix with four rows a rank. Collective."""
    sizes = ((4, None), (4, None))
    if matrix_free:
        return PETSc.Mat().createPython(sizes, _Identity(), comm=comm)
    matrix = PETSc.Mat().createAIJ(sizes, nnz=3, comm=comm)
    rows = matrix.getSize()[0]
    for row in range(*matrix.getOwnershipRange()):
        for column in range(max(0, row - 1), min(rows, row + 2)):
            matrix.setValue(row, column, 4.0 if row == column else -1.0)
    matrix.assemble()
    return matrix


def _take_options(solver: Any) -> None:
    if isinstance(solver, PETSc.KSP):
        kind = given(solver.getOptionsPrefix()).get("ksp_type") or solver.getType()
        if solver.getNormType() == PETSc.KSP.NormType.NATURAL and kind not in NATURAL:
            solver.setNormType(PETSc.KSP.NormType.DEFAULT)
    solver.setFromOptions()


def _limit_passed(ksp: PETSc.KSP) -> str | None:
    """Return which number, or combination, PETSc takes though nothing can come of it; None if all are good."""
    rtol, atol, divtol, most = ksp.getTolerances()
    if not 0.0 < rtol < 1.0:
        return "the relative tolerance must be a number between 0 and 1"
    if not (atol >= 0.0 and math.isfinite(atol)):
        return "the absolute tolerance must be a finite number, 0 or above"
    if not divtol > 1.0:
        return "the divergence tolerance must be a number above 1"
    if not most >= 1:
        return "the number of iterations must be 1 or above"
    if ksp.getType() in ("preonly", "none"):
        return "it looks at no tolerance; with pc_type lu or cholesky the default method does, and takes one iteration"
    return None


# ---------------------------------------------------------------- words


def _named(name: str, value: str | None) -> str:
    return f"-{name}" if value is None else f"-{name} {show(value)}"


def _reason(error: PETSc.Error) -> str:
    """Return PETSc's own words for an error, without the trace of its functions."""
    lines = [re.sub(r"^\[\d+\] ?", "", line) for line in str(error).splitlines()]
    words = [line.strip() for line in lines if line.strip() and "() at " not in line and "error code" not in line]
    return "; ".join(words[1:] or words) or str(error)  # the first says of what kind the error is


def _choices(cls: Any, name: str, value: str | None) -> str:
    """Return that there is no such type, what there is, and the nearest."""
    classes = {f"{_kind(cls)}_type": cls.Type, "pc_type": PETSc.PC.Type}
    if name not in classes:
        return "PETSc knows none of this name"
    names = sorted({str(kind) for key, kind in vars(classes[name]).items() if key.isupper()})
    near = closest(value, names)
    hint = f'. Did you mean "{near}"?' if near and near != value else ""
    return f"this PETSc has none of this name; there are {', '.join(names)}{hint}"


def _kind(cls: type[Solver]) -> str:
    """Return ksp, svd or eps."""
    return cls.__name__.lower()
