"""Whether scans can be what they say, and how to put right what they are not."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from caphy.errors import CaphyError
from caphy.scan.scan import LABEL_NAMES, UNKNOWN, Scan
from caphy.scan.scan_set import UNITS, ScanSet

SIZE: Final = (0.7, 3.0)
"""Diagonal of the box round a person [m], from crouching to jumping with arms raised."""
PERSON: Final = (1.0, 2.6)
"""The same for most poses: a unit is suggested if it leads here."""
OPEN_EDGES: Final = (0.04, 0.3)
"""Shares of edges along holes from which a scan is remarked on, and refused."""
FLOOR: Final = 0.25
"""Level area at the lowest place [m^2] that only a floor has; two feet have a fifth of that."""
UNUSED: Final = (0.01, 0.1)
"""Shares of vertices without a triangle from which a scan is remarked on, and refused."""
LEAST_CLOTH: Final = 0.03
"""Share of the surface that clothes must have."""
LIES: Final = (0.75, 0.5)
"""Height over the largest extent, of most scans and of a single one among them, below which they seem to lie."""
END, ON_ITS_HEAD, FEW = 0.1, 0.7, 3
"""Share of the height that feet and head are looked for in; footing (2.2 in the median of two people's mocap poses, 1.2
to 3.9 for most) of so many scans or more below which they seem to stand on their heads."""
AREA_SPREAD, COLOUR_OVERLAP = 0.25, 0.45
"""Difference in surface area, and overlap of colours with the rest, at which a scan seems to be of somebody else."""


@dataclass(frozen=True)
class Finding:
    """Something about one scan: what is wrong, and what to do."""

    scan: str
    message: str
    severe: bool
    """The scan cannot be used."""


def check_scan(scan: Scan) -> list[Finding]:
    """What is to be said of one scan by itself."""
    checks = (_unit, _flipped, _cut_short, _holes, _pieces, _floor, _labels, _colours)
    return [finding for check in checks if (finding := check(scan)) is not None]


def require_size(scan: Scan) -> None:
    """Raise :class:`CaphyError`, which names the scan, where it is far smaller or larger than a person."""
    if (finding := _unit(scan)) is not None:
        raise scan.error(finding.message)


def check_set(
    scans: ScanSet, say: Callable[[int, int], None] | None = None, look: Callable[[Scan], None] | None = None
) -> list[Finding]:
    """What is to be said of all scans, those that cannot be read among them; ``say`` is told scans done and total,
    ``look`` is given each scan that could be read, so that nobody need read it again."""
    findings, traits = [], []
    for index, path in enumerate(scans.files):
        try:
            scan = scans[index]
        except CaphyError as error:
            findings.append(Finding(path.stem, str(error), True))
        else:
            findings += check_scan(scan)
            traits.append(_Traits.of(scan))
            if look is not None:
                look(scan)
        if say is not None:
            say(index + 1, len(scans))
    return findings + _order(scans) + _up_axis(scans, traits) + _strangers(traits)


def _order(scans: ScanSet) -> list[Finding]:
    """A remark where poses go to scans in another order than that of the numbers in their names."""
    counted = sorted(scans.names, key=_counted)
    first = next((a for a, b in zip(scans.names, counted, strict=True) if a != b), None)
    if scans.poses is None or first is None:
        return []
    order = ", ".join(scans.names[:3])
    message = f"poses are taken for scans in the order {order} ...; write numbers in names with as many digits"
    return [Finding(first, message, False)]


def _counted(name: str) -> list[int | str]:
    """Text and numbers of a name by turns, as people sort them."""
    return [int(part) if place % 2 else part for place, part in enumerate(re.split("([0-9]+)", name))]


def usable(scans: ScanSet, findings: Sequence[Finding]) -> list[int]:
    """Numbers of the scans that nothing severe was found of.

    Raises:
        CaphyError: there are none.
    """
    refused = {finding.scan for finding in findings if finding.severe}
    kept = [i for i, name in enumerate(scans.names) if name not in refused]
    if not kept:
        first = next(finding for finding in findings if finding.severe)
        raise CaphyError(f"{scans.folder}: no scan can be used; the first: {first.scan}: {first.message}")
    return kept


def _severe(scan: Scan, message: str) -> Finding:
    return Finding(scan.name, message, True)


def _remark(scan: Scan, message: str) -> Finding:
    return Finding(scan.name, message, False)


def _unit(scan: Scan) -> Finding | None:
    size = float(np.linalg.norm(np.ptp(scan.vertices, axis=0)))
    if SIZE[0] <= size <= SIZE[1]:
        return None
    # The scale from metres to the true unit; a set that said "m" but holds millimetres measures a thousandfold.
    fitting = [unit for unit, scale in UNITS.items() if unit != "m" and PERSON[0] <= size * scale <= PERSON[1]]
    advice = f'if it said "m", try unit = "{fitting[0]}"' if fitting else "check the unit"
    return _severe(scan, f"a person must measure {SIZE[0]} to {SIZE[1]} m across, this is {size:.3g} m; {advice}")


def _flipped(scan: Scan) -> Finding | None:
    """The enclosed volume is negative where triangles are wound inward; holes hardly change its sign."""
    a, b, c = np.moveaxis(scan.vertices[scan.faces] - scan.vertices.mean(axis=0), 1, 0)
    volume = float(np.einsum("fc,fc->f", a, np.cross(b, c)).sum() / 6)
    if volume >= 0:
        return None
    return _severe(
        scan, "its triangles face inward (the enclosed volume is negative); flip its normals in a mesh editor"
    )


def _cut_short(scan: Scan) -> Finding | None:
    """An OBJ lists its triangles after its vertices, so that one cut short lacks triangles.

    Places count, not vertices: along seams of a texture some programs list a place twice, which is joined when read.
    """
    place = np.unique(scan.vertices, axis=0, return_inverse=True)[1].reshape(-1)
    share = 1 - len(np.unique(place[scan.faces])) / (place.max() + 1)
    if share < UNUSED[0]:
        return None
    said = f"{100 * share:.0f} % of its vertices belong to no triangle; was the file cut short? Copy or export it again"
    return _severe(scan, said) if share > UNUSED[1] else _remark(scan, said)


def _open_share(scan: Scan) -> float:
    edges = np.sort(np.concatenate([scan.faces[:, [0, 1]], scan.faces[:, [1, 2]], scan.faces[:, [2, 0]]]), axis=1)
    _, count = np.unique(edges[:, 0].astype(np.int64) * len(scan.vertices) + edges[:, 1], return_counts=True)
    return float((count == 1).mean())


def _holes(scan: Scan) -> Finding | None:
    share = _open_share(scan)
    if share > OPEN_EDGES[1]:
        return _severe(
            scan, f"{100 * share:.0f} % of its edges have one triangle only; merge vertices that lie on one another"
        )
    if share > OPEN_EDGES[0]:
        return _remark(scan, f"has many holes: {100 * share:.1f} % of its edges are open; they are left open")
    return None


def _pieces(scan: Scan) -> Finding | None:
    """Two bodies of like size in one scan."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    pairs = np.concatenate([scan.faces[:, :2], scan.faces[:, 1:]])
    graph = coo_matrix((np.ones(len(pairs)), tuple(pairs.T)), (len(scan.vertices),) * 2)
    _, piece = connected_components(graph, directed=False)
    size = np.sort(np.bincount(piece))[::-1]
    if len(size) > 1 and size[1] > 0.3 * size[0]:
        return _severe(
            scan, "falls into two large pieces; is another person or a thing in it? Keep the subject, cut the rest away"
        )
    return None


