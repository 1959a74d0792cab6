"""A run speaks while it runs: rank 0 speaks, every other rank stays silent and never imports rich.

On a terminal, colours and a live bar; anywhere else, plain lines that a log can keep.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Mapping, Sequence
from types import TracebackType
from typing import IO, TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from rich.console import Console as RichConsole

TERMINAL_SECONDS = 0.1
LOG_SECONDS = 10.0
LOG_WIDTH = 120


class Rank(Protocol):
    """Which process of how many speaks: an mpi4py communicator, or what stands for one."""

    @property
    def rank(self) -> int:
        """Number of this process."""
        ...


class ErrorNorms(Protocol):
    """Three norms of an error."""

    @property
    def l1(self) -> float:
        """Mean of |e|."""
        ...

    @property
    def l2(self) -> float:
        """Root mean square of e."""
        ...

    @property
    def linf(self) -> float:
        """Largest |e|."""
        ...


class Measured(Protocol):
    """Errors at one step, by name of the field, and shares of what no node sees, None where unknown."""

    @property
    def step(self) -> int:
        """Number of the step."""
        ...

    @property
    def time(self) -> float:
        """Time reached."""
        ...

    @property
    def errors(self) -> Mapping[str, ErrorNorms]:
        """Name of a field to norms of its error."""
        ...

    @property
    def shares(self) -> Mapping[str, float | None]:
        """Name of a share to number."""
        ...


class Progress:
    """Progress of the time loop where nothing is shown; `Console.progress` returns this or a kind that shows."""

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None

    def update(self, step: int, time: float, peak: float, particle_steps_per_second: float) -> None:
        """Show time, the watched field's peak and particles times steps per second after `step`; call it every step."""


class ProgressLines(Progress):
    """Plain lines: every `LOG_SECONDS`, and at the end the last state."""

    interval = LOG_SECONDS

    def __init__(self, total_steps: int, watched: str, out: RichConsole) -> None:
        self.total, self.watched = total_steps, watched
        self.out = out
        self._begin = time.monotonic()
        self._next = self._begin + self.interval
        self._state: tuple[int, float, float, float] = (0, 0.0, float("nan"), float("nan"))
        self._shown = -1

    def update(self, step: int, time: float, peak: float, particle_steps_per_second: float) -> None:
        """Keep the state, and print it when its time has come."""
        self._state = (step, time, peak, particle_steps_per_second)
        if _now() >= self._next:
            self._show()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._state[0] != self._shown and self._state[0] > 0:
            self._show()

    def _show(self) -> None:
        self._next = _now() + self.interval
        self._shown = self._state[0]
        self._draw()

    def _draw(self) -> None:
        _print(self.out, f"step {self._state[0]}/{self.total}  {self._numbers()}  {self._left()}")

    def _numbers(self) -> str:
        _, at, peak, rate = self._state
        return f"t = {at:.6g}  max |{self.watched}| = {peak:.3e}  {rate:.3g} particle-steps/s"

    def _left(self) -> str:
        step, spent = self._state[0], _now() - self._begin
        if step >= self.total or step <= 0:
            return f"{duration(spent)} spent"
        return f"{duration(spent / step * (self.total - step))} left"


class ProgressBar(ProgressLines):
    """A live bar on a terminal, redrawn at most every `TERMINAL_SECONDS` and by no other thread."""

    interval = TERMINAL_SECONDS

    def __enter__(self) -> Progress:
        from rich.progress import BarColumn, TextColumn
        from rich.progress import Progress as Live

        forms = ("{task.completed}/{task.total}", "{task.description}")
        count, numbers = (TextColumn(form, markup=False) for form in forms)
        self._live = Live(count, BarColumn(bar_width=10), numbers, console=self.out, auto_refresh=False)
        self._live.start()
        self._task = self._live.add_task("", total=self.total)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        super().__exit__(kind, error, trace)
        self._live.stop()

    def _draw(self) -> None:
        description = f"{self._left()}  {self._numbers()}"  # a narrow terminal cuts the end
        self._live.update(self._task, completed=self._state[0], description=description, refresh=True)


