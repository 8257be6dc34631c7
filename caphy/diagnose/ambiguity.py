"""Which effects these measurements cannot tell apart, and what would."""

from __future__ import annotations

import numpy as np

from caphy.diagnose.groups import Group
from caphy.diagnose.search import Search, Term

ALIKE = 0.9
"""Share of an effect's response, as a cosine, that another effect can copy to count as the same."""

_APART = 0.8  # of the best that explanations were weighed by: one that reached less is out

SEPARATES = {
    frozenset(("wind", "external")): "turn the subject or the cloth by 90 degrees: wind turns with its normals, weight "
    "does not",
    frozenset(("wind", "drag")): "measure the cloth hanging still: only wind pushes it then",
    frozenset(("wind", "other")): "measure two opposite facings: pressure turns with the cloth, wind does not",
    frozenset(("drag",)): "measure the same motion at half and at double speed: linear and quadratic laws part",
    frozenset(("damping",)): "measure the same motion at half and double speed: viscosity grows, friction does not",
    frozenset(("drag", "damping")): "swing the cloth flat through the air, without folding it: only drag acts then",
    frozenset(("mass", "stiffness")): "weigh the cloth: density and stiffness cannot be told apart by motion alone",
    frozenset(("mass",)): "weigh the cloth, and its hem",
    frozenset(("stiffness",)): "pull a strip along weft, along warp and at 45 degrees",
    frozenset(("stiffness", "rest shape")): "measure the cloth lying flat without load",
    frozenset(("rest shape",)): "measure the cloth lying flat without load",
}
"""What parts effects of two families."""


def alike(found: Search, term: Term) -> list[Group]:
    """The other explanations that these measurements cannot tell from an accepted one."""
    last = found.screens[-1]
    normal, _ = last.evidence.normal
    label, change = _place(found, term, last.places)
    if label is None:
        return list(term.even)
    mine = last.places[label]
    wanted = normal[:, mine] @ change
    size = float(change @ normal[np.ix_(mine, mine)] @ change)
    most = max(term.weighed.values())
    similar = list(term.even)
    for group in last.groups:
        if group.name in (term.group.name, *(other.name for other in term.even)):
            continue
        place = last.places[group.label]
        if len(place) > len(mine) and _contains(normal, place, mine):
            continue
        inner = normal[np.ix_(place, place)] + 1e-9 * np.diag(np.diag(normal)[place]) + 1e-300 * np.eye(len(place))
        copied = float(wanted[place] @ np.linalg.solve(inner, wanted[place])) / max(size, 1e-300)
        out = group.label in term.weighed and term.weighed[group.label] < _APART * most
        if copied > ALIKE**2 and not out:
            similar.append(group)
    return similar


def _contains(normal: np.ndarray, more: list[int], fewer: list[int]) -> bool:
    """Whether some number of a larger group does the same as one of a smaller group: wind holds drag."""
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    cosine = np.abs(normal[np.ix_(more, fewer)]) / size[more][:, None] / size[fewer]
    return bool((cosine > 0.999).any())


def _place(found: Search, term: Term, places: dict[str, list[int]]) -> tuple[str | None, np.ndarray]:
    """The label under which the last screen has an accepted effect, and its total change there."""
    assert found.fit is not None
    names = [column.name for column in found.fit.columns]
    wanted = [names.index(column.name) for column in term.group.columns if column.name in names]
    for label in (f"parameters of {term.group.name}", term.group.label):
        if label in places and len(places[label]) == len(wanted):
            return label, found.fit.change[wanted]
    return None, np.zeros(0)


def advice(first: Group, second: Group) -> str:
    """The motion or measurement that would tell two explanations apart."""
    families = frozenset((first.family, second.family))
    general = "measure a motion that is unlike the ones given: other directions, other speeds, and rest"
    return SEPARATES.get(families, general)
