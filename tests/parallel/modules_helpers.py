"""What each rank runs for `test_imports.py`: python modules_helpers.py FOLDER ARGUMENTS of `mpipic`.

Every rank writes the names of the modules and packages that were imported in the end to FOLDER/<rank>.
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
    place = Path(sys.argv.pop(1))
    try:
        main()
    finally:
        write_modules(place)
