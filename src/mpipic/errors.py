"""Errors that callers tell apart, without anything that is slow to import."""


class Refused(Exception):
    """Input that cannot be used or output that cannot be written; the message says which, and why."""


class OutputError(Refused):
    """Output that cannot be written, with the path and the reason; raised on all ranks together."""


class WriteFailed(OutputError):
    """Output that the system refuses to take, as on a full disk; says which file, why, and what to do."""


class NotConverged(ArithmeticError):
    """A solver missed its tolerance; the message names what it reached, and after how many iterations."""
