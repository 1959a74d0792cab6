"""Claims about a process among the ranks: what is ours in what they say."""

from __future__ import annotations

import pytest

from mpipic.runtime import without_launcher

RULE = "-" * 74 + "\n"


@pytest.mark.parametrize(
    "foreign",
    [
        "[hwloc/linux] failed to find sysfs cpu topology directory, aborting linux discovery.\n",
        "hwloc/linux: failed to find sysfs cpu topology directory, aborting linux discovery.\n",
        f"{'*' * 76}\n* hwloc 2.9.0 received invalid information from the operating system.\n*\n{'*' * 76}\n",
        f"{RULE}MPI_ABORT was invoked on rank 1\nwith errorcode 1.\n\nNOTE: that ends all.\n{RULE}",
        f"{RULE}Primary job  terminated normally, but\n{RULE}{RULE}mpiexec detected\n\n  Exit code:    2\n{RULE}",
        "[vm:10400] 1 more process has sent help message help-mpi-api.txt / mpi-abort\n",
        "application called MPI_Abort(MPI_COMM_WORLD, 1) - process 1\n",
        f"{'=' * 83}\n=   BAD TERMINATION OF ONE OF YOUR APPLICATION PROCESSES\n{'=' * 83}\n",
        "[proxy:0:0@vm] HYD_pmcd_pmip_control_cmd_cb (proxy/pmip_cb.c:480): assert (!closed) failed\n",
    ],
)
def test_what_launcher_and_hwloc_say_is_left_out_and_nothing_else(foreign: str) -> None:
    ours = 'warning: CFL 3 is above 2.8\n  File "x.py", line 1\nValueError: [1] -----\n'
    assert without_launcher(foreign + ours) == without_launcher(ours + foreign) == ours
    assert without_launcher(ours.replace("\n", "\n" + foreign)) == ours


def test_a_rule_without_its_second_hides_nothing() -> None:
    assert without_launcher(f"{RULE}ValueError: oh\n").endswith("ValueError: oh\n")


def test_the_trace_of_a_crash_is_kept() -> None:
    trace = "[vm:10400] *** Process received signal ***\n[vm:10400] Signal: Segmentation fault (11)\n"
    assert without_launcher(trace) == trace
