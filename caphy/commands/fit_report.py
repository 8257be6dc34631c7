"""The page that ``caphy fit`` ends with: what was made of the scans, how well it fits, what was left out."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from caphy.commands.fit_pictures import all_pictures
from caphy.commands.fit_scans import CHECKED, left_out, read
from caphy.evaluate.learnt_from import TEMPLATES
from caphy.io.training_folder import MODEL

PAGE = "report.html"
UNDONE = {
    "fabric": "The fabric is the one it started from, for its fit failed:",
    "collide": "The garments may pass through each other, for fine-tuning against that failed:",
    "evaluate": "Nothing was evaluated:",
}
"""What it means that a stage failed which the avatar can do without."""
FEWEST_OF_A_CLASS = 3
"""Held-out scans of a motion class that say something of it."""
CENTIMETRES = ("sleeve", "length", "leg", "rise", "ease", "sleeve_ease", "neck_width", "neck_depth")


def write_report(run: Path) -> Path:
    """Write ``report.html`` from what the stages left in a run's folder."""
    import caphy
    from caphy.io.places import write_text
    from caphy.report.page.compose import fit_page

    source = read(run, CHECKED)["source"]
    facts = {"made by": f"caphy {caphy.__version__}", "serve it": f"caphy serve --avatars {run / 'avatar'}"}
    page = fit_page(f"{source}: from scans to an avatar", document(run), all_pictures(run), facts)
    write_text(run / PAGE, page)
    return run / PAGE


def document(run: Path) -> dict[str, Any]:
    """All that the page says."""
    evaluation = read(run, "evaluation.json")
    garments = read(run, TEMPLATES)
    reasons = left_out(run)
    return {
        "sentences": _sentences(run, evaluation, garments),
        "cautions": _cautions(run, evaluation, reasons),
        "figures": _figures(run, evaluation),
        "garments": [_garment(kind, found) for kind, found in garments.items()],
        "tables": [*_evaluation_tables(evaluation), *_parameter_tables(run), _times(run)],
        "left_out": reasons,
        "notes": {scan: why for scan, why in read(run, CHECKED)["notes"].items() if scan not in reasons},
    }


def _used(run: Path) -> list[str]:
    return list(read(run, "body.json").get("scans", {}))


def _sentences(run: Path, evaluation: Mapping[str, Any], garments: Mapping[str, Any]) -> list[str]:
    worn = " and ".join(found["garment"] for found in garments.values())
    lines = [f"{len(_used(run))} of {read(run, CHECKED)['scans']} scans became an avatar that wears {worn}."]
    avatar, template = _row(evaluation, "avatar"), _row(evaluation, "skinned template")
    if avatar is not None and template is not None:
        count = len(evaluation["scans"])
        lines.append(
            f"On {count} {'scan' if count == 1 else 'scans'} that nothing was trained on (but the body's shape is of "
            f"all scans), the avatar's clothes lie {_chamfer(avatar):.2f} mm from the scan's, those of the skinned "
            f"template {_chamfer(template):.2f} mm."
        )
    return lines


def _cautions(run: Path, evaluation: Mapping[str, Any], reasons: Mapping[str, str]) -> list[str]:
    lines = []
    if reasons:
        lines.append(f"Left out, for reasons given below: {', '.join(reasons)}.")
    absent = [row["name"] for row in evaluation.get("rows", []) if row["missing"]]
    if absent:
        lines.append(f"Rows of the paper's table that this run does not hold: {', '.join(absent)}.")
    for kind, scans in evaluation.get("templates_chosen_by_held_out", {}).items():
        lines.append(f"The template of the {kind} garment was chosen by {len(scans)} of the scans held out.")
    lines += _no_gain(evaluation)
    classes = Counter(scan["class"] for scan in evaluation.get("scans", {}).values())
    if classes and min(classes.values()) < FEWEST_OF_A_CLASS:
        lines.append("Motion classes of one or two scans say little: hold out more.")
    for name, what in UNDONE.items():
        failure = read(run / "stages", f"{name}.json").get("failure")
        if failure:
            lines.append(f"{what} {_first(failure)} (stages/{name}.log)")
    return lines


def _first(failure: str) -> str:
    """The first line of what failed, and after a colon the one that it announces."""
    first, *rest = failure.splitlines()
    return f"{first} {rest[0].strip()}" if first.endswith(":") and rest else first


def _no_gain(evaluation: Mapping[str, Any]) -> list[str]:
    """Where the avatar is farther from the scans than the template that it was trained from."""
    avatar, template = _row(evaluation, "avatar"), _row(evaluation, "skinned template")
    if avatar is None or template is None:
        return []
    ours, given = ({name: each["mean"] for name, each in row["all"].items()} for row in (avatar, template))
    worse = [
        f"the {name.removesuffix('_chamfer_mm')} garment lies {ours[name]:.2f} mm from the scans' "
        f"(template {given[name]:.2f})"
        for name in ours
        if name.endswith("_chamfer_mm") and name != "clothes_chamfer_mm" and ours[name] > given[name]
    ]
    if "perceptual" in ours and ours["perceptual"] > given["perceptual"]:
        worse.append(f"pictures differ by {ours['perceptual']:.3f} (template {given['perceptual']:.3f})")
    told = "; ".join(worse)
    return [f"Worse than the skinned template: {told}. Train for longer, or on more scans."] if worse else []


