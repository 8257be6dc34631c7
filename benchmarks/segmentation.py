"""How many vertices of rig scans get the right label, by parser.

    python -m benchmarks.segmentation SESSION [--scans N]

SESSION is what ``caphy capture-sim`` wrote. The flawed parser knows the truth, but on a tenth of the pixels, in blots,
it says something else, and its borders are blurred and waver.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from time import process_time

import numpy as np
import tyro

from caphy.scan.colour_model import ColourModel
from caphy.scan.scan import LABEL_NAMES, UNKNOWN
from caphy.scan.scan_set import ScanSet
from caphy.scan.segmentation import smoothed_labels, votes
from caphy.scan.views import ScanView, scan_views

WRONG = 0.10
"""Share of the person's pixels that the flawed parser gets wrong, besides its blurred borders."""
BLOT = 5.0
"""Size of its blots [pixels]."""
BLUR = 3.0
"""Standard deviation of the blur of its borders [pixels]."""


class FlawedParser:
    """A parser that knows the truth (V,), blurs it, and errs in blots."""

    def __init__(self, truth: np.ndarray, seed: int, wrong: float = WRONG, blur: float = BLUR) -> None:
        self.truth, self.random, self.wrong, self.blur = truth, np.random.default_rng(seed), wrong, blur
        self.pixels = self.errors = 0

    def parse(self, view: ScanView) -> np.ndarray:
        """Labels (H, W), flawed."""
        import cv2

        true = np.full(view.face.shape, UNKNOWN, dtype=np.uint8)
        true[view.hit] = self.truth[view.nearest_vertex]
        shares = [cv2.GaussianBlur((true == i).astype(np.float32), (0, 0), self.blur) for i in range(len(LABEL_NAMES))]
        # Soft borders drawn with a wavering hand: the largest share, plus a smooth random field, wins.
        waver = [0.35 * _field(self.random, true.shape, 2 * BLOT) for _ in shares]
        said = np.argmax([share + wave for share, wave in zip(shares, waver, strict=True)], axis=0)
        said = np.where(np.max(shares, axis=0) > 0.85, np.argmax(shares, axis=0), said).astype(np.uint8)
        blots = _field(self.random, true.shape, BLOT)
        inside = view.hit
        wrong = inside & (blots > np.quantile(blots[inside], 1 - self.wrong))
        other = (said + 1 + (_field(self.random, true.shape, BLOT) > 0)) % len(LABEL_NAMES)
        said = np.where(wrong, other, said).astype(np.uint8)
        self.pixels += int(inside.sum())
        self.errors += int((said != true)[inside].sum())
        return np.where(inside, said, UNKNOWN).astype(np.uint8)


def _field(random: np.random.Generator, shape: tuple[int, ...], width: float) -> np.ndarray:
    """A smooth random field of unit spread."""
    import cv2

    field = cv2.GaussianBlur(random.normal(size=shape).astype(np.float32), (0, 0), width)
    return field / field.std()


@dataclass(frozen=True)
class Options:
    """What to look at."""

    session: tyro.conf.Positional[Path]
    """What 'caphy capture-sim' wrote."""
    scans: int | None = None
    """How many of its scans; all unless given."""


def main(options: Options) -> None:
    """Print the accuracy of each parser over the scans of a session."""
    session, scans = options.session, ScanSet.read(options.session / "scans")
    used = range(len(scans))[: options.scans]
    colour = ColourModel.fit([scans[i] for i in used])
    rows, seconds = [], []
    for index in used:
        scan = scans[index]
        with np.load(session / "truth" / "stills" / f"{scan.name}.npz") as still:
            truth = still["labels"]
        parser = FlawedParser(truth, seed=index)
        started = process_time()
        count = votes(scan, parser, scan_views(scan))
        voted = smoothed_labels(scan, count)
        seconds.append(process_time() - started)
        coloured = smoothed_labels(scan, colour.votes(scan))
        rows.append(
            [1 - parser.errors / parser.pixels, *((x == truth).mean() for x in (count.argmax(axis=1), voted, coloured))]
        )
        print(f"{scan.name}: " + ", ".join(f"{100 * value:.1f} %" for value in rows[-1]), flush=True)
    names = ("pixels of the flawed parser", "its votes", "its votes, smoothed", "colour model")
    for name, values in zip(names, np.array(rows).T, strict=True):
        print(f"{name}: right on {100 * values.mean():.2f} % (worst scan {100 * values.min():.2f} %)")
    print(f"{np.mean(seconds):.1f} s of processor time a scan for views, votes and smoothing")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
