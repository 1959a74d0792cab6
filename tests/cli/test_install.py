"""Claims about the package as it is installed from here, away from this folder."""

from __future__ import annotations

import os
import re
import shutil
import site
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from helpers import ROOT, environment

SOURCES = ROOT / "src" / "mpipic"


def contents(package: Path) -> set[str]:
    """Files of a package, below its folder; without what Python and Numba make beside them."""
    files = [path for path in package.rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    return {path.relative_to(package).as_posix() for path in files}


class Installed:
    """A fresh virtual environment on top of this one, with mpipic built and installed by pip as it stands."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.program = folder, folder / "venv" / "bin" / "python"
        self.elsewhere = folder / "elsewhere"
        self.elsewhere.mkdir()
        base = Path(sys.base_prefix) / "bin" / f"python{sys.version_info[0]}.{sys.version_info[1]}"
        self.run(base, "-m", "venv", "--system-site-packages", "--without-pip", folder / "venv")
        (self.packages,) = (folder / "venv").glob("lib/python3*/site-packages")
        # the libraries of the environment that runs the tests, also where its own .pth files name them
        libraries = [path for path in sys.path if Path(path).name in ("site-packages", "dist-packages")]
        (self.packages / "libraries.pth").write_text("\n".join([*site.getsitepackages(), *libraries]) + "\n")
        source = folder / "source"  # building leaves files beside the sources
        shutil.copytree(SOURCES, source / "src" / "mpipic", ignore=shutil.ignore_patterns("__pycache__"))
        for name in ("pyproject.toml", "README.md", "LICENSE", "CITATION.cff"):
            shutil.copy(ROOT / name, source)
        pip = [sys.executable, "-m", "pip", "--python", self.program, "--disable-pip-version-check", "--no-input"]
        self.run(*pip, "install", "--no-index", "--no-deps", "--no-build-isolation", "--ignore-installed", source)
        shutil.rmtree(source)

    def run(self, *command: str | Path) -> str:
        """Run a command in a folder that is not the tree's, with nothing of the tree on its path."""
        settings = environment(XDG_CACHE_HOME=str(self.folder / "cache"), PYTHONNOUSERSITE="1")
        del settings["PYTHONPATH"]
        ended = subprocess.run(
            list(map(str, command)), cwd=self.elsewhere, env=settings, text=True, capture_output=True, timeout=120
        )
        assert ended.returncode == 0, ended.stdout + ended.stderr
        return ended.stdout

    def mpipic(self, *words: str | Path) -> str:
        return self.run(self.program, "-m", "mpipic", *words)


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Installed:
    return Installed(tmp_path_factory.mktemp("installed"))


@pytest.mark.slow
def test_pip_installs_every_file_of_the_package(installed: Installed) -> None:
    here = contents(SOURCES)
    assert "py.typed" in here and any(name.endswith(".jinja") for name in here), "not only modules"
    assert contents(installed.packages / "mpipic") == here
    (metadata,) = installed.packages.glob("mpipic-*.dist-info")
    assert {"LICENSE", "CITATION.cff"} <= {path.name for path in metadata.rglob("*")}


@pytest.mark.slow
def test_the_installed_package_checks_and_runs_a_scene(installed: Installed) -> None:
    where = installed.run(installed.program, "-c", "import mpipic; print(mpipic.__file__)").strip()
    assert Path(where) == installed.packages / "mpipic" / "__init__.py"
    assert installed.mpipic("--version") == installed.run(installed.program.parent / "mpipic", "--version")
    assert "lattice" in installed.mpipic("check")
    installed.mpipic("run", "--set", "time.steps=5", "--set", "output.report_at=[]", "--output", "out")
    assert {"scene.toml", "summary.json", "solution.png"} <= set(os.listdir(installed.elsewhere / "out"))


@pytest.mark.slow
def test_the_installed_package_writes_the_page_of_a_study(installed: Installed) -> None:
    """Its template is a file of the package that is not a module."""
    (installed.elsewhere / "study.toml").write_text("until = 0.01\nrepeats = 1\n[axes]\ngrid.cells = [[10], [20]]\n")
    installed.mpipic("study", "study.toml", "--output", "study")
    assert "<table" in (installed.elsewhere / "study" / "report.html").read_text()


def test_licence_citation_and_package_state_one_version_and_one_licence() -> None:
    from mpipic import __version__

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    citation = (ROOT / "CITATION.cff").read_text()
    stated = dict(re.findall(r"^(version|license|title): (.*)$", citation, flags=re.MULTILINE))
    assert stated == {"version": project["version"], "license": project["license"], "title": project["name"]}
    assert project["version"] == __version__
    assert (ROOT / "LICENSE").read_text().startswith(f"{project['license']} License")