class Console:
    """The voice of a run.

    Parameters
    ----------
    comm : only its rank 0 prints
    quiet : print warnings and failures only
    out, err : where to print, standard output and standard error by default

    Notes
    -----
    Every method is local, does nothing on ranks other than 0, and takes text as it is, without markup.
    """

    def __init__(self, comm: Rank, quiet: bool = False, out: IO[str] | None = None, err: IO[str] | None = None) -> None:
        self._out: RichConsole | None = None
        self._err: RichConsole | None = None
        self._quiet = quiet
        if comm.rank == 0:
            self._out, self._err = _rich_console(out, stderr=False), _rich_console(err, stderr=True)

    @property
    def _loud(self) -> RichConsole | None:
        """Where what is not urgent goes; None for nowhere."""
        return None if self._quiet else self._out

    def banner(self, lines: Sequence[tuple[str, str]]) -> None:
        """Print what is about to run: one line for each (name, value), values in one column."""
        if self._loud:
            width = max((len(name) for name, _ in lines), default=0)
            for name, value in lines:
                _print(self._loud, f"{name:<{width}}  {value}")

    def progress(self, total_steps: int, watched: str) -> Progress:
        """Return a context whose `update` is called every step; costs less than 2 µs when nothing is printed.

        watched : symbol of the field whose peak is shown
        """
        if not self._loud:
            return Progress()
        return (ProgressBar if self._loud.is_terminal else ProgressLines)(total_steps, watched, self._loud)

    def error_table(self, reports: Iterable[Measured]) -> None:
        """Print error reports: a line a field, with l1, l2 and linf; a share that is None prints as a dash."""
        rows: list[tuple[str, ...]] = []
        for report in reports:
            shares = [_number(share) for share in report.shares.values()] or ["-"]
            first = (str(report.step), f"{report.time:.6g}")
            last = ", ".join(shares)
            for name, norms in report.errors.items():
                rows.append((*first, name, *_norms(norms), last))
                first, last = ("", ""), ""
        if rows:
            self.table("errors", ("step", "time", "of", "l1", "l2", "linf", "null-space share"), rows)

    def phase_table(self, seconds: Mapping[str, float], total: float) -> None:
        """Print the seconds of each phase, longest first, their share of `total`, and what no phase accounts for."""
        phases = sorted(seconds.items(), key=lambda item: -item[1])
        rest = total - sum(seconds.values())
        phases += [("other", rest)] if rest > 0.0005 * total else []
        rows = [(name, f"{spent:.3f}", _share(spent, total)) for name, spent in [*phases, ("total", total)]]
        self.table("time", ("phase", "seconds", "share"), rows)

    def message(self, text: str) -> None:
        """Print a line."""
        if self._loud:
            _print(self._loud, text)

    def warning(self, text: str) -> None:
        """Print a warning to standard error, also when quiet."""
        if self._err is not None:
            _print(self._err, f"warning: {text}", "yellow")

    def fail(self, text: str) -> None:
        """Print an error to standard error, also when quiet."""
        if self._err is not None:
            _print(self._err, f"error: {text}", "bold red")

    def table(self, title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Print a table of text cells; numbers to the right, words to the left."""
        if not self._loud:
            return
        from rich.box import SIMPLE_HEAD
        from rich.table import Table
        from rich.text import Text

        table = Table(title=Text(title, "table.title"), box=SIMPLE_HEAD, title_justify="left", pad_edge=False)
        words = {"of", "phase", "phases", "filter", "scheme", "resolution"}
        for name in header:
            table.add_column(Text(name), justify="left" if name in words else "right", no_wrap=True)
        for row in rows:
            table.add_row(*(Text(cell) for cell in row))
        self._loud.print(table)
        self._loud.file.flush()


def duration(seconds: float) -> str:
    """Return a time span in words: 3.2 s, 4:05, 2:03:09."""
    if not 0.0 <= seconds < 1e9:
        return "?"
    if seconds < 60.0:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def _launcher_writes_elsewhere(stderr: bool) -> bool:
    """Return whether a launcher stands between this process and the user, and its own output is no terminal.

    Open MPI gives rank 0 a pseudo terminal whatever its own output is; what counts is where the launcher writes.
    """
    if "OMPI_COMM_WORLD_SIZE" not in os.environ:
        return False
    try:
        target = os.readlink(f"/proc/{os.getppid()}/fd/{2 if stderr else 1}")
    except OSError:
        return True
    return not target.startswith(("/dev/pts/", "/dev/tty"))


def _rich_console(file: IO[str] | None, stderr: bool) -> RichConsole:
    from rich.console import Console

    console = Console(file=file, stderr=stderr, highlight=False)
    if not console.is_terminal or (file is None and _launcher_writes_elsewhere(stderr)):
        console = Console(
            file=file, stderr=stderr, highlight=False, width=LOG_WIDTH, color_system=None, force_terminal=False
        )
    return console


def _print(console: RichConsole, text: str, style: str | None = None) -> None:
    """Print text as it is; long lines are left to the terminal."""
    console.print(text, markup=False, highlight=False, soft_wrap=True, emoji=False, style=style)
    console.file.flush()


def _now() -> float:
    return time.monotonic()


def _norms(norms: ErrorNorms) -> tuple[str, str, str]:
    return _number(norms.l1), _number(norms.l2), _number(norms.linf)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3e}"


def _share(spent: float, total: float) -> str:
    return f"{100.0 * spent / total:.1f} %" if total > 0.0 else "-"
