"""Claims about numbers and names on the command line: what is out of range is refused before a verb starts."""

from __future__ import annotations

import csv
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, get_args, get_origin, get_type_hints

import numpy as np
import pytest
import typer
from typer.models import OptionInfo

from helpers import mpipic_here
from mpipic import memory
from mpipic.cli import app
from mpipic.command_numbers import Number
from mpipic.plots.growth_map import Scale, draw_map

NO_NUMBERS = ["", " ", "abc", "nan", "NaN", "inf", "-inf", "1e999", "0x10", "1,5", "1e", "--", "½", "[1]", "None"]


def options() -> Iterator[tuple[str, str, Number | None]]:
    """Verb, option and range of all options whose type is of numbers."""
    for command in app.registered_commands:
        for name, hint in get_type_hints(command.callback, include_extras=True).items():
            kind, info = get_args(hint) if get_origin(hint) is Annotated else (hint, None)
            if isinstance(info, OptionInfo) and re.search(r"\b(int|float)\b", str(kind)):
                option = next(iter(info.param_decls or ()), "--" + name.replace("_", "-"))
                yield command.callback.__name__, option, info.parser


def outside(number: Number) -> list[str]:
    """Texts that are no number of this range."""
    texts = list(NO_NUMBERS)
    if number.whole:
        texts += ["2.5", "1e-3", "0.999999999"]
    if np.isfinite(number.least):
        texts += ["-1", "-0.5", "-1e300", f"{number.most * 1.5 + 1:.0f}", f"{number.most + 1:.0f}", "1e300"]
        texts += ["0", "1"] if number.open else ["0"]
    return texts


def test_every_number_has_a_range_and_what_is_outside_is_refused_with_it() -> None:
    found = list(options())
    assert len(found) >= 7 and {"bench", "stability", "spectrum"} <= {verb for verb, _, _ in found}
    for verb, option, number in found:
        assert number is not None, f"{verb} {option} has no range"
        for text in outside(number):
            with pytest.raises(typer.BadParameter, match="must be"):
                number(text)
        for text in outside(number)[::7]:
            ended = mpipic_here(verb, f"{option}={text}")
            assert ended.returncode == 2 and "Traceback" not in ended.stderr, (verb, option, text, ended.stderr)
            assert f"Invalid value for '{option}'" in ended.stderr and f"must be {number.rule}" in ended.stderr


@pytest.mark.parametrize(("number", "texts"), [
    (Number(1, 3, whole=True), ["1", "3", "2.0", "3e0"]),
    (Number(0, 1, open=True), ["1e-300", "0.999"]),
    (Number(), ["-1e300", "0", "-0.3"]),
])  # fmt: skip
def test_what_is_inside_is_taken(number: Number, texts: list[str]) -> None:
    assert [number(text) for text in texts] == [float(text) for text in texts]
    assert all(isinstance(number(text), int) == number.whole for text in texts)


FLOW, CFL = "gas.flow=0:0.5:2", "time.cfl=0.1:0.2:2"
MAPS = {
    "two different keys": [[FLOW], [FLOW, FLOW], [FLOW, "gas.flow=0:0.7:3"], [FLOW, CFL, "gas.density=1:2:2"]],
    "say the same": [[CFL, "time.dt=0.001:0.002:2"]],
    "must read KEY=FROM:TO:COUNT": [
        [FLOW, f"time.cfl={span}"]
        for span in ("", ":", "0.1:0.2", "0.1:0.2:0", "0.1:0.2:-1", "0.1:0.2:2.5", "0.1:0.2:1000000000", "0.1:0.2:1e9",
                     "nan:0.2:2", "0.1:inf:2", "0.1:0.2:nan", "a:b:2", "0.1:1e999:2", "0.1:0.2:2:2")
    ] + [["gas.flow", CFL], ["", CFL], [FLOW, "=0:1:2x"]],
    "must differ": [["gas.flow=0.5:0.5:2", CFL], [FLOW, "time.cfl=0.1:0.10000000000001:3"]],
    "at most 10000 points": [["gas.flow=0:0.5:200", "time.cfl=0.1:0.2:51"]],
    "is no number of this scene": [
        [FLOW, f"{key}=1:2:2"]
        for key in ("", "foo.bar", "gas", "gas.", ".flow", "filter.kind", "filter.order", "output.every", "time.steps",
                    "particles.layout", "particles.path", "initial.wave.x", "gas.flows", "mapping.penalty")
    ],
    "takes whole numbers": [[FLOW, "grid.cells=2:4:4"], [FLOW, "particles.per_cell=1:2:3"]],
    "must be": [[FLOW, "time.cfl=0.2:-0.2:3"], [FLOW, "grid.cells=2:0:3"], [FLOW, "gas.sound_speed=1:-1:3"],
                [FLOW, "grid.length=0:1:2"]],
}  # fmt: skip
"""Rule to maps that break it."""


