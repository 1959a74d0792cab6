"""Claims about the pictures: what they show, and that no data can break them."""

from __future__ import annotations

import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from covering_helpers import covering
from mpipic.plots.growth_map import Scale, draw_map
from mpipic.plots.history import draw_error
from mpipic.plots.sample import gather_sample
from mpipic.plots.solution import draw_solution
from mpipic.plots.spectra import Curve, draw_spectrum
from mpipic.plots.style import LONGEST_LINE, Subject, picture
from mpipic.plots.work_precision import Mark, draw_work_precision

COMM = MPI.COMM_SELF
PNG = b"\x89PNG\r\n\x1a\n"


def subject(dim: int) -> Subject:
    return Subject("pulse", "svd", (1.0,) * dim, (0.1,) * dim, symbols={"density": "ρ", "velocity": "u"})


def exact(x: np.ndarray, t: float) -> dict[str, np.ndarray]:
    return {"density": np.cos(2 * np.pi * x[:, 0]) + t, "velocity": np.sin(2 * np.pi * x)}


def sample(dim: int, n: int = 300) -> dict[str, np.ndarray]:
    x = np.random.default_rng(1).random((n, dim))
    return {"ids": np.arange(n), "position": x, **exact(x, 0.25)}


@pytest.fixture
def figures(monkeypatch: Any) -> list[Any]:
    """The figures drawn, as they were when saved."""
    from matplotlib.figure import Figure

    drawn: list[Any] = []
    save = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *a, **k: (drawn.append(self), save(self, *a, **k))[1])
    return drawn


def offsets(collection: Any) -> np.ndarray:
    return np.asarray(collection.get_offsets())


def test_1d_shows_every_particle_and_the_exact_line(tmp_path: Path, figures: list[Any]) -> None:
    data = sample(1)
    draw_solution(tmp_path / "s.png", subject(1), 0.25, 7, data, exact)
    (figure,) = figures
    assert (tmp_path / "s.png").read_bytes()[:8] == PNG
    for axes, name in zip(figure.axes, ("density", "velocity")):
        dots, line = axes.lines
        assert np.array_equal(dots.get_xdata(), data["position"][:, 0])
        assert np.array_equal(dots.get_ydata(), np.ravel(data[name]))
        x = line.get_xdata()
        assert np.allclose(line.get_ydata(), np.ravel(exact(x[:, None], 0.25)[name]))
        assert axes.get_ylabel().startswith(name)
    title = figure.get_suptitle() if hasattr(figure, "get_suptitle") else figure._suptitle.get_text()
    assert all(word in title for word in ("pulse", "svd", "step 7", "t = 0.25"))


def test_2d_shows_particles_exact_map_and_their_difference(tmp_path: Path, figures: list[Any]) -> None:
    data = sample(2)
    data["density"] = data["density"] + np.linspace(-0.1, 0.2, 300)
    draw_solution(tmp_path / "s.png", subject(2), 0.25, 7, data, exact)
    maps = [axes for axes in figures[0].axes if axes.get_title()]
    particles, truth, error = (axes.collections[0] for axes in maps)
    assert np.array_equal(offsets(particles), data["position"])
    assert np.array_equal(particles.get_array(), data["density"])
    assert np.allclose(error.get_array(), np.linspace(-0.1, 0.2, 300))
    assert particles.get_clim() == truth.get_clim() and error.get_clim() == pytest.approx((-0.2, 0.2))
    centres = (np.arange(120) + 0.5) / 120
    assert np.allclose(np.reshape(truth.get_array(), (120, 120)), np.cos(2 * np.pi * centres)[None, :] + 0.25)


def test_3d_shows_a_slab_the_centre_line_and_parity(tmp_path: Path, figures: list[Any]) -> None:
    data = sample(3, 20_000)
    draw_solution(tmp_path / "s.png", subject(3), 0.25, 7, data, exact)
    slab, line, parity = (axes for axes in figures[0].axes if axes.get_title())
    shown = offsets(slab.collections[0])
    inside = np.abs(data["position"][:, 2] - 0.5) <= 0.055
    assert 1900 <= len(shown) <= np.count_nonzero(inside)
    assert set(map(tuple, shown)) <= set(map(tuple, data["position"][inside][:, :2]))
    assert np.allclose(line.lines[1].get_ydata(), exact(np.stack([line.lines[1].get_xdata()] * 3, 1), 0.25)["density"])
    assert len(line.lines[0].get_xdata()) >= 100
    assert np.allclose(parity.lines[0].get_xdata(), parity.lines[0].get_ydata())


CASES = ("zero", "tiny", "nan", "huge", "mixed", "empty", "one")


