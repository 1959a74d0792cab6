"""Standard output and error that never end a program: what they cannot show or take is replaced or dropped."""

from __future__ import annotations

import codecs
import io
import os
import sys
import warnings
from contextlib import suppress
from typing import TextIO

IN_WORDS = {
    "ρ": "rho", "ν": "nu", "Δ": "d", "μ": "mu", "λ": "lambda", "Φ": "Phi", "φ": "phi", "κ": "kappa", "σ": "sigma",
    "ε": "eps", "·": "*", "×": "x", "²": "2", "≤": "<=", "≥": ">=", "‖": "|", "−": "-", "–": "-", "…": "...",
    "━": "-", "─": "-", "╸": "-", "╺": "-",
}  # fmt: skip
"""Characters that this program prints to what stands for them where a terminal has only ASCII; for others, `?`."""
REPLACING = "mpipic.in_words"


def settle() -> None:
    """Make standard output and error such that printing never fails; every print of this process goes there. Local.

    A closed one is opened on nothing, lest the next file that is opened takes its number and gets what is printed.
    Streams that stand in for them, as in tests, are left alone. Warnings take one line.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
    codecs.register_error(REPLACING, in_words)
    sys.stdout, sys.stderr = _outlet(sys.stdout, 1), _outlet(sys.stderr, 2)
    warnings.formatwarning = lambda message, *_: f"warning: {message}\n"


def in_words(error: UnicodeError) -> tuple[str, int]:
    """Return what is printed in place of characters that an encoding does not have, and where to go on."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    missing = error.object[error.start : error.end]
    return "".join(IN_WORDS.get(character, "?") for character in missing), error.end


class Outlet(io.TextIOWrapper):
    """A stream that takes everything; once the system refuses something, all that follows goes nowhere."""

    def write(self, text: str) -> int:
        """Print text; returns its length."""
        try:
            super().write(text)
        except (OSError, ValueError):
            self._print_nowhere()
        return len(text)

    def flush(self) -> None:
        """Pass on what was printed."""
        try:
            super().flush()
        except (OSError, ValueError):
            self._print_nowhere()

    def _print_nowhere(self) -> None:
        """Turn the stream to nowhere, also what it holds already: it would fail once more at the end."""
        with suppress(OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self.fileno())
            os.close(nowhere)
            super().flush()


def _outlet(stream: TextIO | None, number: int) -> TextIO:
    """Return the stream in its forgiving form; one on nothing for a stream that was closed."""
    if stream is None:
        return open(os.devnull, "w", encoding="utf-8", errors=REPLACING)
    if type(stream) is not io.TextIOWrapper or stream.fileno() != number:
        return stream
    with suppress(OSError):
        stream.flush()
    own = io.BufferedWriter(io.FileIO(number, "w", closefd=False))  # whoever puts the old stream back finds it open
    return Outlet(own, stream.encoding, REPLACING, line_buffering=stream.line_buffering)
