"""README and the pages of docs/, and what stands in them."""

import re
import shlex
from pathlib import Path

ROOT = Path(__file__).parents[1]
README, DOCS = ROOT / "README.md", ROOT / "docs"
PAGES = [README, ROOT / "CONTRIBUTING.md", *sorted(DOCS.glob("*.md"))]


def blocks(page: Path, language: str = "python") -> list[str]:
    """The fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)


def commands(page: Path) -> list[list[str]]:
    """The commands of a page, in words: indented lines and code in a line that begin with a program of ours."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    text = text.replace("\\\n", " ")
    found = re.findall(r"^    (\S.*)$", text, flags=re.MULTILINE) + re.findall(r"`([^`]+)`", text)
    ours = [line.split("  #")[0].replace("\n", " ") for line in found if "./run" in line or "mpipic" in line]
    return [words for line in ours if (words := without_launcher(shlex.split(line)))]


def without_launcher(words: list[str]) -> list[str]:
    """A command from its verb on; nothing for what is no command."""
    while words and re.fullmatch(r"[A-Z_]+=.*", words[0]):
        words = words[1:]
    if words[:1] == ["mpiexec"]:
        words = words[3:]
    if words[:3] == ["python", "-m", "mpipic"]:
        return words[3:]
    if words[:1] == ["mpipic"]:
        return words[1:]
    if words[:1] != ["./run"]:
        return []
    return words[3:] if words[1:2] == ["-n"] else words[1:]


def slug(heading: str) -> str:
    """The anchor of a heading."""
    return re.sub(r"[\s]+", "-", re.sub(r"[^\w\s-]", "", heading.lower()).strip())
