"""Numbers on the command line: each option has a range, and says it where a number is none, or outside."""

from __future__ import annotations

import math
from dataclasses import dataclass

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
