"""Where the time of a run goes: one clock that is always in exactly one phase."""

from __future__ import annotations

from time import perf_counter


class Phases:
    """Seconds per named phase. Calling it with a name ends the phase before. Local; under a microsecond a call."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._name, self._since = "other", perf_counter()

    def __call__(self, name: str) -> None:
        """End the present phase and begin this one."""
        now = perf_counter()
        self.seconds[self._name] = self.seconds.get(self._name, 0.0) + now - self._since
        self._name, self._since = name, now

    def total(self, *names: str) -> float:
        """Seconds of these phases together, up to the last call."""
        return sum(self.seconds.get(name, 0.0) for name in names)
