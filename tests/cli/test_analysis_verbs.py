"""The verbs spectrum, filters, stability and trials as users call them."""

import csv
import json
import re

import pytest

from helpers import ROOT, mpipic, mpipic_here

pytestmark = pytest.mark.mpi

PNG = b"\x89PNG"
LATTICE = ["--set", "grid.cells=[64]", "--set", "particles.per_cell=[4]"]
# what one application keeps of cos(2 pi x / lambda + 0.3), linear basis, 4 a cell: lambda / h to the digits
KEPT = {
    "local": {2: "0.284", 8: "0.899", 16: "0.974"},
    "order 2": {2: "0.479", 8: "0.989", 16: "0.9993"},
    "order 5": {2: "0.769", 8: "0.9995", 16: "1.0000"},
    "svd": {2: "0.908", 8: "0.9996", 16: "1.0000"},
}


def on(ranks, *args):
    return mpipic(*args, ranks=ranks) if ranks > 1 else mpipic_here(*args)


@pytest.mark.parametrize("ranks", [1, 2])
def test_spectrum_keeps_of_waves_what_is_known(tmp_path, ranks):
    names = "local,order:2,order:5,svd"
    done = on(ranks, "spectrum", *LATTICE, "--filters", names, "-o", tmp_path)
    assert done.returncode == 0, done.stderr
    with (tmp_path / "spectrum.csv").open() as file:
        rows = list(csv.DictReader(file))
    found = {(row["filter"], float(row["lambda_over_h"])): float(row["kept"]) for row in rows}
    for label, values in KEPT.items():
        for length, digits in values.items():
            assert f"{found[label, length]:.{len(digits) - 2}f}" == digits, (label, length)
    assert (tmp_path / "spectrum.png").read_bytes().startswith(PNG)


@pytest.mark.parametrize("ranks", [1, 2])
def test_filters_compares_cost_and_distance(tmp_path, ranks):
    file = tmp_path / "filters.json"
    settings = ["--set", "grid.cells=[12,12]", "--set", "particles.layout=random"]
    done = on(ranks, "filters", *settings, "-o", file)
    assert done.returncode == 0, done.stderr
    table = json.loads(file.read_text())
    rows = {row["filter"]: row for row in table["filters"]}
    assert table["unfiltered_null_space_share"] > 0.5 and table["ranks"] == ranks and table["reference"] == "svd"
    assert rows["svd"]["distance"] < 1e-14 and rows["exact"]["distance"] < 1e-9
    assert rows["local"]["distance"] > rows["order 2"]["distance"] > rows["order 5"]["distance"] > 1e-3
    assert all(row["null_space_share"] < 1e-9 and row["sum_error"] < 1e-9 for row in rows.values())
    assert all(row["seconds"] > 0 for row in rows.values())
    assert rows["svd"]["facts"]["rank"] <= 144 and rows["exact"]["facts"]["iterations"] > 5
    if ranks == 1:
        assert all(row["messages"] == row["reductions"] == 0 for row in rows.values())
    else:
        assert rows["local"]["messages"] > 0 and rows["local"]["reductions"] == 0
        assert rows["order 5"]["messages"] == 5 * rows["local"]["messages"] and rows["order 5"]["reductions"] == 0
        assert rows["exact"]["reductions"] > 2 * rows["exact"]["facts"]["iterations"]


def test_a_filter_that_there_is_not_is_refused_with_the_nearest(tmp_path):
    done = mpipic_here("filters", "--filters", "locl,order:0,exact:3")
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert 'Did you mean "local"?' in done.stderr and "after the colon" in done.stderr and "no order" in done.stderr


def test_stability_writes_what_it_found(tmp_path):
    quick = ["--set", "grid.cells=[16]", "--set", "gas.flow=[0.25]", "--set", "time.cfl=0.2"]
    for ranks in (1, 2):
        done = on(ranks, "stability", *quick, "-o", tmp_path / str(ranks))
        assert done.returncode == 0, done.stderr
    one, two = (json.loads((tmp_path / str(n) / "stability.json").read_text()) for n in (1, 2))
    assert {"growth_per_step", "period_steps", "eigenvalue", "residual", "blow_up_step"} <= set(one)
    assert one["growth_per_step"] == pytest.approx(two["growth_per_step"], rel=1e-6)
    assert one["period_steps"] == 10 and one["growth_per_step"] > 0


