"""What each rank runs for `test_imports.py`: python modules_helpers.py FOLDER ARGUMENTS [then ARGUMENTS]...

The arguments are those of `mpipic`, called in turn up to the first exit code that is not 0. Every rank writes the names
of the modules and packages that were imported in the end to FOLDER/<rank>.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from mpipic.cli import main


def write_modules(folder: Path) -> None:
    """Full and top-level names of all imported modules."""
    rank = os.environ.get("OMPI_COMM_WORLD_RANK", os.environ.get("PMI_RANK", "0"))
    names = {name for name, module in sys.modules.items() if module is not None}
    (folder / rank).write_text("\n".join(sorted(names | {name.split(".")[0] for name in names})))


if __name__ == "__main__":
    place, words = Path(sys.argv[1]), sys.argv[2:]
    try:
        while words:
            end = words.index("then") if "then" in words else len(words)
            sys.argv, words = ["mpipic", *words[:end]], words[end + 1 :]
            try:
                main()
            except SystemExit as stop:
                if stop.code:
                    raise
    finally:
        write_modules(place)
