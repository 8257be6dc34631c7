"""The comparison page: one HTML file with everything inside."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from caphy.errors import CaphyError
from caphy.report.page import plots
from caphy.report.page.colours import DIVERGING, SEQUENTIAL, UNKNOWN, nice_ceiling
from caphy.report.page.tracks import Track, pack

FOLDER = Path(__file__).parent
_PLOTTED_REGIONS = 12
_RANKED = 10
_PLOTS = 8  # in sight; the others are folded away


@dataclass(frozen=True, eq=False)
class Picture:
    """A PNG with what it shows; ``row`` is where the viewer jumps when it is pressed."""

    png: bytes
    caption: str
    frame: int


@dataclass(frozen=True, eq=False)
class Section:
    """One comparison on the page: figures as in ``compare.json``, moving meshes, pictures of the worst frames."""

    figures: dict
    track: Track | None = None
    pictures: Sequence[Picture] = field(default_factory=tuple)


def comparison_page(title: str, sections: Sequence[Section], facts: dict[str, str], curves: Sequence[dict] = ()) -> str:
    """The page as text.

    Args:
        title: heading.
        sections: one per measurement.
        curves: tables of tensile tests, as in ``compare.json``.
        facts: shown at the foot: model, versions, command.

    Raises:
        CaphyError: jinja2 is not installed.
    """
    environment = _environment()
    environment.filters["percent"] = _percent
    environment.filters["mm"] = lambda value: (
        "–" if value is None else f"{value:.1f}" if value < 99.95 else f"{value:.0f}"
    )
    largest = max([s.figures["error"]["p95_mm"] or 0 for s in sections], default=1.0)
    return environment.get_template("compare.html.j2").render(
        title=title,
        sections=[_prepared(section) for section in sections],
        curves=[_prepared_curves(table) for table in curves],
        facts=facts,
        style=(FOLDER / "page.css").read_text(encoding="utf-8"),
        script=(FOLDER / "viewer.js").read_text(encoding="utf-8"),
        scale_mm=nice_ceiling(largest),
        colours={"sequential": SEQUENTIAL, "diverging": DIVERGING, "unknown": UNKNOWN},
    )


def tensile_page(title: str, document: dict, facts: dict[str, str]) -> str:
    """The page of a diagnosis or refit of tensile tests, from the figures of its JSON; raises as the other page."""
    environment = _environment()
    environment.filters["percent"] = lambda share: "–" if share is None else f"{100 * share:z.0f}"
    shown = [
        (f"{row['fabric'].replace('_', ' ')}, {row['direction']}", plots.tensile_plot(row))
        for row in document["curves"]
    ]
    return environment.get_template("tensile.html.j2").render(
        title=title,
        d=document,
        named=[[row["effect"], row["from_loading"] > 1] for row in document["found"]],
        plots=shown,
        facts=facts,
        style=(FOLDER / "page.css").read_text(encoding="utf-8"),
    )


def diagnosis_page(title: str, document: dict, pictures: Sequence[Picture], facts: dict[str, str]) -> str:
    """The page of a diagnosis, from the figures of its JSON and pictures of forces; raises as the others."""
    ranking = document["ranking"][:_RANKED]
    gains = [
        (r["explanation"].replace("_", " ").replace(".", ": "), 100 * max(r["gain"], 0), 100 * r["gain_needed"])
        for r in ranking
    ]
    flexible = [(name, 100 * max(gain, 0), 100 * max(gain, 0)) for name, gain in document["probes"].items()]
    shown = [
        ("Gain of the best explanations", "%: of the misfit; line to what it needs", gains),
        ("Gain of forces that belong to no effect", "%: of what is left in the end", flexible),
    ]
    held = document["held_out"]
    if held is not None:
        rows = zip(held["windows_before_mm"], held["windows_after_mm"], strict=True)
        windows = [(f"window {i + 1}", after, before) for i, (before, after) in enumerate(rows)]
        shown.append(("Held-out windows", "mm: median after, line to before", windows))
    return (
        _environment()
        .get_template("diagnosis.html.j2")
        .render(
            title=title,
            d=document,
            plots=[(caption, plots.bar_plot(caption, rows, None, label)) for caption, label, rows in shown],
            pictures=[_inline(picture) for picture in pictures],
            facts=facts,
            style=(FOLDER / "page.css").read_text(encoding="utf-8"),
        )
    )


def fit_page(
    title: str, document: dict, pictures: Sequence[tuple[str, str, Sequence[Picture]]], facts: dict[str, str]
) -> str:
    """The page of an avatar made of scans; raises as the others.

    Args:
        document: sentences, cautions, figures, garments, tables, left_out, notes; see ``caphy.commands.fit_report``.
        pictures: heading, note and pictures of each part.
    """
    return (
        _environment()
        .get_template("fit.html.j2")
        .render(
            title=title,
            d=document,
            pictures=[(heading, note, [_inline(picture) for picture in shown]) for heading, note, shown in pictures],
            facts=facts,
            style=(FOLDER / "page.css").read_text(encoding="utf-8") + ".wide { grid-template-columns: 1fr; }",
        )
    )


def _inline(picture: Picture) -> dict[str, str | int]:
    return {
        "src": base64.b64encode(picture.png).decode("ascii"),
        "caption": picture.caption,
        "frame": picture.frame,
    }


def _environment():
    try:
        from jinja2 import Environment, FileSystemLoader, StrictUndefined
    except ModuleNotFoundError:
        raise CaphyError("the page needs jinja2; install it with: pip install 'caphy[train]'") from None
    return Environment(
        loader=FileSystemLoader(FOLDER),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _prepared(section: Section) -> dict:
    figures, floor = section.figures, section.figures["floor"]["explained_mm"]
    scene = None if section.track is None else pack(section.track)
    shown = _plots(figures, floor)
    return {
        "figures": figures,
        "scene": None if scene is None else _script_json(scene),
        "left_out": "" if scene is None else scene["leftOut"],
        "time_plot": _time_plot(figures, floor),
        "plots": shown[:_PLOTS],
        "more_plots": shown[_PLOTS:],
        "pictures": [_inline(picture) for picture in section.pictures],
    }


def _prepared_curves(table: dict) -> dict:
    groups: dict[str, list[dict]] = {}
    for row in table["curves"]:
        groups.setdefault(f"{row['fabric'].replace('_', ' ')}, {row['direction']}", []).append(row)
    shown = [(name, plots.curve_plot(f"Force of {name}", rows)) for name, rows in groups.items()]
    return {**table, "count": len(table["curves"]), "plots": shown}


def _script_json(value: dict) -> str:
    """JSON that cannot close the script element it stands in."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _percent(share: float) -> str:
    """ "0.1", "12"; less than is shown is not nothing."""
    return "less than 0.1" if 0 < share < 0.0005 else f"{100 * share:.1f}" if share < 0.0995 else f"{100 * share:.0f}"