@pytest.mark.parametrize(("dim", "case", "with_exact"), covering(2, (1, 2, 3), CASES, (True, False)))
def test_no_data_can_break_a_solution(tmp_path: Path, dim: int, case: str, with_exact: bool) -> None:
    data = sample(dim, {"empty": 0, "one": 1}.get(case, 40))
    factor = {"zero": 0.0, "tiny": 5e-324, "nan": np.nan, "huge": 1e300}.get(case, 1.0)
    data["density"], data["velocity"] = data["density"] * factor, data["velocity"] * factor
    if case == "mixed":
        data["density"][:3], data["velocity"][3], data["position"][4] = (np.nan, 1.7e308, -1.7e308), np.inf, np.nan
    with warnings.catch_warnings(), np.errstate(all="warn"):
        warnings.simplefilter("error")
        draw_solution(tmp_path / "s.png", subject(dim), 0.25, 7, data, exact if with_exact else None)
    assert [path.name for path in tmp_path.iterdir()] == ["s.png"]
    assert (tmp_path / "s.png").read_bytes()[:8] == PNG


def test_particles_that_are_not_finite_are_counted(tmp_path: Path, figures: list[Any]) -> None:
    data = sample(1)
    data["density"][:3], data["velocity"][2:5] = np.nan, np.inf
    draw_solution(tmp_path / "s.png", subject(1), 0.25, 7, data, exact)
    assert "5 of 300 particles not finite" in figures[0]._suptitle.get_text()
    assert len(figures[0].axes[0].lines[0].get_xdata()) == 295


def row(step: int, density: Any, error: Any = None) -> dict[str, Any]:
    return {"step": step, "time": 0.01 * step, "max_density": density, "density_l2": error, "velocity_l2": error}


def test_errors_are_drawn_where_they_are_recorded_on_a_log_axis(tmp_path: Path, figures: list[Any]) -> None:
    rows = [row(0, 1.0), row(10, 0.5, 1e-3), row(20, 0.25), row(30, 0.125, 4e-3)]
    draw_error(tmp_path / "e.png", rows, subject(1))
    axes = figures[0].axes[0]
    curves = {line.get_label(): line for line in axes.lines}
    assert axes.get_yscale() == "log"
    assert list(curves["largest |ρ|"].get_ydata()) == [1.0, 0.5, 0.25, 0.125]
    for label in ("density error, l2", "velocity error, l2"):
        assert np.allclose(curves[label].get_xdata(), [0.1, 0.3])
        assert list(curves[label].get_ydata()) == [1e-3, 4e-3]
    low, high = axes.get_ylim()
    assert low < 1e-3 and high > 1.0
    assert all(word in axes.get_title() for word in ("pulse", "svd", "step 30", "t = 0.3"))
    assert not any("unstable" in label for label in curves)


def test_an_unstable_end_is_marked_at_its_time(tmp_path: Path, figures: list[Any]) -> None:
    draw_error(tmp_path / "e.png", [row(0, 1.0), row(10, 1e5), row(20, np.inf)], subject(1), unstable=True)
    marks = [line for line in figures[0].axes[0].lines if "unstable at step 20" in line.get_label()]
    assert len(marks) == 1 and list(marks[0].get_xdata()) == [0.2, 0.2]


@pytest.mark.parametrize(
    "values", [[], [None], [0.0], [np.nan], [np.inf], [1e300, 5e-324], [1.7e308], [1e-320], [-1.0], [1.0, 0.0, np.nan]]
)
def test_no_history_can_break_the_error_plot(tmp_path: Path, values: list[Any]) -> None:
    with warnings.catch_warnings(), np.errstate(all="warn"):
        warnings.simplefilter("error")
        draw_error(tmp_path / "e.png", [row(k, value, value) for k, value in enumerate(values)], None, True)
    assert [path.name for path in tmp_path.iterdir()] == ["e.png"]


def test_a_picture_that_fails_keeps_the_old_one(tmp_path: Path) -> None:
    draw_error(tmp_path / "s.png", [row(1, 1.0)])
    old = (tmp_path / "s.png").read_bytes()

    def broken(x: np.ndarray, t: float) -> Any:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        draw_solution(tmp_path / "s.png", subject(1), 0.25, 7, sample(1), broken)
    assert [path.name for path in tmp_path.iterdir()] == ["s.png"] and (tmp_path / "s.png").read_bytes() == old


def of_ids(ids: np.ndarray) -> SimpleNamespace:
    fields = {"density": np.sqrt(ids), "pair": np.stack([ids, -ids], axis=1)}
    return SimpleNamespace(ids=ids, position=ids[:, None] * 0.5, fields=fields)


def test_a_small_sample_is_everything_in_the_order_of_ids() -> None:
    taken = gather_sample(of_ids(np.random.default_rng(0).permutation(500)), COMM, 500)
    assert taken is not None and np.array_equal(taken["ids"], np.arange(500))
    assert np.array_equal(taken["pair"][:, 1], -np.arange(500))
    assert np.array_equal(taken["density"], np.sqrt(np.arange(500)))


