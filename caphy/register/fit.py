"""Body under clothing for a whole set of scans: one shape, one displacement, a pose for each scan; resumable."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np

from caphy.body.model import BodyModel
from caphy.body.surface import Surface
from caphy.errors import CaphyError
from caphy.register.articulation import Figure, Placement
from caphy.register.cloud import Cloud
from caphy.register.prior import PosePrior
from caphy.register.rounds import ROUNDS, SKIN_POINTS, State, Wearer, run_round
from caphy.register.starts import FirstFit, first_fit
from caphy.register.store import Store

LOST = 0.10
"""Share of unexplained points above which a scan is left out."""
FEWEST = 10
"""Points of skin, and of cloth, that a fit must see."""
ANOTHER = 0.010
"""Mean distance of skin from the shared body [m] above which a scan shows somebody else, or wrong labels."""

Progress = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is done, and how much there is."""


@dataclass(frozen=True, eq=False)
class Taken:
    """A scan to be fitted."""

    cloud: Cloud
    start: Placement | None = None
    """An estimate of its pose, or none."""


@dataclass(frozen=True, eq=False)
class BodyFit:
    """The body under the clothes of a set of scans."""

    figure: Figure
    names: tuple[str, ...]
    placements: tuple[Placement, ...]
    figures: tuple[ScanFigures, ...]
    failures: dict[str, str]
    """Scans left out, and why."""

    def vertices(self, index: int) -> np.ndarray:
        """The body (V, 3) [m] in scan ``index``."""
        return self.figure.placed(self.placements[index]).vertices


@dataclass(frozen=True)
class ScanFigures:
    """How well the body lies in one scan; lengths in metres."""

    skin_mean: float
    """Mean distance of skin points from the body."""
    outside: float
    """Share of cloth points with the body more than 2 mm outside."""
    deepest: float
    """The farthest the body comes out (99.9 % of the cloth points)."""


def quiet(_what: str, _done: int, _total: int) -> None:
    """No progress."""


def fit_bodies(
    body: BodyModel, taken: Iterable[Taken], store: Store | None = None, progress: Progress = quiet
) -> BodyFit:
    """Shape, displacement and poses of ``body`` in scans.

    Scans that show somebody else are left out, and the rest is fitted again without them.

    Args:
        taken: scans of one person.
        store: where to keep what is done, so that a run that was stopped goes on from there.
        progress: told how far things are.

    Raises:
        CaphyError: not a single scan could be fitted; the message says why for each.
    """
    scans, store = list(taken), store or Store(None)
    surface, failures = Surface.of(body.faces, body.v_template), {}
    firsts = _first_fits(body, surface, scans, store, progress, failures)
    again = 0
    while True:
        wearers, state = _joined(body, scans, firsts)
        state = _rounds(state, wearers, surface, store, progress, again)
        names = tuple(wearer.skin_cloud.name for wearer in wearers)
        found = tuple(
            scan_figures(state.figure, p, w.skin_cloud, surface) for p, w in zip(state.placements, wearers, strict=True)
        )
        strangers = _strangers(names, found)
        if not strangers:
            return BodyFit(state.figure, names, state.placements, found, failures)
        failures.update(strangers)
        firsts = {i: first for i, first in firsts.items() if scans[i].cloud.name not in strangers}
        if not firsts:
            raise CaphyError(_all_failed(failures))
        again += 1  # the shape, the skin and all poses have given way to the strangers


def scan_figures(figure: Figure, placement: Placement, cloud: Cloud, surface: Surface) -> ScanFigures:
    """How well a placed figure lies in a cloud."""
    distance = surface.nearest(cloud.points, figure.placed(placement).vertices).distance
    out = -distance[~cloud.skin]
    return ScanFigures(
        skin_mean=float(np.abs(distance[cloud.skin]).mean()),
        outside=float((out > 0.002).mean()),
        deepest=float(np.quantile(out, 0.999)),
    )


