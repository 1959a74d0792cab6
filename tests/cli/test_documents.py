"""Commands, links, names and files that the documents show are there, and the site builds for use from the disk."""

import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from document_helpers import DOCS, PAGES, README, ROOT, commands, slug
from helpers import environment
from mpipic.cli import app
from mpipic.errors import Refused
from mpipic.scene.records import Scene
from mpipic.study.file import load

OWN = {"setup", "test", "docs", "--help"}
"""Verbs of ./run itself."""
VERBS = typer.main.get_command(app).commands


def problem_of(words: list[str]) -> str | None:
    """What is wrong with a command; None if nothing is."""
    verb, *arguments = [word for word in words if word != "..."]
    if verb in OWN:
        return None
    if verb == "exec":
        script = next((word for word in arguments if word.startswith("benchmarks/")), None)
        return None if script is None or (ROOT / script).exists() else f"there is no {script}"
    if verb not in VERBS:
        return f"there is no verb {verb}"
    if any(word.endswith("=...") for word in arguments):
        arguments = arguments[: arguments.index("--set")]
    try:
        given = VERBS[verb].make_context(verb, arguments, resilient_parsing=False).params
        scene, study = given.get("scene"), given.get("file")
        if study and study.name != "STUDY":
            load(ROOT / study)
        elif "set_" in given and (scene is None or "configs" in scene.parts):
            Scene.load(scene and ROOT / scene, given["set_"] or (), given.get("preset"))
    except Refused as error:
        return str(error)
    except Exception as error:
        if not hasattr(error, "exit_code"):  # what the command line refuses has one
            raise
        return repr(error)
    return None


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_command_is_one_that_the_program_takes(page):
    wrong = {" ".join(words): problem for words in commands(page) if (problem := problem_of(words))}
    wrong.pop("run --set filter.kind=locl --set grid.cells=[0] --set gas.flw=1", None)  # shown as wrong
    assert not wrong


def test_commands_are_found_and_wrong_ones_seen():
    assert len(commands(README)) > 6 and sum(len(commands(page)) for page in PAGES) > 60
    for wrong in (["rnu"], ["run", "--st", "a=1"], ["run", "configs/no.toml"], ["run", "--set", "filter.kind=locl"]):
        assert problem_of(wrong), wrong


def anchors(page: Path) -> set[str]:
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    return {slug(heading) for heading in re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE)}


def test_every_link_leads_somewhere():
    count = 0
    for page in PAGES:
        for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
            path, _, anchor = target.partition("#")
            aim = (page.parent / path).resolve() if path else page
            assert aim.exists(), f"{page.name}: {target}"
            assert not anchor or anchor in anchors(aim), f"{page.name}: {target}"
            count += 1
    assert count > 50


def test_every_file_and_name_in_the_program_is_there():
    count = 0
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for name in re.findall(r"\b(?:configs|docs|src/mpipic|tests|benchmarks)/[\w./-]*\w", text):
            assert (ROOT / name).exists(), f"{page.name}: {name}"
            count += 1
        for name in re.findall(r"`(mpipic(?:\.\w+)+)`", text):
            assert exists(name), f"{page.name}: {name}"
            count += 1
    assert count > 60


def exists(dotted: str) -> bool:
    words = dotted.split(".")
    for k in range(len(words), 0, -1):
        try:
            found = importlib.import_module(".".join(words[:k]))
        except ModuleNotFoundError:
            continue
        for word in words[k:]:
            if not hasattr(found, word):
                return False
            found = getattr(found, word)
        return True
    return False


def test_the_site_builds_without_a_warning_and_needs_no_network(tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    variables = environment(NO_MKDOCS_2_WARNING="1")
    built = subprocess.run(command, cwd=ROOT, env=variables, capture_output=True, text=True, timeout=120)
    assert built.returncode == 0 and "WARNING" not in built.stderr, built.stderr
    pages = {page.stem: page.read_text(encoding="utf-8") for page in (tmp_path / "site").glob("*.html")}
    assert {page.stem for page in DOCS.glob("*.md")} <= set(pages)
    for name, text in pages.items():
        fetched = re.findall(r"<(?:script|img|link|iframe)[^>]*(?:src|href)=\"?((?:https?:)?//[^\s\">]+)", text)
        assert not fetched, name
    assert "Mapping.adjoint_gradient" in pages["api"] and "Raises" in pages["api"]
    assert "penalty_order" in next((tmp_path / "site" / "search").glob("search_index.js*")).read_text(encoding="utf-8")
