"""Claims about what a study concludes: Pareto front, order of convergence, recommendations, files and page."""

from __future__ import annotations

import csv
import json
import math
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mpipic.files import write_json
from mpipic.plots.work_precision import draw_work_precision
from mpipic.scene.records import SceneError
from mpipic.study.file import Study, load
from mpipic.study.pareto import cheapest, fit_order, front, most_accurate
from mpipic.study.results import Origin, content, floor, marks, orders, sum_up, write_table
from mpipic.study.verb import parse_aims, recommend, report

NASTY = '<script>alert("1")</script> & $x^$ \\"'


def study_of(folder: Path, name: str = "fine", levels: str = "[[8], [16], [32], [64]]") -> Study:
    path = folder / "made-up.toml"
    path.write_text(
        f"title = {json.dumps(name)}\nuntil = 1.0\n[axes]\ngrid.cells = {levels}\n"
        f"[[scheme]]\nname = {json.dumps(name)}\nfilter.kind = 'local'\n"
        f"[[scheme]]\nname = 'rough'\nfilter.kind = 'none'\n"
    )
    return load(path)


def run_of(point: Any, repeat: int = 1, error: float = 0.1, seconds: float = 1.0, **more: Any) -> dict[str, Any]:
    norms = {"l1": error / 2, "l2": error, "linf": 2 * error}
    return {
        "id": point.id, "repeat": repeat, "status": "completed", "message": "", "timeout": 60.0,
        "steps": point.scene.time.steps, "time": 1.0, "ranks": 1, "particles": 100, "nodes": 50,
        "seconds": {"total": seconds + 1, "setup": 1.0, "step": seconds, "phases": {"filter": seconds / 2}},
        "particle_steps_per_second": 1e6 / seconds, "errors": {"density": norms, "velocity": norms},
        "peak_memory": 1000 * repeat, "wall_seconds": seconds + 2, "machine": {"processor": "x", "cores": 2},
        "versions": {"mpipic": "0"}, **more,
    }  # fmt: skip


def failed_run(point: Any, status: str, **more: Any) -> dict[str, Any]:
    return {**run_of(point), "errors": None, "status": status, "message": f"{status} & why", **more}


