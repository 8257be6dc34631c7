"""How loose a garment is, told by hanging it: only cloth under its own weight has the folds that take up its girth.

A loose shirt lies on the back and the shoulders and stands off elsewhere; a style that follows the skeleton stands off
all round by the same. Held against each other by nearest points, the style that fits best is too tight. So the style is
put on the body, worn into the pose and brought to rest by the reference solver; where the scan then has more cloth than
the hung garment, the garment is too small, and its eases grow by what makes up for that. That is done four times, for
with other eases it hangs elsewhere, in other folds by chance: what the last three times say is averaged.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from caphy.body.model import BodyModel
from caphy.body.surface import nearest_on_surface
from caphy.effects.cloth import Cloth
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.errors import CaphyError
from caphy.garment.families import Family, make
from caphy.garment.landmarks import Landmarks
from caphy.garment.meshing import contour
from caphy.garment.template import Garment
from caphy.io.poses import PoseSequence
from caphy.register.articulation import Figure, Placement
from caphy.register.girth import Sheet, area_gains, eases_step, shown
from caphy.register.styles import GRID
from caphy.register.template import dressed_body
from caphy.solve.body_motion import BodyMotion
from caphy.solve.newton import Newton
from caphy.solve.preroll import start_state
from caphy.solve.statics import drape

SCANS, ROUNDS = 3, 4
"""Scans in which a style is hung, the plainest, and how often."""
AVERAGED = 3
"""Of these times the last, whose eases are no longer on their way."""
ON_THE_WAY = 0.5
"""Time from the T-pose into a scan's pose [s]."""
EDGE_LENGTHS = (0.036, 0.033, 0.030)
"""Of the mesh that is hung [m]: eases are no matter of small folds. The first that the style can be cut in."""
SPREAD = {"ease": 0.015, "sleeve_ease": 0.010, "leg_ease": 0.015, "flare": 0.08, "taper": 0.05}
"""How far eases are from a family's usual ones [m, or metres per metre]: standard deviation over what people wear."""
HELD = 0.006
"""The same of the gap at the waist [m] of what a waistband holds."""
MOST = {"ease": 0.1, "sleeve_ease": 0.06, "leg_ease": 0.1, "flare": 0.5, "taper": 0.3}
"""Greatest value of each."""
ENOUGH = 0.3
"""Share of the area of a scan's cloth that must lie over the hung garment for the scan to count."""
NUDGE = 0.01
"""By which an ease is changed to see what it does [m, or metres per metre]."""
REST = 1e-4
"""Force on the worst vertex [N] with which cloth counts as at rest: it lies where it will within a millimetre."""
ITERATIONS = 400
"""Most iterations of the minimisation, which takes 60 to 180."""

Progress = Callable[[str, int, int], None]
Hang = Callable[[Garment, Cloth, BodyModel, Placement, Model], np.ndarray]


def hung_eases(
    style: Family,
    figure: Figure,
    placements: Sequence[Placement],
    sheets: Sequence[Sheet],
    kind: str,
    model: Model,
    progress: Progress,
    hang: Hang | None = None,
) -> Family:
    """The style with the eases with which it hangs as the scans show, whatever eases it comes with.

    It begins with its family's usual ones: a sleeve that is too tight shows too little to be widened again.

    Args:
        placements: where the body stands in each of some scans.
        sheets: the cloth that those scans show of it.
        kind: "upper" or "lower".
        model: the physics of the cloth, which tells in which folds it lies, and little of their area.
        hang: :func:`hung`, or what recalls it.

    Raises:
        CaphyError: the garment cannot be meshed, or does not hang where the scans show one.
    """
    body, names = dressed_body(figure), [name for name in SPREAD if hasattr(style, name)]
    most = np.array([MOST[name] for name in names])
    spread = np.array([HELD if name == "ease" and hasattr(style, "rise") else SPREAD[name] for name in names])
    usual = np.array([getattr(type(style), name) for name in names])
    skins = [(figure.placed(placement).vertices, body.faces) for placement in placements]
    now, found = usual, []
    for number in range(ROUNDS):
        style = replace(style, **dict(zip(names, now.tolist(), strict=True)))
        (garment, cloth), seen = _coarse(style, body, model), []
        for place, (placement, sheet, skin) in enumerate(zip(placements, sheets, skins, strict=True)):
            progress(f"{kind}: hung in scans", number * len(sheets) + place, ROUNDS * len(sheets))
            lies = (hang or hung)(garment, cloth, body, placement, model)
            seen.append(shown(lies, garment.faces, sheet, [skin]))
        seen = [each for each in seen if each.share > ENOUGH]
        if not seen:
            raise CaphyError(
                f"the {kind} garment does not hang where the scans show one (less than {100 * ENOUGH:.0f} % of their "
                "cloth lies over it); are the labels and the poses right?"
            )
        slopes = widening(style, names, body, garment.vertices)
        parts = garment.weights[garment.faces].sum(axis=1).argmax(axis=1)  # the joint that a face follows most
        gains = area_gains(garment.vertices, garment.faces, slopes)
        now = now + eases_step(seen, gains, parts, now - usual, spread, (-now, most - now))
        found.append(now)
    return replace(style, **dict(zip(names, np.mean(found[-AVERAGED:], axis=0).tolist(), strict=True)))


def _coarse(style: Family, body: BodyModel, model: Model) -> tuple[Garment, Cloth]:
    """A style in a coarse mesh that can be simulated."""
    failed: CaphyError | None = None
    for edge_length in EDGE_LENGTHS:
        try:
            garment = make(replace(style, edge_length=edge_length), body)
            return garment, Cloth.of(garment, model.density)
        except CaphyError as error:
            failed = error
    assert failed is not None
    raise failed


def hung(garment: Garment, cloth: Cloth, body: BodyModel, placement: Placement, model: Model) -> np.ndarray:
    """Where a garment comes to rest (V, 3) [m] on a body that stands still, worn into its pose from the T-pose."""
    still = PoseSequence(placement.pose[None], placement.transl[None], fps=30.0, pelvis=body.joints[0])
    motion = BodyMotion(body, still, garment)
    newton = Newton(Potential(model, cloth), tolerance=REST, max_iterations=ITERATIONS)
    start = start_state(newton, motion, ON_THE_WAY).x
    return drape(newton, start, lambda x: motion.state(0.0, x.numpy(), 1.0))[0].numpy()


def widening(style: Family, names: Sequence[str], body: BodyModel, vertices: np.ndarray) -> np.ndarray:
    """How far the surface of a style moves outwards at its vertices (V, 3) [m], per unit of each ease (V, K)."""
    marks, found = Landmarks.of(body), []
    for changed in (style, *(replace(style, **{name: getattr(style, name) + NUDGE}) for name in names)):
        cut = changed.cut(marks)
        found.append(nearest_on_surface(vertices, *contour(cut.surface, cut.low, cut.high, GRID)).distance)
    return np.stack([(found[0] - wider) / NUDGE for wider in found[1:]], axis=1)