def _floor(scan: Scan) -> Finding | None:
    corners = scan.vertices[scan.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    low = corners[..., 1].max(axis=1) < np.quantile(scan.vertices[:, 1], 0.001) + 0.02
    level = low & (normal[:, 1] > 0.95 * np.linalg.norm(normal, axis=1))
    area = float(normal[level, 1].sum())
    if area < FLOOR:
        return None
    return _severe(scan, f"shows {area:.1f} m2 of floor; cut away what lies below the feet")


def _areas(scan: Scan) -> np.ndarray:
    a, b, c = np.moveaxis(scan.vertices[scan.faces], 1, 0)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def _labels(scan: Scan) -> Finding | None:
    if scan.labels is None:
        return None
    if (scan.labels == UNKNOWN).all():
        return _severe(scan, "its labels are empty: every vertex is unknown; make them again with 'caphy segment'")
    areas, label = _areas(scan), scan.labels[scan.faces[:, 0]]
    share = np.array([areas[label == i].sum() for i in range(len(LABEL_NAMES))]) / areas.sum()
    if share[1:].sum() < LEAST_CLOTH:
        return _severe(
            scan, f"shows no clothes: {100 * share[1:].sum():.1f} % of it is labelled upper or lower garment"
        )
    for name, part in zip(LABEL_NAMES, share, strict=True):
        if part < 0.01:
            return _remark(scan, f"shows no {name}: {100 * part:.1f} % of its surface has that label")
    return None


def _colours(scan: Scan) -> Finding | None:
    if scan.colours is not None and np.ptp(scan.colours, axis=0).any():
        return None
    colours = "no colours" if scan.colours is None else "one colour all over"
    return _remark(
        scan,
        f"has {colours}; segmentation will need labels, or a human parser that does without colour (an OBJ has them in "
        "the .mtl that it names and its pictures, a PLY in the picture that its TextureFile names: copy them beside "
        "it)",
    )


@dataclass(frozen=True, eq=False)
class _Traits:
    """What one person's scans share, whatever the pose."""

    name: str
    extent: np.ndarray
    footing: float
    """How far its lowest tenth spreads sideways, over its highest tenth: two feet for one head."""
    area: float
    colours: np.ndarray | None

    @classmethod
    def of(cls, scan: Scan) -> _Traits:
        colours = None
        if scan.colours is not None:
            place = (scan.colours // 64).astype(int) @ [16, 4, 1]
            colours = np.bincount(place, minlength=64) / len(place)
        height = (scan.vertices[:, 1] - scan.vertices[:, 1].min()) / max(float(np.ptp(scan.vertices[:, 1])), 1e-12)
        feet, head = (
            float(np.linalg.norm(scan.vertices[part][:, [0, 2]].std(axis=0)))
            for part in (height <= END, height >= 1 - END)
        )
        extent, area = np.ptp(scan.vertices, axis=0), float(_areas(scan).sum())
        return cls(scan.name, extent, feet / max(head, 1e-12), area, colours)


def _up_axis(scans: ScanSet, traits: list[_Traits]) -> list[Finding]:
    """People mostly stand, on their feet: of most scans the largest extent is upward, and the lower end spreads."""
    if not traits:
        return []
    extent = np.median([trait.extent for trait in traits], axis=0)
    if extent[1] < LIES[0] * extent.max():
        files = scans.rotation.T @ np.eye(3)[int(extent.argmax())]
        axis = "xyz"[int(np.abs(files).argmax())]
        message = f'seems to lie: its files are longest along {axis}; try up_axis = "{axis}" or "-{axis}"'
        return [Finding(trait.name, message, False) for trait in traits]
    if len(traits) >= FEW and np.median([trait.footing for trait in traits]) < ON_ITS_HEAD:
        up = scans.rotation.T @ [0, 1, 0]
        other = f"{'-' if up.sum() > 0 else ''}{'xyz'[int(np.abs(up).argmax())]}"
        message = f'seems to stand on its head: its upper end spreads like feet; try up_axis = "{other}"'
        return [Finding(trait.name, message, False) for trait in traits]
    message = "seems to lie, and the others stand; is its up axis another? Turn it, or move it to a folder of its own"
    return [Finding(t.name, message, False) for t in traits if t.extent[1] < LIES[1] * t.extent.max()]


def _strangers(traits: list[_Traits]) -> list[Finding]:
    """Scans whose area or colours differ from the rest's; needs four scans to say who is the stranger."""
    if len(traits) < 4:
        return []
    area = float(np.median([trait.area for trait in traits]))
    found = [
        Finding(t.name, f"its surface is {t.area:.2f} m2, the others' about {area:.2f}; is it another person?", False)
        for t in traits
        if abs(t.area / area - 1) > AREA_SPREAD
    ]
    coloured = [trait for trait in traits if trait.colours is not None]
    if len(coloured) < 4:
        return found
    common = np.median([trait.colours for trait in coloured if trait.colours is not None], axis=0)
    common = common / max(common.sum(), 1e-12)
    for trait in coloured:
        overlap = float(np.minimum(trait.colours, common).sum()) if trait.colours is not None else 1.0
        if overlap < COLOUR_OVERLAP:
            message = (
                f"shares only {100 * overlap:.0f} % of its colours with the others; is it another person, or dressed "
                "differently? Move it to a folder of its own"
            )
            found.append(Finding(trait.name, message, True))
    return found