def _time_plot(figures: dict, floor: float | None) -> str:
    rows = figures["by_frame"]
    lines = {"median": rows["median_mm"], "95 %": rows["p95_mm"]}
    groups = rows["window"] if figures["prediction"]["restarted"] else [0] * len(rows["frame"])
    numbering = figures["measurement"].get("numbering", (0, 1))
    return plots.time_plot(rows["frame"], lines, groups, floor, tuple(numbering))


def _plots(figures: dict, floor: float | None) -> list[tuple[str, str]]:
    regions = [(r["region"].replace("_", " "), r["median_mm"], r["p95_mm"]) for r in figures["by_region"]]
    shown = [("By region", plots.bar_plot("Error by region", regions[:_PLOTTED_REGIONS], floor))]
    parts = _directions(figures["error"])
    if parts:
        shown.append(
            (
                "By direction",
                plots.bar_plot("Error by direction", parts, None, "mm: median, or mean where that is said"),
            )
        )
    if figures["by_lag"]:
        shown.append(("After a restart", plots.lag_plot(figures["by_lag"], floor)))
    for row in sorted(figures["by_covariate"], key=_importance):
        if any(b["median_mm"] is not None for b in row["bins"]):
            name = row["name"]
            label = f"{name} [{row['unit']}]"
            shown.append((f"By {name}", plots.step_plot(f"Error by {name}", label, row["bins"], floor)))
    return shown


def _importance(row: dict) -> float:
    """Covariates with the largest contrast first."""
    return -abs(row["contrast"]["difference_mm"]) if row["contrast"] else 0.0


def _directions(error: dict) -> list[tuple[str, float | None, float | None]]:
    names = {"across the surface": "normal_median_mm", "along the surface": "along_median_mm"}
    rows = [(name, error[key], error[key]) for name, key in names.items() if error[key] is not None]
    if error["down_mean_mm"] is not None:
        low = error["down_mean_mm"]
        rows.append((f"{'too low' if low > 0 else 'too high'} (mean)", abs(low), abs(low)))
    return rows
