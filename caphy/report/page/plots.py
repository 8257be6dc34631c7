"""Small plots as inline SVG; colours come from the page's style sheet."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from html import escape

import numpy as np

WIDTH, HEIGHT = 420, 230
LEFT, RIGHT, TOP, BOTTOM = 44, 12, 14, 38
_LABEL = 70  # width of "explained", and what stands beside it

Value = float | None


def _ticks(low: float, high: float, about: int = 5) -> list[float]:
    span = max(high - low, 1e-12)
    raw = span / about
    power = 10.0 ** np.floor(np.log10(raw))
    step = next(power * s for s in (1, 2, 5, 10) if power * s >= raw)
    return [float(round(t, 10)) + 0.0 for t in np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step]


def _scale(low: float, high: float, start: float, stop: float) -> Callable[[float], float]:
    span = max(high - low, 1e-12)
    return lambda value: start + (value - low) / span * (stop - start)


def _frame(title: str, x_label: str, y_label: str, body: str, attributes: str = "") -> str:
    middle = (LEFT + WIDTH - RIGHT) / 2
    return (
        f'<svg class="plot" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title, True)}" {attributes}>'
        f"<title>{escape(title)}</title>{body}"
        f'<text x="{middle:.0f}" y="{HEIGHT - 5}" text-anchor="middle">{escape(x_label)}</text>'
        f'<text x="4" y="10" class="axis">{escape(y_label)}</text></svg>'
    )


def _y_axis(y: Callable[[float], float], high: float) -> str:
    parts = []
    for tick in _ticks(0, high, 4):
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y(tick):.1f}" y2="{y(tick):.1f}"/>')
        parts.append(f'<text x="{LEFT - 5}" y="{y(tick) + 4:.1f}" text-anchor="end">{tick:g}</text>')
    return "".join(parts)


def _x_axis(x: Callable[[float], float], low: float, high: float) -> str:
    base = HEIGHT - BOTTOM
    return "".join(
        f'<line class="tick" x1="{x(t):.1f}" x2="{x(t):.1f}" y1="{base}" y2="{base + 4}"/>'
        f'<text x="{x(t):.1f}" y="{base + 16}" text-anchor="middle">{t:g}</text>'
        for t in _ticks(low, high)
    )


def _path(xs: Sequence[float], ys: Sequence[Value], breaks: Sequence[bool]) -> str:
    """An SVG path that is broken at holes and where told; "h0" makes what stands alone a dot."""
    runs: list[list[str]] = [[]]
    for x, y, broken in zip(xs, ys, breaks, strict=True):
        if broken or y is None:
            runs.append([])
        if y is not None:
            runs[-1].append(f"{x:.1f} {y:.1f}")
    return "".join(f"M{'L'.join(run)}" + "h0" * (len(run) == 1) for run in runs if run)


def time_plot(
    frames: Sequence[int],
    lines: dict[str, Sequence[Value]],
    groups: Sequence[int],
    floor: Value,
    numbering: tuple[int, int] = (0, 1),
) -> str:
    """Errors [mm] over frames; lines break between ``groups``; ``floor`` [mm] is drawn across. ``numbering``: number of
    frame 0 in the source, and by how much the next one's is larger."""
    known = [v for values in lines.values() for v in values if v is not None]
    high = 1.08 * max([*known, floor or 0, 1e-3])
    last = frames[-1] if frames[-1] > frames[0] else frames[0] + 1
    x, y = _scale(frames[0], last, LEFT, WIDTH - RIGHT), _scale(0, high, HEIGHT - BOTTOM, TOP)
    new = [i == 0 or groups[i] != groups[i - 1] for i in range(len(frames))]
    begins, ends = (numbering[0] + numbering[1] * each for each in (frames[0], last))
    body = _y_axis(y, high) + _x_axis(_scale(begins, ends, LEFT, WIDTH - RIGHT), begins, ends)
    for number, (name, values) in enumerate(lines.items()):
        heights = [None if v is None else y(v) for v in values]
        path = _path([x(f) for f in frames], heights, new)
        body += f'<path class="line line{number}" d="{path}"/>'
        if alone := "".join(re.findall(r"M[\d. ]+h0", path)):
            body += f'<path class="line line{number} alone" d="{alone}"/>'
        body += f'<text class="legend line{number}" x="{LEFT + 60 + 96 * number}" y="10">{escape(name)}</text>'
    body += _floor(y, floor)
    body += f'<line class="cursor" x1="{LEFT}" x2="{LEFT}" y1="{TOP}" y2="{HEIGHT - BOTTOM}"/>'
    data = f'data-first="{frames[0]}" data-last="{last}" data-left="{LEFT}" data-right="{WIDTH - RIGHT}"'
    return _frame("Error over time", "frame", "mm", body, data)


