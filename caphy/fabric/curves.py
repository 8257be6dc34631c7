"""What a fabric's tables mean: tension against strain along both threads, bending stiffness against curvature."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np
import torch

from caphy.effects.base import Elements
from caphy.effects.membrane import Membrane
from caphy.effects.model import Model
from caphy.effects.registry import find_effect
from caphy.material.fabrics import bending_stiffness
from caphy.report.page.plots import BOTTOM, HEIGHT, LEFT, RIGHT, TOP, WIDTH, _frame, _path, _scale, _x_axis, _y_axis

STRAINS = np.linspace(0.0, 0.08, 33)
"""Engineering strains of the curves."""
CURVATURES = np.linspace(0.0, 20.0, 21)
"""Of the bending curves [1/m]."""


def tension(model: Model, along: str) -> np.ndarray:
    """Force per width [N/m] of a strip stretched by :data:`STRAINS` along "weft" or "warp", its width held (33,)."""
    name = next(name for name in ("strain_measured", "strain_stvk") if name in model.effects)
    effect = find_effect(name)
    assert isinstance(effect, Membrane)
    stretch = torch.from_numpy(1 + STRAINS)
    values = {key: torch.as_tensor(value, dtype=torch.float64) for key, value in model.effects[name].items()}
    green, zero = 0.5 * (stretch**2 - 1), torch.zeros(len(STRAINS), dtype=torch.float64)
    strain = (green, zero, zero) if along == "weft" else (zero, green, zero)
    stress, _ = effect.response(strain, Elements(torch.zeros(3, 3, len(STRAINS)), {}), values)
    return (stretch * stress[0 if along == "weft" else 1]).numpy()


def bending(model: Model, along: str) -> np.ndarray:
    """Bending stiffness k [N m] at :data:`CURVATURES` where the "weft" or the "warp" threads bend (21,)."""
    if "bending_measured" in model.effects:
        table = np.asarray(model.effects["bending_measured"]["bending"], dtype=float)
        return bending_stiffness(table, np.array(np.pi / 2 if along == "weft" else 0.0), CURVATURES)
    return np.full(len(CURVATURES), float(np.asarray(model.effects["bending"][f"stiffness_{along}"])))


def figures(models: Mapping[str, Model]) -> list[str]:
    """Four plots as inline SVG with captions: tension and bending of each model, along weft and warp."""
    found = []
    for along in ("weft", "warp"):
        curves = {name: tension(model, along) for name, model in models.items()}
        found.append(_plot(f"Tension along the {along}", "strain [%]", "N/m", 100 * STRAINS, curves))
    for along in ("weft", "warp"):
        bent = {name: 1e6 * bending(model, along) for name, model in models.items() if _bends(model)}
        if bent:
            found.append(_plot(f"Bending of the {along}", "curvature [1/m]", "µN m", CURVATURES, bent))
    return found


def _bends(model: Model) -> bool:
    return "bending_measured" in model.effects or "bending" in model.effects


def _plot(title: str, x_label: str, y_label: str, x: np.ndarray, curves: Mapping[str, np.ndarray]) -> str:
    high = 1.08 * max(1e-9, *(float(curve.max()) for curve in curves.values()))
    across, up = _scale(float(x[0]), float(x[-1]), LEFT, WIDTH - RIGHT), _scale(0, high, HEIGHT - BOTTOM, TOP)
    body = _y_axis(up, high) + _x_axis(across, float(x[0]), float(x[-1]))
    for number, (name, curve) in enumerate(curves.items()):
        path = _path([across(v) for v in x], [up(float(v)) for v in curve], [False] * len(x))
        body += f'<path class="line {STYLES[number]}" d="{path}"/>'
        body += f'<text class="legend {STYLES[number]}" x="{LEFT + 70 + 90 * number}" y="10">{escape(name)}</text>'
    return f"{_frame(title, x_label, y_label, body)}<figcaption>{title}</figcaption>"


STYLES: Sequence[str] = ("line1", "line0", "line2")


def page(plots: Mapping[str, Sequence[str]], sentences: Mapping[str, Sequence[str]]) -> str:
    """A self-contained page: for each garment what was found in words, and its plots."""
    from caphy.report.page.compose import FOLDER

    style = (FOLDER / "page.css").read_text(encoding="utf-8")
    parts = []
    for kind, figure in plots.items():
        lines = "".join(f"<p>{escape(line)}</p>" for line in sentences[kind])
        cells = "".join(f"<figure>{one}</figure>" for one in figure)
        parts.append(f'<section><h2>{escape(kind)}</h2>{lines}<div class="plots">{cells}</div></section>')
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Fabric</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{style}</style></head><body><main><h1>Fabric from scans</h1>{''.join(parts)}</main></body></html>"
    )