def _first_fits(
    body: BodyModel,
    surface: Surface,
    scans: Sequence[Taken],
    store: Store,
    progress: Progress,
    failures: dict[str, str],
) -> dict[int, FirstFit]:
    """First fits by the scan's number; what cannot be fitted goes into ``failures``."""
    figure, found, known = Figure.of(body), {}, store.key(body)
    for i, scan in enumerate(scans):
        progress("first poses", i, len(scans))
        if few := _too_few(scan.cloud):
            failures[scan.cloud.name] = few
            continue
        key = store.key(known, scan.cloud, scan.start)
        kept = store.first(scan.cloud.name, key)
        if kept is None:
            kept = first_fit(figure, surface, scan.cloud, scan.start)
            store.keep_first(scan.cloud.name, key, kept)
        if kept.unexplained > LOST:
            failures[scan.cloud.name] = _lost(scan.cloud.name, kept)
        else:
            found[i] = kept
    if not found:
        raise CaphyError(_all_failed(failures))
    return found


def _too_few(cloud: Cloud) -> str:
    """That of all a scan's points that are fitted to next to none are skin, or cloth, in words; else empty."""
    thin = cloud.thinned(SKIN_POINTS)
    counts = {"skin": int(thin.skin.sum()), "cloth": int((~thin.skin).sum())}
    kind = min(counts, key=lambda kind: counts[kind])
    if counts[kind] >= FEWEST:
        return ""
    return (
        f"{cloud.name}: of {len(thin.points)} points spread evenly over it {counts[kind]} are {kind}, must be {FEWEST} "
        "or more; check its labels, or leave the scan out"
    )


def _lost(name: str, first: FirstFit) -> str:
    """Why a scan cannot be used that no pose explains."""
    if first.unseen > first.far:
        return (
            f"{name}: no pose explains it: {100 * first.unseen:.0f} % of the head, forearms and feet of a body in it "
            "lie where it shows nothing; if it is cropped give the whole scan, else an initial pose (poses in "
            "scans.toml), or leave it out"
        )
    return (
        f"{name}: no pose explains it ({100 * first.far:.0f} % of it is more than 3 cm off); look at its labels and "
        "at up_axis in scans.toml, give an initial pose (poses there), or leave it out"
    )


def _strangers(names: Sequence[str], found: Sequence[ScanFigures]) -> dict[str, str]:
    """Scans that show somebody else, and why; of several the farthest off, since the body gave way to those."""
    limit = max(ANOTHER, 0.5 * (ANOTHER + max(figures.skin_mean for figures in found)))
    return {
        name: f"{name}: its skin lies {1e3 * figures.skin_mean:.0f} mm off the body that the other scans share; is it "
        "the same person, and are its labels right? Leave it out, or correct it and fit again"
        for name, figures in zip(names, found, strict=True)
        if figures.skin_mean > limit
    }


def _joined(body: BodyModel, scans: Sequence[Taken], firsts: dict[int, FirstFit]) -> tuple[list[Wearer], State]:
    """What goes into the rounds: scans with a first pose, from the middle of their shapes.

    An estimate that a plain pose beat is wrong, and says nothing of what a scan leaves open either.
    """
    wearers = []
    for i, first in firsts.items():
        start = scans[i].start if first.estimated else None
        wearers.append(Wearer.of(scans[i].cloud, PosePrior(None if start is None else start.rotations[:22])))
    betas = np.median([first.fit.betas for first in firsts.values()], axis=0)
    return wearers, State(Figure.of(body, betas), tuple(first.fit.placement for first in firsts.values()))


def _rounds(
    state: State, wearers: Sequence[Wearer], surface: Surface, store: Store, progress: Progress, again: int = 0
) -> State:
    """All rounds, run ``again`` so many times because of strangers; each time is kept beside the ones before it."""
    what = f"shape and skin, again ({again})" if again else "shape and skin"
    key = store.key(wearers, state)
    state = store.state(key, state, again) or state
    total = ROUNDS * len(wearers)
    while state.done < ROUNDS:
        ticks = count(state.done * len(wearers) + 1)
        state = run_round(state, wearers, surface, lambda t=ticks: progress(what, next(t), total))
        store.keep_state(key, state, again)
    return state


def _all_failed(failures: dict[str, str]) -> str:
    return "none of the scans could be fitted:\n" + "\n".join(f"  {message}" for message in failures.values())