def _floor(y: Callable[[float], float], floor: Value) -> str:
    if not floor:
        return ""
    height = y(floor)
    return (
        f'<line class="floor" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{height:.1f}" y2="{height:.1f}"/>'
        f'<text class="floor" x="{WIDTH - RIGHT}" y="{height - 4:.1f}" text-anchor="end">explained</text>'
    )


def bar_plot(
    title: str,
    rows: Sequence[tuple[str, Value, Value]],
    floor: Value,
    label: str = "mm: median, line to 95 %",
) -> str:
    """Horizontal bars with a whisker each, by default of medians [mm] and 95th percentiles: (name, bar, whisker)."""
    line, gap = 24, 10
    left = max(132, 14 + round(6.6 * max((len(name) for name, _, _ in rows), default=0)))  # the longest name fits
    height = gap + line * len(rows) + 34
    high = 1.05 * max([max(m or 0, p or 0) for _, m, p in rows] + [floor or 0, 1e-3])
    x = _scale(0, high, left, WIDTH - RIGHT)
    body, base = "", gap + line * len(rows)
    for tick in _ticks(0, high, 4):
        body += f'<line class="grid" x1="{x(tick):.1f}" x2="{x(tick):.1f}" y1="{gap - 4}" y2="{base}"/>'
        body += f'<text x="{x(tick):.1f}" y="{base + 14}" text-anchor="middle">{tick:g}</text>'
    for i, (name, middle, p95) in enumerate(rows):
        top = gap + i * line
        body += f'<text x="{left - 7}" y="{top + 15}" text-anchor="end">{escape(name)}</text>'
        if middle is None or p95 is None:
            continue
        centre = top + 11
        body += f'<line class="whisker" x1="{x(0):.1f}" x2="{x(p95):.1f}" y1="{centre}" y2="{centre}"/>'
        body += f'<rect class="bar" x="{x(0):.1f}" y="{top + 4}" width="{max(x(middle) - x(0), 1):.1f}" height="14"/>'
    if floor:
        body += f'<line class="floor" x1="{x(floor):.1f}" x2="{x(floor):.1f}" y1="{gap - 6}" y2="{base}"/>'
        beside = (x(floor) + 3, "start") if x(floor) < WIDTH - _LABEL else (x(floor) - 3, "end")
        body += f'<text class="floor" x="{beside[0]:.1f}" y="9" text-anchor="{beside[1]}">explained</text>'
    return (
        f'<svg class="plot" viewBox="0 0 {WIDTH} {height}" role="img" aria-label="{escape(title, True)}">'
        f"<title>{escape(title)}</title>{body}"
        f'<text x="{(left + WIDTH) / 2:.0f}" y="{height - 4}" text-anchor="middle">{escape(label)}</text>'
        "</svg>"
    )


def step_plot(title: str, x_label: str, bins: Sequence[dict], floor: Value) -> str:
    """Median error [mm] in bins of a covariate (low, high, median_mm, p95_mm)."""
    rows = [row for row in bins if row["median_mm"] is not None]
    low, top = rows[0]["low"], rows[-1]["high"]
    # The outermost bins reach far out in a long tail: draw them no wider than all the others together.
    if len(rows) > 2:
        inner = rows[-1]["low"] - rows[0]["high"]
        low, top = max(low, rows[0]["high"] - inner), min(top, rows[-1]["low"] + inner)
    high = 1.08 * max([row["median_mm"] for row in rows] + [floor or 0, 1e-3])
    x, y = _scale(low, top, LEFT, WIDTH - RIGHT), _scale(0, high, HEIGHT - BOTTOM, TOP)
    body = _y_axis(y, high) + _x_axis(x, low, top)
    for row in rows:
        left, right = x(max(row["low"], low)), x(min(row["high"], top))
        height = y(row["median_mm"])
        body += (
            f'<rect class="bar" x="{left + 0.5:.1f}" y="{height:.1f}" width="{max(right - left - 1, 1):.1f}" '
            f'height="{HEIGHT - BOTTOM - height:.1f}"><title>{row["low"]:.3g} to {row["high"]:.3g}: '
            f"{row['median_mm']:.2f} mm</title></rect>"
        )
    return _frame(title, x_label, "mm (median)", body + _floor(y, floor))


