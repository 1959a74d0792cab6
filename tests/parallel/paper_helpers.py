"""Draws the paper on a small grid, on however many ranks: the folder is the only argument."""

import sys
from pathlib import Path

from mpipic.runtime import start

comm = start()

import mpipic  # noqa: E402
from mpipic.analysis.growth import analyse  # noqa: E402
from mpipic.console import Console  # noqa: E402
from mpipic.figures import verb  # noqa: E402
from mpipic.figures.plan import Plan, Survey  # noqa: E402

scene = mpipic.Scene.from_dict(
    {"grid": {"cells": [16]}, "gas": {"flow": [0.5]}, "filter": {"kind": "none"}, "time": {"cfl": 0.2}}
)
survey = Survey((0.5, 1.0), (2,), (0.2,), cells=4, error_cells=8, boxes=((4,),))
plan = Plan(scene, (0, 5, 20, 40), (8, 16), (100, 200), long_steps=200, survey=survey)
verb.run(plan, analyse, comm, Console(comm, quiet=True), Path(sys.argv[1]), overwrite=False)