def test_stability_refuses_a_flow_that_does_not_recur_and_can_round_it(tmp_path):
    odd = ["--set", "grid.cells=[8]", "--set", "gas.flow=[0.31234]", "--set", "time.cfl=0.2"]
    refused = mpipic_here("stability", *odd, "--max-period", "30", "-o", tmp_path)
    assert refused.returncode == 2 and "near it, these do" in refused.stderr and "Traceback" not in refused.stderr
    done = mpipic_here("stability", *odd, "--max-period", "30", "--round-flow", "-o", tmp_path)
    assert done.returncode == 0 and json.loads((tmp_path / "stability.json").read_text())["period_steps"] <= 30


def test_a_stability_map_has_a_point_for_every_value_and_filter(tmp_path):
    axes = ["--map", "gas.flow=0:0.5:3", "--map", "time.cfl=0.1:0.4:2"]
    done = mpipic_here("stability", "--set", "grid.cells=[8]", *axes, "--filters", "none,local", "--max-period", "20",
                       "-o", tmp_path)  # fmt: skip
    assert done.returncode == 0, done.stderr
    with (tmp_path / "stability-map.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 12 and {row["filter"] for row in rows} == {"none", "local"}
    assert max(float(row["growth_per_step"]) for row in rows) > 1e-2
    assert (tmp_path / "stability-map.png").read_bytes().startswith(PNG)


@pytest.mark.parametrize("ranks", [1, 2])
def test_the_short_trials_are_all_good(tmp_path, ranks):
    file = tmp_path / "trials.json"
    done = mpipic("trials", "--short", "-o", file, ranks=ranks)
    cases = json.loads(file.read_text())["cases"]
    assert [case["case"] for case in cases if case["verdict"] != "good"] == []
    assert done.returncode == 0 and len(cases) >= 12
    assert {"completed", "unstable"} <= {case["status"] for case in cases}


def test_a_run_above_the_cfl_limit_is_warned_before_and_told_after(tmp_path):
    done = mpipic_here("run", ROOT / "configs" / "paper.toml", "--set", "time.cfl=3.0", "--set", "time.steps=1000",
                       "--no-plots", "-o", tmp_path / "run")  # fmt: skip
    assert done.returncode == 3
    assert "is above 2.8" in done.stderr and "cause: the time step" in done.stdout


GRIDS = ["1", "2", "3", "1,1", "1,2", "3,3", "1,1,1", "1,2,3"]


@pytest.mark.parametrize("cells", GRIDS)
def test_spectra_of_tiny_grids_come_out_or_are_refused(tmp_path, cells):
    ones = ",".join("1" for _ in cells.split(","))
    words = ["--set", f"grid.cells=[{cells}]", "--set", f"particles.per_cell=[{ones}]", "-o", tmp_path]
    done = mpipic_here("spectrum", *words, "--no-plots", "--filters", "local,order:2,exact")
    if {*cells} <= {*"1,"}:
        assert done.returncode == 2 and "carries no wave" in done.stderr and not list(tmp_path.iterdir())
    else:
        assert done.returncode == 0 and "nan" not in (tmp_path / "spectrum.csv").read_text()


def test_a_scene_of_any_name_runs_and_its_folder_has_a_safe_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = ["$x_^{", "\udcff", "a\nb", "[x]", "...", "é" * 120, "-", " "]
    for name in names:
        (tmp_path / f"{name}.toml").write_text("[grid]\ncells = [4]\n[time]\nsteps = 1\n")
        done = mpipic_here("run", "--no-plots", "--", f"{name}.toml")
        assert done.returncode == 0 and "Traceback" not in done.stderr, (name, done.stderr)
    folders = [path.name for path in (tmp_path / "runs").iterdir()]
    assert len(folders) == len(names) and all(re.fullmatch(r"[\w.-]+", name) for name in folders), folders
    done = mpipic_here("spectrum", "--filters", "local", "$x_^{.toml")
    assert done.returncode == 0 and len(list((tmp_path / "runs").glob("*spectrum*/spectrum.png"))) == 1