def lag_plot(rows: Sequence[dict], floor: Value) -> str:
    """Median error [mm] against frames since the restart."""
    known = [row for row in rows if row["median_mm"] is not None]
    last = max([2, *(row["lag"] for row in known)])
    high = 1.08 * max([row["median_mm"] for row in known] + [floor or 0, 1e-3])
    x, y = _scale(0, last, LEFT, WIDTH - RIGHT), _scale(0, high, HEIGHT - BOTTOM, TOP)
    body = _y_axis(y, high) + _x_axis(x, 0, last)
    heights: list[Value] = [y(row["median_mm"]) for row in known]
    body += f'<path class="line line0" d="{_path([x(r["lag"]) for r in known], heights, [False] * len(known))}"/>'
    body += "".join(f'<circle class="dot" cx="{x(r["lag"]):.1f}" cy="{y(r["median_mm"]):.1f}" r="3"/>' for r in known)
    return _frame("Error after a restart", "frames since the restart", "mm (median)", body + _floor(y, floor))


def curve_plot(title: str, rows: Sequence[dict]) -> str:
    """Force per width [N/m] against axial strain: measured loadings (the first one dashed) and the model."""
    right = max(row["largest_strain"] for row in rows)
    high = 1.08 * max(row["largest_force_n_per_m"] for row in rows)
    x, y = _scale(0, 100 * right, LEFT, WIDTH - RIGHT), _scale(0, high, HEIGHT - BOTTOM, TOP)
    body = _y_axis(y, high) + _x_axis(x, 0, 100 * right)
    for row in sorted(rows, key=lambda row: row["loading"]):
        measured = row["measured"]
        first = " first" if row["loading"] == 1 else ""
        body += f'<path class="line line1{first}" d="{_curve(x, y, measured["axial"], measured["force"], high)}"/>'
    said = max(rows, key=lambda row: row["largest_strain"])["model"]
    body += f'<path class="line line0" d="{_curve(x, y, said["axial"], said["force"], high)}"/>'
    body += f'<text class="legend line1" x="{LEFT + 60}" y="10">measured</text>'
    body += f'<text class="legend line0" x="{LEFT + 140}" y="10">model</text>'
    return _frame(title, "axial strain [%]", "N/m", body)


def tensile_plot(row: dict) -> str:
    """Measured loadings (the first one dashed) and the models with parameters refitted and with effects added."""
    right = 100 * row["axial"][-1]
    high = 1.08 * max(max(loading["force"]) for loading in row["measured"])
    x, y = _scale(0, right, LEFT, WIDTH - RIGHT), _scale(0, high, HEIGHT - BOTTOM, TOP)
    body = _y_axis(y, high) + _x_axis(x, 0, right)
    for loading in row["measured"]:
        first = " first" if loading["loading"] == 1 else ""
        body += f'<path class="line line1{first}" d="{_curve(x, y, loading["axial"], loading["force"], high)}"/>'
    for number, stage in ((2, "parameters"), (0, "with effects")):
        curves = row["models"][stage]
        for state in curves:
            first = " first" if state == "first" and len(curves) > 1 else ""
            path = _curve(x, y, row["axial"], curves[state]["force"], high)
            body += f'<path class="line line{number}{first}" d="{path}"/>'
    for number, at, name in ((1, 40, "measured"), (2, 116, "parameters only"), (0, 238, "with effects")):
        body += f'<text class="legend line{number}" x="{LEFT + at}" y="10">{name}</text>'
    return _frame(f"Force of {row['fabric'].replace('_', ' ')}, {row['direction']}", "axial strain [%]", "N/m", body)


def _curve(
    x: Callable[[float], float],
    y: Callable[[float], float],
    strain: Sequence[float],
    force: Sequence[float],
    high: float,
) -> str:
    """A path that ends where it leaves the plot."""
    heights: list[Value] = [y(f) if f <= high else None for f in force]
    return _path([x(100 * s) for s in strain], heights, [False] * len(heights))