@pytest.mark.parametrize("rule", MAPS)
def test_a_map_that_cannot_be_is_refused_before_its_first_point(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rule: str
) -> None:
    monkeypatch.chdir(tmp_path)
    for axes in MAPS[rule]:
        ended = mpipic_here("stability", *(word for axis in axes for word in ("--map", axis)), "--filters", "local")
        assert ended.returncode == 2 and "Traceback" not in ended.stderr, (axes, ended.stderr)
        assert rule in ended.stderr and "--map" in ended.stderr, (axes, ended.stderr)
    assert not list(tmp_path.iterdir())


def test_a_point_of_a_map_that_is_refused_does_not_end_it(tmp_path: Path) -> None:
    axes = ["--map", "particles.per_cell=2:1:2", "--map", "particles.jitter=0:0.9:2"]
    scene = ["--set", "grid.cells=[4]", "--set", "particles.layout=jittered", "--set", "gas.flow=[0.25]"]
    ended = mpipic_here("stability", *scene, *axes, "--filters", "local", "--max-period", "20", "-o", tmp_path)
    assert ended.returncode == 0, ended.stderr
    with (tmp_path / "stability-map.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 4


def test_any_growth_can_be_drawn(tmp_path: Path) -> None:
    values = [np.nan, -1.0, 0.0, 1e-9, 1e-2, 1e300, np.inf]
    rng = np.random.default_rng(0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for nx, ny in ((1, 1), (3, 2)):
            x, y = (Scale("a", np.linspace(2.0, -1.0, n)) for n in (nx, ny))
            growth = {f"{i}": rng.choice(values[: i + 1], (nx, ny)) for i in range(1 if nx < 3 else len(values))}
            draw_map(tmp_path / "map.png", x, y, growth, 1e-6)


def test_nothing_grows_in_words(tmp_path: Path) -> None:
    still = ["--set", "grid.cells=[4]", "--set", "gas.flow=[0.0]", "--set", "time.cfl=0.2"]
    ended = mpipic_here("stability", *still, "-o", tmp_path)
    assert "size never, as nothing grows" in ended.stdout and "at never" not in ended.stdout


@pytest.mark.parametrize("short", [[], ["--short"]])
def test_trials_of_a_name_that_no_case_has_are_refused(short: list[str]) -> None:
    ended = mpipic_here("trials", *short, "--only", "no such case")
    assert ended.returncode == 2 and 'has "no such case" in its name' in ended.stderr


WRITING = {
    "spectrum": ["--filters", "local"], "stability": [], "filters": ["--filters", "local"], "trials": ["--short"],
    "bench": ["--dim", "1"], "stability map": ["--map", FLOW, "--map", CFL],
}  # fmt: skip


@pytest.mark.parametrize("verb", WRITING)
def test_output_that_cannot_be_written_is_refused_before_anything_is_computed(tmp_path: Path, verb: str) -> None:
    (tmp_path / "file").write_text("kept")
    files = verb in ("filters", "trials", "bench")
    places = [tmp_path / "file" / "out", *([tmp_path, tmp_path / "no" / "out"] if files else [tmp_path / "file"])]
    for place in places:
        ended = mpipic_here(verb.split()[0], *WRITING[verb], "-o", place)
        assert ended.returncode in (1, 2) and "Traceback" not in ended.stderr, (place, ended.stderr)
        assert str(place) in ended.stderr and not ended.stdout, (place, ended.stdout)
    assert (tmp_path / "file").read_text() == "kept" and len(list(tmp_path.iterdir())) == 1


def test_more_particles_than_there_is_memory_for_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available_bytes", lambda: 1e6)
    ended = mpipic_here("bench", "--particles", "1e5", "--dim", "1", "--dim", "3")
    assert ended.returncode == 2 and re.search("needs .* GB, and .* GB are free", ended.stderr), ended.stderr
