"""How loose a garment is and how long, told by hanging it: only cloth under its own weight lies as a scan's does.

A loose shirt lies on the back and the shoulders and stands off elsewhere; a style that follows the skeleton stands off
all round by the same. Held against each other by nearest points, the style that fits best is too tight. So the style is
put on the body, worn into the pose and brought to rest by the reference solver; where the scan then has more cloth than
the hung garment, the garment is too small, and its eases grow by what makes up for that. Where the hung garment ends
lower than the scan's it is too long: how far a hem hangs depends on what holds it up and on folds on its way, which
those of a style on the skeleton know nothing of. That is done four times, for with other eases it hangs elsewhere, in
other folds by chance: what the last three times say is averaged.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import trimesh

from caphy.body.model import BodyModel
from caphy.body.surface import nearest_on_surface
from caphy.effects.cloth import Cloth
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.errors import CaphyError
from caphy.garment.families import Family, make_nearest
from caphy.garment.landmarks import Landmarks
from caphy.garment.meshing import contour
from caphy.garment.template import Garment
from caphy.garment.topology import face_normals
from caphy.io.poses import PoseSequence
from caphy.register.articulation import Figure, Placement
from caphy.register.borders import Ends
from caphy.register.chamfer import ALL_POINTS, LABELS, Target
from caphy.register.cloud import Cloud
from caphy.register.girth import Sheet, area_gains, eases_step, shown
from caphy.register.styles import GRID, cuttable, ranges
from caphy.register.template import dressed_body
from caphy.report.sight import ray_caster, visible
from caphy.scan.scan import BODY
from caphy.solve.body_motion import BodyMotion
from caphy.solve.newton import Newton
from caphy.solve.preroll import start_state
from caphy.solve.statics import drape

SCANS, ROUNDS = 3, 4
"""Scans in which a style is hung, the plainest, and how often."""
AVERAGED = 3
"""Of these times the last, whose eases and lengths are no longer on their way."""
ON_THE_WAY = 0.5
"""Time from the T-pose into a scan's pose [s]."""
EDGE_LENGTH = 0.036
"""Of the mesh that is hung [m], where the style can be cut in it: eases are no matter of small folds."""
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


def hung_style(
    style: Family,
    figure: Figure,
    targets: Sequence[Target],
    sheets: Sequence[Sheet],
    model: Model,
    progress: Progress,
    hang: Hang | None = None,
) -> Family:
    """The style with the eases and lengths with which it hangs as the scans show.

    It begins with its family's usual eases, whatever it comes with: a sleeve that is too tight shows too little to be
    widened again.

    Args:
        style: its lengths are those to begin with; what it leaves to its family stays so.
        targets: one garment in each of some scans, and where the body stands in it.
        sheets: the cloth that those scans show of it.
        model: the physics of the cloth, which tells in which folds it lies, and little of their area.
        hang: :func:`hung`, or what recalls it.

    Raises:
        CaphyError: the garment cannot be meshed, or does not hang where the scans show one.
    """
    body, eases, kind = dressed_body(figure), [name for name in SPREAD if hasattr(style, name)], targets[0].kind
    marks = Landmarks.of(body)
    most = np.array([MOST[name] for name in eases])
    spread = np.array([HELD if name == "ease" and hasattr(style, "rise") else SPREAD[name] for name in eases])
    usual = np.array([getattr(type(style), name) for name in eases])
    limits = {name: limit for name, limit in ranges(style.family, marks).items() if name != "rise"}
    limits = {name: limit for name, limit in limits.items() if getattr(style, name) is not None}
    lengths = np.array([getattr(style, name) for name in limits])
    ends = [Ends.of(target, marks) for target in targets]
    now, found = usual, []
    for number in range(ROUNDS):
        style = _with(style, [*eases, *limits], [*now, *lengths])
        (garment, cloth), hangs = _coarse(style, body, model), []
        for place, (target, sheet, end) in enumerate(zip(targets, sheets, ends, strict=True)):
            progress(f"{kind}: hung in scans", number * len(sheets) + place, ROUNDS * len(sheets))
            lies = (hang or hung)(garment, cloth, body, target.placed.placement, model)
            seen = shown(lies, garment.faces, sheet, [(target.placed.vertices, body.faces)])
            if seen.share > ENOUGH:
                hangs.append((seen, *end.beyond(Ends.of(_looked_at(lies, garment.faces, target), marks))))
        if not hangs:
            raise CaphyError(
                f"the {kind} garment does not hang where the scans show one (less than {100 * ENOUGH:.0f} % of their "
                "cloth lies over it); are the labels and the poses right?"
            )
        seen, cuffs, hems = zip(*hangs, strict=True)
        slopes = widening(style, eases, body, garment.vertices)
        parts = garment.weights[garment.faces].sum(axis=1).argmax(axis=1)  # the joint that a face follows most
        gains = area_gains(garment.vertices, garment.faces, slopes)
        now = now + eases_step(seen, gains, parts, now - usual, spread, (-now, most - now))
        steps = [_mean(cuffs if name == "sleeve" else hems) for name in limits]
        lengths = np.clip(lengths + steps, *np.array(list(limits.values())).reshape(-1, 2).T)
        found.append([*now, *lengths])
    return _with(style, [*eases, *limits], np.mean(found[-AVERAGED:], axis=0))


def _with(style: Family, names: Sequence[str], values: Sequence[float] | np.ndarray) -> Family:
    return cuttable(replace(style, **dict(zip(names, map(float, values), strict=True))))


def _mean(values: Sequence[float | None]) -> float:
    """Of those that are known; zero if none is."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else 0.0


def _looked_at(vertices: np.ndarray, faces: np.ndarray, target: Target) -> Target:
    """What scanners would see of a garment at vertices (V, 3) [m] on the body of a scan, in as many points."""
    body = target.placed.vertices, target.placed.figure.body.faces
    meshes = [(vertices, faces, LABELS[target.kind]), (*body, BODY)]
    rays, found = ray_caster((place, each) for place, each, _ in meshes), []
    for place, each, label in meshes:
        mesh = trimesh.Trimesh(place, each, process=False)
        points, of = trimesh.sample.sample_surface(mesh, ALL_POINTS, seed=0)[:2]
        normals = face_normals(place, each)[of]
        seen = visible(points, normals, rays)
        found.append((points[seen], normals[seen], np.full(seen.sum(), label)))
    return Target.of(
        Cloud(target.scan.name, *map(np.concatenate, zip(*found, strict=True))), target.placed, target.kind
    )


def _coarse(style: Family, body: BodyModel, model: Model) -> tuple[Garment, Cloth]:
    """A style in a coarse mesh that can be simulated."""
    _, garment = make_nearest(replace(style, edge_length=EDGE_LENGTH), body)
    return garment, Cloth.of(garment, model.density)


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
