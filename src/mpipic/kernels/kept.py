"""Where compiled loops are kept between runs: a folder of this user's, and no failure of a disk that ends a run."""

import hashlib
import os
import stat
import tempfile
import warnings
from contextlib import suppress
from pathlib import Path

from numba.core.caching import FunctionCache

PROBE = b"\0" * 65536
"""Bytes that show whether a folder takes anything: an empty file fits on a full disk."""
ADVICE = "NUMBA_CACHE_DIR names another folder"


def find_folder() -> str:
    """Return the folder of compiled loops, or nothing where there is none, with a warning.

    NUMBA_CACHE_DIR, else XDG_CACHE_HOME, else ~/.cache; where it cannot be written to, a folder for this user alone
    among the temporary ones, the same for all processes of a machine. Its name carries a digest of all loops.
    """
    sources = b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py")))
    version = Path("mpipic") / hashlib.sha256(sources).hexdigest()[:16]
    chosen = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME")
    base = Path(chosen) if chosen else Path(os.path.expanduser("~"), ".cache")
    try:
        return _usable(base / version)
    except OSError as error:
        refused = f"{base} cannot be written to ({error.strerror or error})"
    try:
        folder = _usable(_private() / version)
    except OSError as error:
        _warn(f"compiled loops are not kept: {refused}, nor can a temporary folder ({error.strerror or error})")
        return ""
    warnings.warn(f"compiled loops are kept in {folder}: {refused}; {ADVICE}", RuntimeWarning, stacklevel=3)
    return folder


def _warn(text: str) -> None:
    warnings.warn(f"{text}; every start takes longer; {ADVICE}", RuntimeWarning, stacklevel=4)


def _usable(folder: Path) -> str:
    """Return a folder that is there and takes a file; raises OSError."""
    if not folder.is_absolute() and folder.parts[0] == "~":
        raise OSError("there is no home")
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder) as file:
        file.write(PROBE)
    return str(folder)


def _private() -> Path:
    """Return this user's own folder among the temporary ones: no other user may own it, or write to it."""
    folder = Path(tempfile.gettempdir()) / f"mpipic-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise OSError(f"{folder} is open to others")
    return folder


class Kept(FunctionCache):
    """Keeps the compiled forms of one loop; what cannot be read is compiled, what cannot be written is said once."""

    lost = False

    def load_overload(self, sig, target_context):
        """Return a compiled form, or None where there is none, or a damaged one."""
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # of any kind: that is what damaged bytes make of a pickle
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig, data):
        """Keep a compiled form, unless the disk refuses."""
        try:
            super().save_overload(sig, data)
        except Exception as error:
            if not Kept.lost:
                _warn(f"compiled loops are not kept in {self.cache_path}: {getattr(error, 'strerror', error)}")
            Kept.lost = True
