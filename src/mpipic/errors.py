"""Errors that callers tell apart, without anything that is slow to import."""


class NotConverged(ArithmeticError):
    """A solver missed its tolerance; the message names what it reached, and after how many iterations."""
