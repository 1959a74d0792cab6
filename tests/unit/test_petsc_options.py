"""Claims about PETSc's options: what cannot be right is refused before anything runs, what nothing reads is said."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

from helpers import environment, finish, mpipic_here, start
from mpipic.filters.measures import share_unseen
from mpipic.mapping.mapping import Mapping
from mpipic.mesh import petsc_options
from mpipic.mesh.grid import Grid
from option_helpers import failures, options, outcomes

SCENES = {
    "filter_": ["--set", "filter.kind=exact"],
    "mass_": ["--preset", "recommended"],
    "midpoint_": ["--set", "time.integrator=midpoint"],
}
"""Prefix to a scene that has a solver with it."""
BAD = {
    "ksp_type": ["gmress", "", "4", "preonly", "none", "fetidp", "python"],
    "pc_type": ["gamgg", "", "LU", "bfbt", "fieldsplit"],
    "ksp_rtol": ["abc", "", "-1", "0", "1", "nan", "inf", "1e", "true"],
    "ksp_atol": ["abc", "", "-1", "nan", "inf"],
    "ksp_divtol": ["abc", "", "-1", "0", "nan"],
    "ksp_max_it": ["-5", "0", "1e3", "x", "", "99999999999999999999"],
    "ksp_norm_type": ["none", "foo", ""],
    "ksp_convergence_test": ["skip", "foo"],
    "ksp_monitor": ["foo"],
    "ksp_converged_maxits": ["true", ""],
    "ksp_initial_guess_nonzero": ["maybe"],
    "pc_python_type": ["no.such.Class"],
}
"""Name to values that no solver can take; an empty one stands for none."""
NEEDED = {"pc_python_type": {"pc_type": "python"}}
"""Name to what it is read beside."""


def check(*arguments: str) -> tuple[int, str]:
    """The exit code of `mpipic check`, and what it says on standard error."""
    ended = mpipic_here("check", *arguments)
    assert "Traceback" not in ended.stderr
    return ended.returncode, ended.stderr


@pytest.mark.parametrize("prefix", SCENES)
def test_a_bad_value_is_refused_with_its_key_and_what_is_wrong(prefix: str) -> None:
    for name, values in BAD.items():
        for value in values:
            given = {prefix + name: value or None}
            given |= {prefix + other: word for other, word in NEEDED.get(name, {}).items()}
            shown = f'-{prefix}{name} "{value}": ' if value else f"-{prefix}{name}: "
            with options(**given), pytest.raises(petsc_options.BadOption) as refused:
                petsc_options.check({f"{prefix}ksp": PETSc.KSP}, MPI.COMM_SELF)
            said = str(refused.value)
            assert f"PETSc option {shown}" in said and petsc_options.TRIAL not in said, given
    with options(**{f"{prefix}ksp_rtol": "abc"}):
        assert check(*SCENES[prefix])[0] == 2


def test_all_that_is_wrong_is_said_at_once_with_choices_and_the_nearest() -> None:
    with options(filter_pc_type="gamgg", filter_ksp_rtol="abc", filter_ksp_type="gmres", mass_ksp_max_it="x"):
        code, said = check("--set", "filter.kind=exact", "--set", "mapping.mass=consistent")
    assert code == 2 and said.count("error: ") == 3, said
    assert "there are asm, " in said and 'Did you mean "gamg"?' in said and "no numeric value" in said


def test_a_bad_option_of_the_singular_value_decomposition_is_refused() -> None:
    bad = (("type", "lapac"), ("tol", "-3"), ("tol", "x"), ("max_it", "x"), ("nsv", "1.5"), ("ncv", None))
    for name, value in bad:
        with options(**{f"filter_svd_{name}": value}):
            code, said = check("--set", "filter.kind=svd")
        assert code == 2 and f"PETSc option -filter_svd_{name}" in said, (name, value, said)


def test_good_options_pass_without_a_word() -> None:
    good = {
        "ksp_monitor": None, "ksp_converged_reason": None, "ksp_type": "gmres", "ksp_rtol": "1e-3", "ksp_max_it": "7",
        "ksp_gmres_restart": "5", "pc_type": "gamg", "pc_gamg_threshold": "0.1", "mg_levels_ksp_type": "chebyshev",
    }  # fmt: skip
    with options(**{"filter_" + name: value for name, value in good.items()}, log_view=":/dev/null"):
        assert check(*SCENES["filter_"]) == (0, "")


UNREAD = {
    ("filter_ksp_typ", "filter_"): "filter_ksp_type",
    ("filter_ksp_rtoll", "filter_"): "filter_ksp_rtol",
    ("filter_svd_type", "filter_"): "",
    ("mass_ksp_rtol", "filter_"): "filter_ksp_rtol",
    ("filter_ksp_monitor", "mass_"): "mass_ksp_monitor",
    ("mass_pc_typ", "mass_"): "mass_pc_type",
    ("ksp_type", "midpoint_"): "midpoint_ksp_type",
    ("filtr_ksp_type", "filter_"): "filter_ksp_type",
    ("filter_pc_gamg_threshold", "filter_"): "",
}
"""(Option, prefix of the scene's solver) to what the user may have meant."""


@pytest.mark.parametrize(("name", "prefix"), UNREAD)
def test_an_option_that_no_solver_reads_is_said_with_what_is_near(name: str, prefix: str) -> None:
    with options(**{name: "1"}):
        code, said = check(*SCENES[prefix])
    assert code == 0 and said.count("warning: ") == 1, said
    assert f"PETSc option -{name}: no solver reads it; those here begin with -{prefix}" in said
    meant = UNREAD[name, prefix]
    assert not meant or f'Did you mean "-{meant}"?' in said


def test_a_scene_without_solvers_says_so() -> None:
    with options(filter_ksp_rtol="1e-3"):
        assert "there is none here" in check()[1]


def test_an_inner_solvers_misspelled_option_is_said_after_the_run(tmp_path) -> None:
    words = [*SCENES["filter_"], "--set", "time.steps=2", "--no-plots", "--quiet", "--output", tmp_path / "out"]
    with options(filter_pc_type="jacobi", filter_mg_levels_ksp_typ="cg", filter_ksp_typ="cg"):
        ended = mpipic_here("run", *words)
    assert ended.returncode == 0 and ended.stderr.count("-filter_mg_levels_ksp_typ:") == 1
    assert ended.stderr.count("-filter_ksp_typ:") == 1 and ended.stderr.count("warning: ") == 2


def test_what_a_user_says_of_the_filter_does_not_change_what_it_is_measured_by() -> None:
    grid = Grid((12,), (1.0,), MPI.COMM_SELF)
    mapping = Mapping(grid, np.random.default_rng(0).random((40, 1)))
    q = np.cos(40.0 * mapping.located[1][:, 0])
    share = share_unseen(mapping, q)
    with options(filter_ksp_rtol="0.3"):
        assert share is not None and 0.1 < share < 0.9 and share_unseen(mapping, q) == share
    with options(report_ksp_rtol="0.3"):
        assert share_unseen(mapping, q) != share


def test_every_solver_that_petsc_knows_gives_the_filter_or_is_refused() -> None:
    found = outcomes(MPI.COMM_SELF)
    assert not failures(found)
    assert {how for _, how, _ in found} == {"solved", "BadOption", "NotConverged"}


def test_options_that_petsc_does_not_begin_with_are_refused() -> None:
    variables = environment(PETSC_OPTIONS="-options_file no/file")
    ended = finish(start([sys.executable, "-m", "mpipic", "check"], env=variables))
    assert ended.returncode == 2 and "Traceback" not in ended.stderr
    assert "error: PETSc does not begin" in ended.stderr and '"-options_file no/file"' in ended.stderr


def test_options_on_the_command_line_are_told_where_they_belong() -> None:
    ended = mpipic_here("run", "-filter_pc_type", "gamg")
    assert ended.returncode == 2 and 'PETSC_OPTIONS="-' in ended.stderr
