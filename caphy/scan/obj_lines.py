"""OBJ files as text: vertices, faces and colours in the file's own order, and lines that any reader takes alike."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from caphy.errors import CaphyError


@dataclass(frozen=True, eq=False)
class ObjLines:
    """What an OBJ's lines say.

    vertices (V, 3), faces (F, 3) fanned from polygons' first corners, colours (V, 3) uint8 of the ``v`` lines or none;
    ``painted``: all materials in use are in files beside it; ``plain``: the same mesh with a vertex for each place and
    place in the texture that a face has a corner at, which other readers take as it is: where a vertex has two places
    in the texture they may take one between, where it is in no face none at all, and indices that count back they count
    from the file's end.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colours: np.ndarray | None
    painted: bool
    plain: str


def read_obj_lines(path: Path) -> ObjLines:
    """The lines of an OBJ.

    Raises:
        CaphyError: a vertex has no three coordinates, or a face no three corners that there are.
    """
    text = re.sub(r"\\\r?\n", " ", path.read_text(encoding="utf-8", errors="replace"))
    lists: dict[str, list[list[str]]] = {"v": [], "vt": [], "vn": []}
    faces, plain, libraries, used, split = [], [], [], set(), {}
    for number, line in enumerate(text.splitlines(), 1):
        word, *rest = line.split() or [""]
        if "#" in line and (word in lists or word == "f"):
            rest = line.split("#")[0].split()[1:]
        if word in lists:
            if word == "v" and len(rest) < 3:
                raise _wrong(path, number, "a vertex must have three coordinates", line)
            lists[word].append(rest)
            continue
        if word == "f":
            counts = [len(lists[name]) for name in ("v", "vt", "vn")]
            corners = [_forward(corner, counts) for corner in rest]
            at = [int(corner.split("/")[0]) - 1 for corner in corners]
            if len(at) < 3 or min(at) < 0:
                raise _wrong(path, number, "a face must have three corners, counted from 1", line)
            faces += [(at[0], at[k], at[k + 1]) for k in range(1, len(at) - 1)]
            rest = [_split(corner, split) for corner in corners]
        elif word == "mtllib":
            libraries.append((" ".join(rest), *rest))  # one file, whose name may have spaces, or several
        elif word == "usemtl":
            used.add(" ".join(rest))
        plain.append(" ".join((word, *rest)))
    vertices = np.array([line[:3] for line in lists["v"]], dtype=np.float64).reshape(-1, 3)
    triangles = np.array(faces, dtype=np.int64).reshape(-1, 3)
    if len(triangles) and triangles.max() >= len(vertices):
        raise CaphyError(
            f"{path}: a face refers to vertex {triangles.max() + 1}, but there are {len(vertices)}; was the file cut "
            "short? Copy or export it again"
        )
    if (most := max((texture for _, texture in split), default=0)) > len(lists["vt"]):
        raise CaphyError(
            f"{path}: a face refers to place {most} in the texture, but there are {len(lists['vt'])}; was the file cut "
            "short? Copy or export it again"
        )
    painted = bool(used) and used <= _materials(path.parent, libraries)
    heads = [f"v {' '.join(lists['v'][v - 1][:3])}" for v, _ in split]
    heads += [f"vt {' '.join(lists['vt'][t - 1]) if t else '0 0'}" for _, t in split]
    return ObjLines(vertices, triangles, _colours(lists["v"]), painted, "\n".join(heads + plain))


def _wrong(path: Path, number: int, must: str, line: str) -> CaphyError:
    return CaphyError(
        f"{path}, line {number}: {must}, got {line.strip()[:60]!r}; was the file cut short? Copy it again"
    )


def _split(corner: str, split: dict[tuple[int, int], int]) -> str:
    """A corner by the number of its vertex and place in the texture (0 for none) among those there are so far."""
    vertex, texture, *_ = (*corner.split("/"), "")
    number = split.setdefault((int(vertex), int(texture or 0)), len(split) + 1)
    return f"{number}/{number}"


def _forward(corner: str, counts: list[int]) -> str:
    """A corner whose indices count from the file's start; they may count back from its own line."""
    if "-" not in corner:
        return corner
    parts = zip(corner.split("/"), counts, strict=False)
    return "/".join(str(int(part) + 1 + count) if part.startswith("-") else part for part, count in parts)


def _colours(lines: list[list[str]]) -> np.ndarray | None:
    """Colours (V, 3) that stand behind the coordinates of all vertices, from 0 to 1 or to 255."""
    if not lines or min(map(len, lines)) < 6:
        return None
    colours = np.array([line[3:6] for line in lines], dtype=np.float64)
    return np.rint(np.clip(colours if colours.max() > 1 else 255 * colours, 0, 255)).astype(np.uint8)


def _materials(folder: Path, libraries: list[tuple[str, ...]]) -> set[str]:
    """Names of the materials in those of the libraries that are there."""
    found = set()
    for names in libraries:
        for name in dict.fromkeys(names):
            if (folder / name).is_file():
                lines = (folder / name).read_text(encoding="utf-8", errors="replace").splitlines()
                found |= {" ".join(line.split()[1:]) for line in lines if line.split()[:1] == ["newmtl"]}
    return found
