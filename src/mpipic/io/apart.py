"""Run a generator in a process of its own, so that what crashes or hangs there is an error here.

Damaged HDF5 files can end the process that reads them by a signal, or keep it for ever: of a hundred thousand files
with flipped bytes some forty did. The process starts in a quarter of a second, tells what it finds as it goes, and is
ended when it is silent for longer than any piece takes to read.
"""

from __future__ import annotations

import os
import pickle
import select
import signal
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import IO, Any

from mpipic.runtime import without_launcher_variables

PATIENCE = 20.0
"""Seconds of silence after which a process is taken for one that hangs."""
START = 60.0
"""Seconds that a process may take to import what it needs."""
LENGTH = struct.Struct("<Q")

Task = Callable[..., Iterator[Any]]
"""A generator function at the top of a module, which both processes can import."""


@contextmanager
def _unsignalled() -> Iterator[None]:
    """Let a pipe that nobody reads be an error only: PETSc ends a program that is told of it by a signal. Local."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGPIPE})
    try:
        yield
    finally:
        signal.sigtimedwait({signal.SIGPIPE}, 0)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class Died(RuntimeError):
    """The process of its own ended or hung in the middle of its work; the message says how."""


class Apart:
    """A process of its own for any number of tasks, one after the other; started when needed, and anew if it died.

    Where none can be started, tasks run here.
    """

    def __init__(self, patience: float = PATIENCE) -> None:
        self.patience = patience
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Apart:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """End the process. Local."""
        if self._process is not None:
            self._process.kill()
            for stream in (self._process.stdin, self._process.stdout):
                if stream:
                    with suppress(BrokenPipeError), _unsignalled():  # what was still to be sent, and to whom, has gone
                        stream.close()
            self._process.wait()
            self._process = None

    def run(self, task: Task, *arguments: object) -> Iterator[Any]:
        """Yield what `task(*arguments)` yields there; raise here what it raises there.

        Raises
        ------
        Died
            The process ended by a signal, or was silent for `patience` seconds and has been ended.
        """
        if self._process is None and not self._start():
            yield from task(*arguments)
            return
        assert self._process is not None and self._process.stdin is not None
        finished = False
        try:
            self._send(self._process.stdin, (task, arguments))
            while True:
                kind, value = self._receive(self.patience)
                if kind == "end":
                    finished = True
                    return
                if kind == "error":
                    finished = True
                    raise value
                yield value
        finally:
            if not finished:
                self.close()

    def _start(self) -> bool:
        """Start a process and wait until it is ready; return whether there is one."""
        variables = without_launcher_variables(os.environ)
        variables["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "mpipic.io.apart"], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL, env=variables,
            )  # fmt: skip
            self._receive(START)
        except (OSError, ValueError, Died):
            self.close()
            return False
        return True

    def _send(self, stream: IO[bytes], message: object) -> None:
        try:
            with _unsignalled():
                write(stream, message)
        except BrokenPipeError:
            raise Died(self._ending()) from None

    def _receive(self, seconds: float) -> tuple[str, Any]:
        (length,) = LENGTH.unpack(self._bytes(LENGTH.size, seconds))
        message: tuple[str, Any] = pickle.loads(self._bytes(length, seconds))
        return message

    def _bytes(self, count: int, seconds: float) -> bytearray:
        """Return so many bytes that the process wrote."""
        assert self._process is not None and self._process.stdout is not None
        source, received, at = self._process.stdout.fileno(), bytearray(count), 0
        view, poll = memoryview(received), select.poll()
        poll.register(source, select.POLLIN | select.POLLHUP)
        while at < count:
            if not poll.poll(1000 * seconds):
                raise Died(f"no answer for {seconds:g} s")
            got = os.readv(source, [view[at:]])
            if not got:
                raise Died(self._ending())
            at += got
        return received

    def _ending(self) -> str:
        """Return how the process ended."""
        assert self._process is not None
        code = self._process.wait()
        try:
            return f"ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        except ValueError:
            return f"ended by signal {-code}"


def write(stream: IO[bytes], message: object) -> None:
    """Write a message with its length before it."""
    text = pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL)
    stream.write(LENGTH.pack(len(text)))
    stream.write(text)
    stream.flush()


def serve() -> None:
    """Do the tasks that come in on standard input, until there are no more."""
    import mpipic.io.particle_file  # noqa: F401  what most tasks are of, imported before their time is measured

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's Ctrl-C is for the process that waits for this one
    out = os.fdopen(os.dup(1), "wb")
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)  # what libraries print is no message
    write(out, ("ready", None))
    while head := sys.stdin.buffer.read(LENGTH.size):
        task, arguments = pickle.loads(sys.stdin.buffer.read(LENGTH.unpack(head)[0]))
        try:
            for value in task(*arguments):
                write(out, ("value", value))
            write(out, ("end", None))
        except Exception as error:  # whatever it is, it belongs to whoever asked
            write(out, ("error", error))


if __name__ == "__main__":
    serve()
