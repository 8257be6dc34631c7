"""What a fabric's tables mean: tension against strain along both threads, bending stiffness against curvature."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

from caphy.effects.model import Model
from caphy.effects.registry import find_effect
from caphy.material.fabrics import bending_stiffness
from caphy.measure.uniaxial import held_tension
from caphy.report.page.plots import BOTTOM, HEIGHT, LEFT, RIGHT, TOP, WIDTH, _frame, _path, _scale, _x_axis, _y_axis

STRAINS = np.linspace(0.0, 0.08, 33)
"""Engineering strains of the curves."""
CURVATURES = np.linspace(0.0, 20.0, 21)
"""Of the bending curves [1/m]."""
BENDINGS = {"bending", "bending_measured", "extra_bending", "bending_anisotropy"}
"""Effects whose stiffness the bending curves show."""


def tension(model: Model, along: str) -> np.ndarray:
    """Force per width [N/m] of a strip stretched by :data:`STRAINS` along "weft" or "warp", its width held (33,)."""
    return held_tension(model, STRAINS, along)


def bending(model: Model, along: str) -> np.ndarray:
    """Bending stiffness k [N m] at :data:`CURVATURES` where the "weft" or the "warp" threads bend (21,).

    The sum over :data:`BENDINGS`.
    """

    def number(effect: str, parameter: str) -> float:
        return float(np.asarray(model.effects.get(effect, {}).get(parameter, 0.0)))

    k = number("bending", f"stiffness_{along}") + number("extra_bending", "stiffness")
    k += (1 if along == "weft" else -1) * number("bending_anisotropy", "difference")
    if "bending_measured" not in model.effects:
        return np.full(len(CURVATURES), k)
    table = np.asarray(model.effects["bending_measured"]["bending"], dtype=float)
    return k + bending_stiffness(table, np.array(np.pi / 2 if along == "weft" else 0.0), CURVATURES)


def figures(models: Mapping[str, Model]) -> list[str]:
    """Four plots as inline SVG with captions: tension and bending of each model, along weft and warp."""
    found = []
    for along in ("weft", "warp"):
        curves = {name: tension(model, along) for name, model in models.items()}
        found.append(_plot(f"Tension along the {along}", "strain [%]", "N/m", 100 * STRAINS, curves))
    for along in ("weft", "warp"):
        bent = {name: 1e6 * bending(model, along) for name, model in models.items() if BENDINGS & set(model.effects)}
        if bent:
            without = sorted({name for model in models.values() for name in _bending_left_out(model)})
            note = f", without {' and '.join(without)}" if without else ""
            found.append(_plot(f"Bending of the {along}{note}", "curvature [1/m]", "µN m", CURVATURES, bent))
    return found


def _bending_left_out(model: Model) -> set[str]:
    """Effects that bend resting cloth and that :func:`bending` does not know."""
    effects = {name: find_effect(name) for name in model.effects}
    return {name for name, effect in effects.items() if effect.element == "hinge" and not effect.needs_step} - BENDINGS


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
