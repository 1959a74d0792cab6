"""How much memory this process can have."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import psutil


def available_bytes() -> float:
    """Return the memory that can be had without swapping and within the limit of this process's control group."""
    limits = [float(psutil.virtual_memory().available)]
    group = Path("/sys/fs/cgroup")
    with suppress(OSError, ValueError):  # no such group, or "max"
        limits.append(float((group / "memory.max").read_text()) - float((group / "memory.current").read_text()))
    return min(limits)
