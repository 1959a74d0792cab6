"""Claims about what rank 0 says during a run."""

from __future__ import annotations

import io
import subprocess
import sys
import time
from types import SimpleNamespace
from typing import Any

import pytest

from mpipic import console
from mpipic.console import Console

ROOT, OTHER = SimpleNamespace(rank=0), SimpleNamespace(rank=1)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


class Clock:
    """A clock that the test moves."""

    now = 1000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: Any) -> Clock:
    fake = Clock()
    monkeypatch.setattr(console.time, "monotonic", fake)
    return fake


@pytest.fixture(autouse=True)
def plain_terminal(monkeypatch: Any) -> None:
    for name in ("FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE", "NO_COLOR", "COLUMNS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "xterm")


def norms(value: float) -> SimpleNamespace:
    return SimpleNamespace(l1=value, l2=2 * value, linf=3 * value)


REPORT = SimpleNamespace(
    step=1000, time=0.5, errors={"density": norms(1e-3), "velocity": norms(2e-3)}, shares={"null_space_fraction": 0.25}
)


def say_everything(voice: Console) -> None:
    voice.banner([("scene", "paper"), ("particles", "200")])
    with voice.progress(3, "ρ") as progress:
        progress.update(3, 0.5, 1.25, 2e6)
    voice.error_table([REPORT])
    voice.phase_table({"p2g": 1.0, "g2p": 3.0}, 5.0)
    voice.message("a [bold]message[/bold] :smile: " + 200 * "x")


def test_rank_0_says_it_all_in_plain_lines() -> None:
    out = io.StringIO()
    say_everything(Console(ROOT, out=out))
    text = out.getvalue()
    assert "\x1b" not in text
    lines = [line.rstrip() for line in text.splitlines()]
    assert lines[:2] == ["scene      paper", "particles  200"]
    assert "a [bold]message[/bold] :smile: " + 200 * "x" in lines
    cells = [line.split() for line in lines]
    assert ["1000", "0.5", "density", "1.000e-03", "2.000e-03", "3.000e-03", "2.500e-01"] in cells
    assert ["velocity", "2.000e-03", "4.000e-03", "6.000e-03"] in cells


def test_phases_come_longest_first_and_their_shares_make_the_total() -> None:
    out = io.StringIO()
    Console(ROOT, out=out).phase_table({"p2g": 1.0, "g2p": 3.0}, 5.0)
    rows = [line.split() for line in out.getvalue().splitlines() if line.strip().endswith("%")]
    assert rows == [
        ["g2p", "3.000", "60.0", "%"], ["p2g", "1.000", "20.0", "%"], ["other", "1.000", "20.0", "%"],
        ["total", "5.000", "100.0", "%"],
    ]  # fmt: skip


def test_phases_of_a_run_without_time_do_not_divide_by_zero() -> None:
    out = io.StringIO()
    Console(ROOT, out=out).phase_table({"p2g": 0.0}, 0.0)
    assert "p2g" in out.getvalue()


def test_an_unknown_share_is_a_dash_and_no_reports_are_no_table() -> None:
    out = io.StringIO()
    voice = Console(ROOT, out=out)
    voice.error_table([])
    assert out.getvalue() == ""
    unknown = {"shares": {"null_space_fraction": None}, "time": float("nan")}
    voice.error_table([SimpleNamespace(**{**vars(REPORT), **unknown})])
    assert " -" in out.getvalue() and "nan" in out.getvalue()


def test_other_ranks_are_silent_and_never_import_rich(capfd: Any) -> None:
    voice = Console(OTHER)
    say_everything(voice)
    voice.warning("no")
    voice.fail("no")
    assert capfd.readouterr() == ("", "")
    code = (
        "import sys; from types import SimpleNamespace as N; from mpipic.console import Console\n"
        "c = Console(N(rank=1)); c.message('x'); c.progress(1, 'm').__enter__().update(1, 0.0, 0.0, 0.0)\n"
        "print('rich' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"


def test_quiet_keeps_warnings_and_failures_on_standard_error(capfd: Any) -> None:
    voice = Console(ROOT, quiet=True)
    say_everything(voice)
    voice.warning("slow [x]")
    voice.fail("broken")
    assert capfd.readouterr() == ("", "warning: slow [x]\nerror: broken\n")


def test_a_log_gets_a_line_every_ten_seconds_and_the_last_state(clock: Clock) -> None:
    out = io.StringIO()
    with Console(ROOT, out=out).progress(1000, "ρ") as progress:
        for step in range(1, 251):
            clock.now += 0.1
            progress.update(step, step * 1e-3, 0.5, 2e6)
    lines = out.getvalue().splitlines()
    assert [line.split()[1] for line in lines] == ["100/1000", "200/1000", "250/1000"]
    assert lines[0] == "step 100/1000  t = 0.1  max |ρ| = 5.000e-01  2e+06 particle-steps/s  1:30 left"


def test_the_last_line_is_not_said_twice_and_an_error_in_the_loop_goes_on(clock: Clock) -> None:
    out = io.StringIO()
    with pytest.raises(ZeroDivisionError), Console(ROOT, out=out).progress(10, "ρ") as progress:
        clock.now += 20.0
        progress.update(10, 1.0, float("nan"), float("inf"))
        raise ZeroDivisionError
    assert out.getvalue() == "step 10/10  t = 1  max |ρ| = nan  inf particle-steps/s  20.0 s spent\n"


def test_a_loop_without_steps_says_nothing() -> None:
    out = io.StringIO()
    with Console(ROOT, out=out).progress(0, "ρ"):
        pass
    assert out.getvalue() == ""


def test_a_terminal_gets_a_bar_redrawn_at_most_ten_times_a_second(clock: Clock) -> None:
    out = Terminal()
    with Console(ROOT, out=out).progress(1000, "ρ") as progress:
        before = len(out.getvalue())
        drawn = 0
        for step in range(1, 1001):
            clock.now += 0.002
            progress.update(step, step * 1e-3, 0.5, 2e6)
            drawn += len(out.getvalue()) > before
            before = len(out.getvalue())
    assert 15 <= drawn <= 21
    assert "\x1b[" in out.getvalue() and "1000/1000" in out.getvalue() and "5.000e-01" in out.getvalue()


@pytest.mark.parametrize("stream", [io.StringIO, Terminal])
def test_an_update_with_nothing_to_print_costs_less_than_two_microseconds(stream: Any, monkeypatch: Any) -> None:
    monkeypatch.setattr(console.ProgressLines, "interval", 1e6)
    monkeypatch.setattr(console.ProgressBar, "interval", 1e6)
    with Console(ROOT, out=stream()).progress(10**9, "ρ") as progress:
        best = float("inf")
        for _ in range(20):
            begin = time.process_time()
            for step in range(2000):
                progress.update(step, 0.1, 0.5, 1e6)
            best = min(best, (time.process_time() - begin) / 2000)
    assert best < 2e-6


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0.0, "0.0 s"),
        (59.94, "59.9 s"),
        (60.0, "1:00"),
        (245.2, "4:05"),
        (7389.0, "2:03:09"),
        (float("nan"), "?"),
        (float("inf"), "?"),
    ],
)
def test_durations_are_written_for_people(seconds: float, words: str) -> None:
    assert console.duration(seconds) == words
