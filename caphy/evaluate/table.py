"""The table as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

FIGURES = (
    ("clothes_chamfer_mm", "Chamfer [mm]", 2),
    ("mean_mm", "mean [mm]", 2),
    ("pop_1e-4_m2", "POP [1e-4 m2]", 3),
    ("upper_chamfer_mm", "upper [mm]", 2),
    ("lower_chamfer_mm", "lower [mm]", 2),
    ("perceptual", "perceptual", 4),
)
"""Key, heading and decimals of each column."""


def table_lines(document: Mapping[str, Any]) -> list[str]:
    """The evaluation of :meth:`caphy.evaluate.evaluation.Evaluation.document`, for a terminal."""
    rows = document["rows"]
    heads, cells = figure_rows(document)
    class_heads, by_class = class_rows(document)
    lines = [f"scans held out: {len(document['scans'])}, trained on: {document['trained_on']}", document["definition"]]
    lines += [f"perceptual: {document['perceptual']}"] if document["perceptual"] else []
    lines += ["", *_aligned([heads, *cells])]
    lines += ["", "Chamfer [mm] by motion class:", *_aligned([class_heads, *by_class])]
    lines += ["in brackets the scans, and the mean joint angle to the nearest trained pose"]
    absent = [f"  {row['name']}: {row['missing']}" for row in rows if row["missing"]]
    names = {row["name"] for row in rows}
    absent += [f"  {scan}: {why}" for scan, why in document["left_out"].items() if scan not in names]
    absent += [
        f"  {row['name']}, in part: {document['left_out'][row['name']]}"
        for row in rows
        if row["missing"] is None and row["name"] in document["left_out"]
    ]
    lines += ["", "not evaluated:", *absent] if absent else []
    for kind, scans in document["templates_chosen_by_held_out"].items():
        lines += [
            "",
            f"caution: {len(scans)} of the scans held out have chosen the template of the {kind} garment, so every row "
            "knows of them; choose it again with 'caphy register garments', and train on that",
        ]
    paper = ", ".join(f"{name} {a:g} / {b:g}" for name, (a, b) in document["paper_mm"].items())
    return [*lines, "", f"CaPhy's paper, two subjects of its own, for orientation [mm]: {paper}"]


def figure_rows(document: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Headings and cells of the table: a line for each row, a column for each figure that any row has.

    Where a row was not held against all scans, a column says against how many, for its means are of those alone.
    """
    done = [row for row in document["rows"] if row["all"]]
    shown = [column for column in FIGURES if any(column[0] in row["all"] for row in done)]
    told = any(_scans(row) < len(document["scans"]) for row in done)
    heads = ["", "seeds", *(["scans"] if told else []), *(heading for _, heading, _ in shown)]
    return heads, [_cells(row, shown, told) for row in document["rows"]]


def class_rows(document: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Headings and cells of the Chamfer distances [mm] by motion class, of the rows that were evaluated."""
    heads, names = [""], sorted({scan["class"] for scan in document["scans"].values()})
    for name in names:
        members = [scan for scan in document["scans"].values() if scan["class"] == name]
        degrees = sum(scan["pose_distance_degrees"] for scan in members) / len(members)
        heads.append(f"{name} ({len(members)}; {degrees:.0f} degrees)")
    rows = [row for row in document["rows"] if row["all"]]
    return heads, [
        [row["name"], *(cell(row["classes"][name].get("clothes_chamfer_mm"), row["seeds"], 2) for name in names)]
        for row in rows
    ]


def cell(figure: Mapping[str, float] | None, seeds: int, decimals: int) -> str:
    """A figure with its spread between seeds where there are several."""
    if figure is None:
        return "–"
    text = f"{figure['mean']:.{decimals}f}"
    return text if seeds < 2 else f"{text} ± {figure['spread']:.{decimals}f}"


def _scans(row: Mapping[str, Any]) -> int:
    """Against how many scans every seed of a row was held."""
    seeds = [set(scans) for scans in row["scans"].values()]
    return len(set.intersection(*seeds)) if seeds else 0


def _cells(row: Mapping[str, Any], shown: Sequence[tuple[str, str, int]], with_scans: bool) -> list[str]:
    return [
        row["name"],
        str(row["seeds"]) if row["name"] != "skinned template" else "",
        *([str(_scans(row))] if with_scans else []),
        *(cell(row["all"].get(key), row["seeds"], decimals) for key, _, decimals in shown),
    ]


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return ["  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]).rstrip() for row in rows]
