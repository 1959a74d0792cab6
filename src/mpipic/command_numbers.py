"""Numbers and paths on the command line: each option says what it takes where it is given something else."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer

from mpipic.wording import show


@dataclass(frozen=True)
class Number:
    """Reads a number of a range from the text of an option; typer calls it before a verb begins.

    Attributes
    ----------
    least, most
        The range; both ends are in it, unless it is `open`.
    whole
        Whether only whole numbers will do; 1e6 is one.
    """

    least: float = -math.inf
    most: float = math.inf
    whole: bool = False
    open: bool = False
    __name__ = "number"

    @property
    def rule(self) -> str:
        """Completes the sentence 'the value must be ...'."""
        kind = "a whole number" if self.whole else "a finite number"
        if math.isinf(self.least):
            return kind
        between, and_ = ("between", "and") if self.open else ("from", "to")
        return f"{kind} {between} {self.least:,g} {and_} {self.most:,.15g}"

    def __call__(self, text: str | float) -> float:
        """Return the number.

        Raises
        ------
        BadParameter
            It is none, or out of range.
        """
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        inside = self.least < value < self.most if self.open else self.least <= value <= self.most
        if not inside or not math.isfinite(value) or (self.whole and not value.is_integer()):
            raise typer.BadParameter(f"{show(text)}: must be {self.rule}")
        return int(value) if self.whole else value


def count(most: int) -> Number:
    """Return the reader of whole numbers from 1 to `most`."""
    return Number(1, most, whole=True)


def to_output(about: str) -> Any:
    """Return the option that names where results go, as typer takes options; `about` says what goes there."""
    return typer.Option("--output", "-o", parser=named, help=about)


def named(text: str) -> Path:
    """Return the path that an option names; the empty one, which would be the working folder, names none.

    Raises
    ------
    BadParameter
        The text is empty.
    """
    if not text.strip():
        raise typer.BadParameter("it is empty: name a folder or file, such as runs/mine, or leave the option out")
    return Path(text)