@pytest.mark.parametrize("total", [501, 4096, 100_000])
def test_a_large_sample_is_bounded_even_and_not_in_step_with_a_lattice(total: int) -> None:
    taken = gather_sample(of_ids(np.arange(total)), COMM, 500)
    assert taken is not None
    ids = taken["ids"]
    assert 480 <= len(ids) <= 500 and len(set(ids)) == len(ids)
    assert np.max(np.diff(ids)) <= 4 * total / 500
    for width in (8, 10, 64, 100):
        columns = np.bincount(ids % width, minlength=width)
        assert columns.max() <= 3 * len(ids) / width + 2 and np.count_nonzero(columns) > 0.7 * width


def test_huge_ids_do_not_overflow() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ids = np.arange(1000) + (2**62)
        assert 90 <= len(gather_sample(of_ids(ids), COMM, 100)["ids"]) <= 100


def test_a_map_of_growth_has_a_panel_a_filter_and_crosses_where_none_was_found(
    tmp_path: Path, figures: list[Any]
) -> None:
    x, y = Scale("gas.flow", np.array([0.1, 0.2, 0.3])), Scale("time.cfl", np.array([0.4, 0.5]))
    growth = {"none": np.arange(1.0, 7.0).reshape(3, 2) * 1e-3, "local": np.zeros((3, 2))}
    growth["none"][2, 0] = np.nan
    draw_map(tmp_path / "m.png", x, y, growth, 2e-3, "title")
    none, local = (axes for axes in figures[0].axes if axes.get_title())
    drawn = np.ma.filled(none.collections[0].get_array(), np.nan).reshape(2, 3)
    assert np.array_equal(drawn, growth["none"].T, equal_nan=True)
    assert [list(line.get_xydata()[0]) for line in none.lines if len(line.get_xydata())] == [[0.3, 0.4]]
    assert np.all(local.collections[0].get_array() == 1e-9) and not len(local.lines[0].get_xydata())
    assert (none.get_title(), none.get_xlabel(), none.get_ylabel()) == ("none", "gas.flow", "time.cfl")


# ---------------------------------------------------------------- names that users give

NAMES = [
    "$", "$x", "$$", r"$\frac{1", "a$b$c", r"_^{}\%#&~", r"\alpha", "{", "%s %d {0}", "日本語", "مرحبا", "😀", "a\nb",
    "x" * 300, "[/x]", "\x1b[31mred", "\udcff", " ", "", "-", "<b>&amp;", "{{ 7 * 7 }}", "\t", "a\x00b",
]  # fmt: skip


def test_any_name_is_drawn_as_it_is_and_numbers_stay_powers(tmp_path: Path, figures: list[Any]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with picture(tmp_path / "names.png", (6.0, 6.0)) as figure:
            axes = figure.add_subplot(xscale="log", yscale="log", xlim=(1e-9, 1e9))
            texts = [figure.text(0.1, 0.5, name) for name in NAMES]
            axes.set_title("$")
    for name, text in zip(NAMES, texts):
        shown = text.get_text()
        assert not text.get_parse_math() and len(shown) <= LONGEST_LINE
        assert shown == name or len(name) > LONGEST_LINE or not name.isprintable()
        assert all(line.isprintable() for line in shown.split("\n"))
    numbers = axes.xaxis.get_majorticklabels()
    assert all(number.get_parse_math() for number in numbers) and any("^{" in number.get_text() for number in numbers)


def test_every_picture_takes_any_name(tmp_path: Path, figures: list[Any]) -> None:
    name = "$_" + "y" * 300
    who = Subject(name, name, (1.0,), (0.1,), symbols={"density": "$"})
    shares = np.array([[1e-3, 1e-9], [1e-8, 1e-2]])
    marks = [Mark(name + end, name, 1.0, (0.9, 1.1), 0.1, True) for end in ("", "_", "$")]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        draw_error(tmp_path / "0.png", [{"step": 1, "time": 1.0, "max_density": 1.0}], who)
        draw_solution(tmp_path / "1.png", who, 0.25, 7, sample(1), exact)
        draw_spectrum(tmp_path / "2.png", [Curve("x", name, (2.0, 4.0), (0.1, 0.2))], name)
        draw_map(tmp_path / "3.png", *[Scale("a.b", np.array([1.0, 2.0]))] * 2, {"local": shares}, 1e-6, name)
        draw_work_precision(tmp_path / "4.png", marks, name, "error", name)
    assert len(figures) == 5
    assert len(figures[4].legends[0].get_texts()) == 4, "a scheme with an underscore in front is in the legend too"
