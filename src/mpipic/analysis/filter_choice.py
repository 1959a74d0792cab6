"""Naming filters on the command line: `exact`, `order:5`, `chebyshev:3`, several at once separated by commas."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mpipic.scene.records import FilterSection, Problem, Scene, SceneError, available
from mpipic.scene.text import closest

WITH_ORDER = ("order", "chebyshev")
USUAL = ("local", "order:2", "order:5", "chebyshev:2", "chebyshev:5", "exact")
SVD_WORK = 4e9
"""Nodes squared times particles up to which the singular value decomposition is a matter of seconds."""


@dataclass(frozen=True)
class Choice:
    """A filter with its settings, and what tables and pictures call it."""

    label: str
    settings: FilterSection


def svd_is_quick(nodes: int, particles: int) -> bool:
    """Whether the decomposition takes seconds rather than minutes."""
    return float(nodes) * float(min(nodes, particles)) * particles <= SVD_WORK


def choose(texts: Sequence[str], scene: Scene, particles: int, unfiltered: bool = False) -> list[Choice]:
    """The filters that `texts` name; without any, the usual ones, the scene's own, and svd where it is quick.

    `unfiltered`: whether none may be among them.

    Raises
    ------
    SceneError
        With every name that is wrong.
    """
    names = [name.strip() for text in texts for name in text.split(",") if name.strip()]
    if not names:
        own = scene.filter.kind + (f":{scene.filter.order}" if scene.filter.kind in WITH_ORDER else "")
        svd = ["svd"] if svd_is_quick(scene.cell_count, particles) else []
        names = list(dict.fromkeys([*USUAL, *([] if own in ("none", "svd") else [own]), *svd]))
    problems: list[Problem] = []
    chosen = [_parse(name, scene, unfiltered, problems) for name in names]
    if problems:
        raise SceneError(problems)
    return [choice for choice in chosen if choice is not None]


def _parse(name: str, scene: Scene, unfiltered: bool, problems: list[Problem]) -> Choice | None:
    kinds = tuple(kind for kind in available("filter.kind") if kind != "none" or unfiltered)
    kind, colon, order = name.partition(":")
    if kind not in kinds:
        rule = "must be one of " + ", ".join(kinds) + ", with an order after order and chebyshev, for example order:5"
        problems.append(Problem("--filters", name, rule, kinds, closest(kind, kinds)))
        return None
    values = {**scene.filter.model_dump(), "kind": kind}
    if colon and (kind not in WITH_ORDER or not order.isdecimal() or int(order) < 1):
        rule = "takes no order" if kind not in WITH_ORDER else "must have a whole number, 1 or above, after the colon"
        problems.append(Problem("--filters", name, rule))
        return None
    if colon:
        values["order"] = int(order)
    label = f"{kind} {values['order']}" if kind in WITH_ORDER else kind
    return Choice(label, FilterSection(**values))
