"""One picture of what the diagnosis told in the benchmark's cases, over what was hidden in them.

    python -m benchmarks.diagnosis_picture PICTURE.svg "registered, 1 mm=A.jsonl,B.jsonl" "clouds=C.jsonl" ...

A row for each hidden effect, a column for each set of results; a dot for each case in which just the right effect was
named: its number over the hidden one, with the interval of 95 %, red where that misses. Of a vector the part along the
hidden one is shown. A cross stands at the left for each case in which it was not named, or something beside it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np
import tyro

from benchmarks.diagnosis import key, right, rows
from caphy.challenge.hidden import ONE
from caphy.io.places import write_text

LOW, HIGH = 0.25, 1.75
"""Ends of each column's axis: told over hidden."""
WITHIN = 0.25
"""The band in which a number should be."""
_LABELS, _WIDTH, _GAP, _LINE, _TOP, _BOTTOM = 178, 170, 22, 25, 34, 44
_STYLE = """
text { font: 12px system-ui, sans-serif; fill: #222 } text.small { font-size: 10.5px; fill: #555 }
rect.band { fill: #e8f1ea } line.one { stroke: #7a9a80 } line.row { stroke: #ddd }
.covered { stroke: #1f5fa8; fill: #1f5fa8 } .missed { stroke: #c22f2f; fill: #c22f2f }
line.interval { stroke-width: 1.6 } path.cross { stroke: #c22f2f; stroke-width: 1.6; fill: none }
"""


@dataclass(frozen=True)
class Options:
    """What to draw."""

    picture: tyro.conf.Positional[Path]
    """SVG to write."""
    sets: tyro.conf.Positional[tuple[str, ...]]
    """TITLE=FILE.jsonl[,FILE.jsonl ...], a column each."""


@dataclass(frozen=True)
class Told:
    """A number over the hidden one, its interval, and whether that holds the truth."""

    ratio: float
    low: float
    high: float
    covered: bool


def told(row: dict) -> Iterator[Told]:
    """What a case told of each hidden number; of a vector along the hidden one, with no interval of its own."""
    numbers = row["diagnosis"]["coefficients"]
    for effect, values in row["answer"]["effects"].items():
        for name, value in values.items():
            hidden = np.asarray(value, dtype=float)
            if not hidden.any():
                continue
            found = [numbers.get(key(effect, name, place)) for place in np.ndindex(hidden.shape)]
            if None in found:
                continue
            low, middle, high = (np.array([f[end] for f in found]) for end in ("low", "value", "high"))
            covered = bool(((low <= hidden.ravel()) & (hidden.ravel() <= high)).all())
            if hidden.size > 1:
                ratio = float(middle @ hidden.ravel() / (hidden.ravel() @ hidden.ravel()))
                yield Told(ratio, ratio, ratio, covered)
            else:
                ends = sorted((low[0] / hidden.item(), high[0] / hidden.item()))
                yield Told(middle[0] / hidden.item(), ends[0], ends[1], covered)


def drawn(sets: dict[str, Sequence[dict]]) -> str:
    """The picture of columns of cases by title, as SVG."""
    singles = {title: [r for r in found if r["kind"] == "one" and "error" not in r] for title, found in sets.items()}
    effects = [name for name in ONE if any(r["hidden"] == name for found in singles.values() for r in found)]
    width = _LABELS + len(sets) * (_WIDTH + _GAP)
    base = _TOP + _LINE * len(effects)
    parts = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {base + _BOTTOM}" role="img">']
    parts.append("<title>What was told over what was hidden</title>")
    parts.append(f'<style>{_STYLE}</style><rect width="{width}" height="{base + _BOTTOM}" fill="#fff"/>')
    for number, (title, found) in enumerate(singles.items()):
        parts += _column(title, found, effects, _LABELS + number * (_WIDTH + _GAP), base)
    for number, name in enumerate(effects):
        y = _TOP + _LINE * (number + 0.5)
        parts.append(f'<text x="{_LABELS - 10}" y="{y + 4}" text-anchor="end">{escape(name.replace("_", " "))}</text>')
    said = "told / hidden, interval of 95 %; red: misses the truth; cross: not named alone"
    parts.append(f'<text class="small" x="{_LABELS}" y="{base + 36}">{said}</text></svg>')
    return "\n".join(parts) + "\n"


def _column(title: str, found: Sequence[dict], effects: Sequence[str], left: float, base: float) -> Iterator[str]:
    def x(ratio: float) -> float:
        return left + 14 + (min(max(ratio, LOW), HIGH) - LOW) / (HIGH - LOW) * (_WIDTH - 14)

    named = sum(right(row) for row in found)
    yield f'<text x="{left + 14}" y="13">{escape(title)}</text>'
    yield f'<text class="small" x="{left + 14}" y="27">{named} of {len(found)} named alone</text>'
    yield (
        f'<rect class="band" x="{x(1 - WITHIN):.1f}" y="{_TOP}" width="{x(1 + WITHIN) - x(1 - WITHIN):.1f}" '
        f'height="{base - _TOP}"/><line class="one" x1="{x(1):.1f}" x2="{x(1):.1f}" y1="{_TOP}" y2="{base}"/>'
    )
    for ratio in (0.5, 1.0, 1.5):
        yield f'<text class="small" x="{x(ratio):.1f}" y="{base + 14}" text-anchor="middle">{ratio:g}</text>'
    for number, effect in enumerate(effects):
        y = _TOP + _LINE * number
        yield f'<line class="row" x1="{left}" x2="{left + _WIDTH}" y1="{y + _LINE}" y2="{y + _LINE}"/>'
        cases = [row for row in found if row["hidden"] == effect]
        shown = [each for row in cases if right(row) for each in told(row)]
        for place, each in enumerate(shown):
            at, mark = y + _LINE * (place + 1) / (len(shown) + 1), "covered" if each.covered else "missed"
            yield (
                f'<line class="interval {mark}" x1="{x(each.low):.1f}" x2="{x(each.high):.1f}" y1="{at:.1f}" '
                f'y2="{at:.1f}"/><circle class="{mark}" cx="{x(each.ratio):.1f}" cy="{at:.1f}" r="2.4"/>'
            )
        for place in range(sum(not right(row) for row in cases)):
            cx, cy = left + 4 + 8 * place, y + _LINE / 2
            yield f'<path class="cross" d="M{cx - 3} {cy - 3}l6 6m0 -6l-6 6"/>'


def main() -> None:
    """Draw it."""
    options = tyro.cli(Options)
    sets = {}
    for each in options.sets:
        title, _, files = each.rpartition("=")
        sets[title] = [row for file in files.split(",") for row in rows(Path(file))]
    write_text(options.picture, drawn(sets))
    print(options.picture)


if __name__ == "__main__":
    main()