def _figures(run: Path, evaluation: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    shown = []
    for row in (_row(evaluation, "avatar"), _row(evaluation, "skinned template")):
        if row is not None:
            shown.append((f"held out: {row['name']}", f"{_chamfer(row):.2f}", "mm"))
    skin = [scan["skin_mean"] for scan in read(run, "body.json").get("scans", {}).values()]
    if skin:
        shown.append(("skin from the body", f"{1e3 * sum(skin) / len(skin):.1f}", "mm"))
    shown.append(("scans used", str(len(_used(run))), f"of {read(run, CHECKED)['scans']}"))
    shown.append(("time in all", f"{sum(_stage_seconds(run).values()) / 60:.1f}", "min"))
    return shown


def _row(evaluation: Mapping[str, Any], name: str) -> Mapping[str, Any] | None:
    return next((row for row in evaluation.get("rows", []) if row["name"] == name and row["all"]), None)


def _chamfer(row: Mapping[str, Any]) -> float:
    return row["all"]["clothes_chamfer_mm"]["mean"]


def _garment(kind: str, found: Mapping[str, Any]) -> dict[str, Any]:
    measures = [f"{name.replace('_', ' ')} {100 * found[name]:.1f}" for name in CENTIMETRES if name in found]
    return {
        "kind": kind,
        "garment": found["garment"],
        "scans": found["scans"],
        "distance_mm": 1e3 * found["distance"],
        "measures": ", ".join(measures),
    }


def _evaluation_tables(evaluation: Mapping[str, Any]) -> list[dict[str, Any]]:
    from caphy.evaluate.table import class_rows, figure_rows

    if not evaluation:
        return []
    heads, rows = figure_rows(evaluation)
    class_heads, by_class = class_rows(evaluation)
    counts = f"scans trained on: {evaluation['trained_on']}, held out: {len(evaluation['scans'])}"
    note = f"{evaluation['definition']}; {counts}"
    return [
        {"heading": "On held-out scans", "note": note, "heads": heads, "rows": rows},
        {
            "heading": "By motion class",
            "note": "Chamfer [mm]; in brackets the scans and their mean joint angle to the nearest trained pose",
            "heads": class_heads,
            "rows": by_class,
        },
    ]


def _parameter_tables(run: Path) -> list[dict[str, Any]]:
    """What each garment's cloth is made of in the networks that the avatar has; what acts on any cloth is left out."""
    from caphy.commands.fit_stages import FABRIC, final
    from caphy.effects.model import Model
    from caphy.effects.presets import WORN
    from caphy.effects.registry import find_effect

    rows: list[Sequence[str]] = []
    for folder in final(run):
        model = Model.load(folder / MODEL)
        rows.append([f"{folder.name}: density", f"{model.density:.3g}", "kg/m2"])
        for effect in [name for name in model.effects if name not in WORN]:
            units = {name: parameter.unit for name, parameter in find_effect(effect).parameters.items()}
            for name, value in model.effects[effect].items():
                rows.append([f"{folder.name}: {effect.replace('_', ' ')}, {name}", _number(value), units[name]])
    tables = [{"heading": "Cloth", "note": "as trained with", "heads": ["parameter", "value", "unit"], "rows": rows}]
    found = [
        [f"{kind}: {effect.replace('_', ' ')}", *_stiffness(row)]
        for kind, fabric in read(run, FABRIC).get("garments", {}).items()
        for effect, row in fabric["stiffness"].items()
    ]
    note = "fitted to the scans, density given; of the fabric that the fit started from"
    heads = ["stiffness", "times the start's", "95 % interval"]
    return [{"heading": "Fabric", "note": note, "heads": heads, "rows": found}, *tables] if found else tables


def _stiffness(row: Mapping[str, Any]) -> list[str]:
    if row["interval"] is None:
        return ["not determined", ""]
    low, high = row["interval"]
    return [f"{row['over_the_start']:.2f}", f"{low:.2f} to {high:.2f}"]


def _number(value: Any) -> str:
    import numpy as np

    flat = np.ravel(value)
    return f"{flat[0]:.4g}" if len(flat) == 1 else f"{len(flat)} numbers, {flat.min():.3g} to {flat.max():.3g}"


def _stage_seconds(run: Path) -> dict[str, float]:
    files = sorted((run / "stages").glob("*.json"))
    entries = {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in files}
    return {name: entry["seconds"] for name, entry in entries.items() if entry.get("finished")}


def _times(run: Path) -> dict[str, Any]:
    rows = [[name, f"{seconds:.0f} s"] for name, seconds in sorted(_stage_seconds(run).items(), key=lambda s: -s[1])]
    return {"heading": "Times", "note": "of each stage's last start", "heads": ["stage", "took"], "rows": rows}
