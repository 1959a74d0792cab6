"""Naming filters on the command line: `exact`, `order:5`, `chebyshev:3`, several at once separated by commas."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mpipic import parts
from mpipic.parts import A_FILTER, Part
from mpipic.scene.records import Problem, Scene, SceneError
from mpipic.wording import closest, listed

USUAL = ("local", "order:2", "order:5", "chebyshev:2", "chebyshev:5", "exact")
SLOT = "filter.kind"
SVD_WORK = 4e9
"""Nodes squared times particles up to which the singular value decomposition is a matter of seconds."""


@dataclass(frozen=True)
class Choice:
    """A filter with its settings by name, and what tables and pictures call it."""

    label: str
    kind: str
    settings: Mapping[str, Any]


def svd_is_quick(nodes: int, particles: int) -> bool:
    """Return whether the decomposition takes seconds rather than minutes."""
    return float(nodes) * float(min(nodes, particles)) * particles <= SVD_WORK


def choose(texts: Sequence[str], scene: Scene, particles: int, unfiltered: bool = False) -> list[Choice]:
    """Return the filters that `texts` name; without any, the usual ones, the scene's own, and svd where it is quick.

    `unfiltered`: whether none may be among them. What the scene says of the section [filter] holds for all, used by its
    own filter or not.

    Raises
    ------
    SceneError
        With every name that is wrong.
    """
    names = [name.strip() for text in texts for name in text.split(",") if name.strip()]
    if not names:
        svd = ["svd"] if svd_is_quick(scene.cell_count, particles) else []
        own = [] if scene.filter.kind in ("none", "svd") else [_own(scene)]
        names = list(dict.fromkeys([*USUAL, *own, *svd]))
    known = {one.key.split(".")[1]: one.value for one in scene.unused if one.key.startswith("filter.")}
    known |= scene.filter.to_dict()
    kinds = parts.choices(SLOT, scene.physics.kind)
    kinds = {kind: part for kind, part in kinds.items() if unfiltered or part.has(A_FILTER)}
    problems: list[Problem] = []
    chosen = [_parse(name, known, kinds, problems) for name in names]
    if problems:
        raise SceneError(problems)
    return [choice for choice in chosen if choice is not None]


def _own(scene: Scene) -> str:
    """Return the scene's filter as the command line names it."""
    argument = scene.part(SLOT).argument
    return f"{scene.filter.kind}:{scene.filter.to_dict()[argument]}" if argument else str(scene.filter.kind)


def _parse(
    name: str, known: Mapping[str, Any], kinds: Mapping[str, type[Part]], problems: list[Problem]
) -> Choice | None:
    kind, colon, number = name.partition(":")
    if kind not in kinds:
        numbered = [kind for kind, part in kinds.items() if part.argument]
        rest = f", with an order after {listed(numbered)}, for example {numbered[0]}:5" if numbered else ""
        problems.append(
            Problem(
                "--filters", name, f"must be one of {', '.join(kinds)}{rest}", tuple(kinds), closest(kind, tuple(kinds))
            )
        )
        return None
    part = kinds[kind]
    if colon and (part.argument is None or not number.isdecimal() or int(number) < 1):
        rule = "must have a whole number, 1 or above, after the colon" if part.argument else "takes no order"
        problems.append(Problem("--filters", name, rule))
        return None
    settings = parts.settings_of(part, {**known, part.argument: int(number)} if colon and part.argument else known)
    return Choice(f"{kind} {settings[part.argument]}" if part.argument else kind, kind, settings)