def made_up(study: Study) -> list[list[dict[str, Any]]]:
    """Order 2 for the first scheme, three times; the other unstable half-way, timed out, crashed and not run."""
    runs: list[list[dict[str, Any]]] = []
    for number, point in enumerate(study.points):
        h = point.scene.h[0]
        if number < 4:
            runs.append([run_of(point, repeat, 3 * h**2, (1 + repeat % 3) / h) for repeat in (1, 2, 3)])
        elif number == 4:
            runs.append([failed_run(point, "unstable", steps=point.scene.time.steps // 2)])
        elif number < 7:
            nothing = {"steps": None, "seconds": None, "peak_memory": 0}
            runs.append([failed_run(point, "timeout" if number == 5 else "crashed", **nothing)])
        else:
            runs.append([])
    return runs


# ------------------------------------------------------------ choosing


def beaten(pairs: list[tuple[float, float]], i: int) -> bool:
    x, y = pairs[i]
    return any(a <= x and b <= y and (a, b) != (x, y) for a, b in pairs) or (x, y) in pairs[:i]


def test_the_front_is_what_nothing_beats() -> None:
    random = np.random.default_rng(3)
    for size in (0, 1, 2, 30):
        pairs = [(float(a), float(b)) for a, b in random.integers(1, 8, (size, 2))]
        expected = sorted((i for i in range(size) if not beaten(pairs, i)), key=lambda i: pairs[i])
        assert front(pairs) == expected


@pytest.mark.parametrize("order", [1.0, 2.0, 3.5, -0.5])
def test_the_fit_finds_the_order_of_made_up_errors(order: float) -> None:
    h = [1 / 8, 1 / 16, 1 / 24, 1 / 64]
    fit = fit_order(h, [7.0 * value**order for value in h])
    assert fit.order == pytest.approx(order, abs=1e-12) and fit.coefficient == pytest.approx(7.0)
    assert fit.residual < 1e-12 and fit.count == 4


def test_the_fit_is_the_least_squares_line_and_says_how_far_points_are_from_it() -> None:
    h, errors = [0.5, 0.2, 0.1, 0.04], [0.3, 0.02, 0.011, 0.0007]
    slope, intercept = np.polyfit(np.log(h), np.log(errors), 1)
    rest = np.log(errors) - slope * np.log(h) - intercept
    fit = fit_order(h, errors)
    assert fit.order == pytest.approx(slope) and math.log(fit.coefficient) == pytest.approx(intercept)
    assert fit.residual == pytest.approx(np.sqrt(np.mean(rest**2)))


def test_choices_are_the_cheapest_and_the_most_accurate() -> None:
    pairs = [(3.0, 0.01), (1.0, 0.1), (2.0, 0.01), (9.0, 0.001)]
    assert cheapest(pairs, 0.01) == 2 and cheapest(pairs, 1.0) == 1 and cheapest(pairs, 1e-4) is None
    assert most_accurate(pairs, 3.0) == 2 and most_accurate(pairs, 10.0) == 3 and most_accurate(pairs, 0.5) is None


def test_recommendations_name_the_setting_or_say_plainly_that_there_is_none(tmp_path: Path) -> None:
    study = study_of(tmp_path)
    rows = sum_up(study, made_up(study))
    say = [
        recommend(rows, *aim, tmp_path) for aim in parse_aims(["error=0.02", "seconds=40", "error=1e-9", "seconds=1"])
    ]
    assert say[0].startswith("for an error of at most 0.02: fine, 16 cells: error 1.172e-02 in 32 s")
    assert str(tmp_path / "scenes" / study.points[1].id) + ".toml" in say[0]
    assert "within 40 s of stepping: fine, 16 cells" in say[1]
    assert "no completed point; the most accurate is fine, 64 cells" in say[2]
    assert "no completed point; the fastest is fine, 8 cells" in say[3]
    assert "no point completed" in recommend(sum_up(study, [[] for _ in study.points]), "error", 1.0, tmp_path)


def test_every_wrong_aim_is_named() -> None:
    with pytest.raises(SceneError) as caught:
        parse_aims(["error=1e-4", "speed=3", "seconds=-1", "error", "seconds=nan"])
    assert len(str(caught.value).split("\n")) == 4


# ------------------------------------------------------------ rows and orders


def test_a_row_is_the_median_and_spread_of_its_runs_and_a_failure_decides(tmp_path: Path) -> None:
    study = study_of(tmp_path)
    rows = sum_up(study, made_up(study))
    assert [row.status for row in rows] == ["completed"] * 4 + ["unstable", "timeout", "crashed", "not run"]
    first = rows[0]
    assert first.seconds is not None and first.error == pytest.approx(3 / 64)
    assert (first.seconds.median, first.seconds.least, first.seconds.largest) == (16.0, 8.0, 24.0)
    assert (first.repeats, first.peak_memory, first.phases) == (3, 3000, {"filter": 8.0})
    assert [row.on_front for row in rows] == [True] * 4 + [False] * 4
    assert rows[4].whole_seconds == 2.0 and rows[5].seconds is None
    mixed = [*made_up(study)[0], failed_run(study.points[0], "crashed")]
    assert sum_up(study, [mixed, *made_up(study)[1:]])[0].status == "crashed"


def test_an_unstable_point_is_on_no_front_however_fast_it_was(tmp_path: Path) -> None:
    study = study_of(tmp_path)
    runs = [[failed_run(point, "unstable")] for point in study.points]
    runs[-1] = [run_of(study.points[-1], error=5.0, seconds=99.0)]
    assert [row.on_front for row in sum_up(study, runs)] == [False] * 7 + [True]


def test_orders_come_from_three_errors_above_the_floor(tmp_path: Path) -> None:
    study = study_of(tmp_path)
    (order,) = orders(sum_up(study, made_up(study)))
    assert order.label == "fine" and order.fit.order == pytest.approx(2.0) and order.left_out == 0

    runs = made_up(study)
    runs[3] = [failed_run(study.points[3], "crashed")]
    (order,) = orders(sum_up(study, runs))
    assert order.fit.count == 3 and order.left_out == 0
    lowest = floor(study.points[3].scene, study.points[3].scene.time.steps)
    assert 1e-14 < lowest < 1e-12
    runs[3] = [run_of(study.points[3], error=9 * lowest)]
    (order,) = orders(sum_up(study, runs))
    assert order.fit.count == 3 and order.left_out == 1 and order.fit.order == pytest.approx(2.0)
    runs[2] = [run_of(study.points[2], error=lowest)]
    assert orders(sum_up(study, runs)) == []


# ------------------------------------------------------------ files


ORIGIN = Origin(f"mpipic study '{NASTY}'", {"processor": NASTY}, {"mpipic": "0"})


def test_csv_has_a_row_a_point_with_axes_and_numbers(tmp_path: Path) -> None:
    study = study_of(tmp_path, NASTY)
    write_table(tmp_path / "study.csv", study, sum_up(study, made_up(study)))
    with (tmp_path / "study.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["grid.cells"] for row in rows] == ["[8]", "[16]", "[32]", "[64]"] * 2
    assert rows[0]["scheme"] == NASTY and rows[7]["status"] == "not run" and rows[7]["seconds"] == ""
    assert float(rows[1]["density_l2"]) == 3 / 16**2 and float(rows[1]["velocity_linf"]) == 6 / 16**2
    assert [rows[1][name] for name in ("seconds", "seconds_min", "seconds_max")] == ["32.0", "16.0", "48.0"]
    assert (rows[1]["on_front"], rows[1]["seconds_filter"], rows[1]["repeats"]) == ("true", "16.0", "3")
    assert int(rows[0]["steps"]) * float(rows[0]["dt"]) == 1.0


def test_json_holds_everything_strictly(tmp_path: Path) -> None:
    study = study_of(tmp_path)
    runs = made_up(study)
    runs[0] = [run_of(study.points[0], error=math.inf)]
    write_json(tmp_path / "study.json", content(study, sum_up(study, runs), runs, ORIGIN))
    found = json.loads((tmp_path / "study.json").read_text(), parse_constant=pytest.fail)
    assert found["command"] == ORIGIN.command and found["settings"]["until"] == 1.0
    assert [point["id"] for point in found["points"]] == [point.id for point in study.points]
    assert found["points"][1]["scene"] == study.points[1].scene.to_dict()
    assert len(found["points"][1]["runs"]) == 3 and found["orders"][0]["order"] == pytest.approx(2.0)


class Page(HTMLParser):
    """Tags, attributes and text of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str]] = []
        self.words: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(name, value or "") for name, value in attrs]

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def test_the_page_is_self_contained_and_escapes_what_others_named(tmp_path: Path) -> None:
    study = study_of(tmp_path, NASTY)
    runs = made_up(study)
    runs[6][0]["message"] = NASTY
    rows = sum_up(study, runs)
    draw_work_precision(tmp_path / "p.png", marks(study, rows), study.title, "error")
    text = report.page(study, rows, ORIGIN, tmp_path / "p.png")
    page = Page(text)
    assert page.tags.count("script") == 1 and not re.search(r"alert\(\"1\"\)</script>", text)
    fetched = [value for name, value in page.attributes if name in ("src", "href", "data", "srcset", "action")]
    assert len(fetched) == 1 and fetched[0].startswith("data:image/png;base64,")
    assert "http" not in text.replace(fetched[0], "") and "@import" not in text and "url(" not in text
    assert page.tags.count("img") == 1 and page.tags.count("link") == 0
    said = "".join(page.words)
    assert said.count(NASTY) >= 4 + 4, "title, heading, command, machine, and each point of the scheme"
    for part in ("unstable", "not run", 'profile = "gaussian"', "mpipic study", study.source):
        assert part in said
    assert re.search(r'Observed order.*<td class="number" data-value="2\.0">2</td>', text, re.DOTALL)


# ------------------------------------------------------------ the picture


@pytest.fixture
def figures(monkeypatch: Any) -> list[Any]:
    """The figures drawn, as they were when saved."""
    from matplotlib.figure import Figure

    drawn: list[Any] = []
    save = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *a, **k: (drawn.append(self), save(self, *a, **k))[1])
    return drawn


def test_the_picture_has_a_line_a_scheme_the_front_and_crosses(tmp_path: Path, figures: list[Any]) -> None:
    study = study_of(tmp_path)
    rows = sum_up(study, made_up(study))
    draw_work_precision(tmp_path / "p.png", marks(study, rows), "title", "error", "note")
    (figure,) = figures
    (axes,) = figure.axes
    assert (axes.get_xscale(), axes.get_yscale(), axes.get_title()) == ("log", "log", "title")
    x, y = [16.0, 32.0, 64.0, 128.0], [3 * h**2 for h in (1 / 8, 1 / 16, 1 / 32, 1 / 64)]
    joined = [line for line in axes.lines if len(line.get_xdata()) == 4]
    assert len(joined) == 2, "the front and one scheme"
    for line in joined:
        assert np.allclose(line.get_xdata(), x) and np.allclose(line.get_ydata(), y)
    crosses = [line for line in axes.lines if line.get_marker() == "X" and len(line.get_xdata())]
    assert [float(line.get_xdata()[0]) for line in crosses] == [2.0]
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels[1:3] == ["fine", "rough"] and labels[0].startswith("Pareto") and labels[3].startswith("unstable")
    assert "note" in axes.get_xlabel()


def test_a_study_without_results_still_draws(tmp_path: Path) -> None:
    draw_work_precision(tmp_path / "p.png", [], "title", "error")
    assert (tmp_path / "p.png").stat().st_size > 1000
