"""Supervision by scans: static windows of their poses, and how far predicted cloth lies from their points.

CaPhy, section 3.3: ``E_phys + lambda_3d E_3d`` with E_3d the two-sided squared Chamfer distance between the garment and
the scan's points of it.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from caphy.body.model import BodyModel
from caphy.body.skinning import blend_transforms, skin
from caphy.body.surface import Surface
from caphy.effects.potential import Potential
from caphy.errors import CaphyError
from caphy.io.poses import PoseSequence
from caphy.register.cloud import even_sample
from caphy.register.points import ScanPoints
from caphy.training.in_threads import in_threads
from caphy.training.motions import Motions
from caphy.training.objective import Objective, Past
from caphy.training.streams import HELD_WINDOWS, WINDOW, Windows

LAMBDA_3D = 3000.0
"""Weight of the squared distances [J/m^2]; see docs/supervised.md for how it was chosen."""
SAMPLE = 2500
"""Points of a scan's garment that are held against the cloth: spread evenly, 2 cm apart on a shirt."""
FARTHEST = 0.10
"""A point farther than this from the cloth [m] has no counterpart (a wrong label): it does not pull."""
UNSEEN = 0.03
"""Cloth farther than this from everything that the scan shows [m] was seen by no camera: it is not pulled."""
THINNED = 20_000
"""Points of a scan that are kept to tell what no camera saw: under 2 cm apart."""
LEAST_POINTS = 50
"""Points below which a scan does not show a garment."""
RANDOM_EPOCHS, SCAN_EPOCHS = 1, 4
"""Turns of random poses and of the scans' (CaPhy, section 4.1)."""


@dataclass(frozen=True, eq=False)
class Target:
    """One garment in one scan."""

    sample: np.ndarray
    """Points of it spread evenly (N, 3) [m]."""
    cloth: KDTree
    """All its points."""
    over: KDTree | None
    """Points of what is worn over it, if anything is."""
    everything: KDTree
    """Points of the whole scan, thinned."""

    @classmethod
    def of(cls, scan: ScanPoints, worn: str, over: Sequence[str]) -> Target:
        """The garment ``worn`` (a part of the scan's points) with the parts worn ``over`` it.

        Raises:
            CaphyError: the scan shows next to nothing of it.
        """
        own = getattr(scan, worn).astype(np.float64)
        if len(own) < LEAST_POINTS:
            raise CaphyError(
                f"{scan.name}: has {len(own)} points of the {worn} garment, at least {LEAST_POINTS} are needed; check "
                "its labels, or take it out of split.json"
            )
        above = [getattr(scan, part) for part in over if len(getattr(scan, part))]
        shown = np.concatenate([scan.body, scan.upper, scan.lower])
        some = np.random.default_rng(0).permutation(len(shown))[:THINNED]
        return cls(
            own[even_sample(own, SAMPLE)] if len(own) > SAMPLE else own,
            KDTree(own),
            KDTree(np.concatenate(above)) if above else None,
            KDTree(shown[some]),
        )

    def counterparts(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The point (V, 3) of the scan's garment nearest to each vertex x (V, 3), and which vertices (V,) it shows.

        It does not show what lies under another garment (a point of that is nearer), nor what no camera saw.
        """
        distance, nearest = self.cloth.query(x)
        shown = np.ones(len(x), dtype=bool)
        if self.over is not None:
            shown &= self.over.query(x, distance_upper_bound=distance.max() + 1e-9)[0] > distance
        far = np.flatnonzero(shown & (distance > UNSEEN))
        if len(far):
            shown[far] = self.everything.query(x[far], distance_upper_bound=UNSEEN)[0] < UNSEEN
        return self.cloth.data[nearest], shown


class Counterparts(NamedTuple):
    """What lies nearest to what, between cloth of V vertices and a scan's sample of N points."""

    point: np.ndarray
    """The scan's point nearest to each vertex (V, 3) [m]."""
    shown: np.ndarray
    """Whether the scan shows the vertex (V,)."""
    face: np.ndarray
    """The cloth's face nearest to each point (N,)."""
    barycentric: np.ndarray
    """Where on it (N, 3)."""


class Chamfer:
    """Two-sided squared distance between a garment and its points in scans.

    From the scan: of each of its points from the nearest point of the cloth's *surface*, which is fair to coarse
    meshes; points beyond 10 cm pull no more. From the cloth: of each vertex that the scan shows from its nearest
    point, weighted by its rest area. Both are means [m^2], so neither depends on how many points or vertices there
    are. Nearest points are exact and looked up anew each time; as their places on the surface are minima, the gradient
    is exact with them held.
    """

    def __init__(self, faces: np.ndarray, rest: np.ndarray, area: np.ndarray) -> None:
        """Faces (F, 3), rest vertices (V, 3) [m] and vertex areas (V,) [m^2] of the garment."""
        self.surface, self.area = Surface.of(faces, rest), torch.as_tensor(area, dtype=torch.float32)

    def __call__(self, x: Tensor, target: Target, found: Counterparts | None = None) -> Tensor:
        """Sum of both mean squared distances [m^2] of vertices x (V, 3), differentiable.

        ``found``: what :meth:`look` found at these vertices, if it has looked.
        """
        found = self.look(x.detach().cpu().double().numpy(), target) if found is None else found
        return self.to_points(x, found) + self.to_cloth(x, found, target)

    def look(self, x: np.ndarray, target: Target) -> Counterparts:
        """The nearest points of cloth at x (V, 3) and scan, on the CPU."""
        back = self.surface.nearest(target.sample, x)
        return Counterparts(*target.counterparts(x), np.asarray(back.face), np.asarray(back.barycentric))

    def to_points(self, x: Tensor, found: Counterparts) -> Tensor:
        """Mean squared distance of the cloth from the scan's points [m^2]."""
        weight = self.area.to(x) * torch.from_numpy(found.shown).to(x)
        square = (x - torch.from_numpy(found.point).to(x)).square().sum(-1)
        return (weight * square).sum() / weight.sum().clamp_min(1e-12)

    def to_cloth(self, x: Tensor, found: Counterparts, target: Target) -> Tensor:
        """Mean squared distance of the scan's points from the cloth [m^2]."""
        share = torch.from_numpy(found.barycentric).to(x)
        corners = x[torch.from_numpy(self.surface.faces[found.face]).to(x.device)]
        square = ((share[..., None] * corners).sum(-2) - torch.from_numpy(target.sample).to(x)).square().sum(-1)
        return square.clamp_max(FARTHEST**2).mean()


class ScanStreams:
    """Streams that hold one scan's pose after another, each for three windows from a cold start.

    An epoch shows every scan once, in an order of its own. A pure function of the seed, as
    :class:`caphy.training.streams.Streams`.
    """

    def __init__(self, scans: int, count: int, seed: int) -> None:
        self.scans, self.seed = scans, seed
        self.place = np.zeros((count, 2), dtype=np.int64)
        """Scan under way, counted on, and windows of it already played, of each stream."""

    def restore(self, place: np.ndarray) -> None:
        """Continue from a saved :attr:`place` (B, 2)."""
        self.place = place.copy()

    def advance(self) -> Windows:
        """The next window of every stream; its last frame is scored."""
        done = self.place[:, 1] == HELD_WINDOWS
        self.place[done] = np.stack([self.place[done, 0] + 1, np.zeros(done.sum(), np.int64)], 1)
        turn = self.place[:, 0] * len(self.place) + np.arange(len(self.place))
        scan = np.array([self._order(int(epoch))[slot] for epoch, slot in zip(*divmod(turn, self.scans), strict=True)])
        fresh = self.place[:, 1] == 0
        self.place[:, 1] += 1
        held = np.ones(len(scan), dtype=bool)
        return Windows(np.repeat(scan[:, None], WINDOW, 1), scan, fresh, held, np.full((len(scan), 1), WINDOW - 1))

    def _order(self, epoch: int) -> np.ndarray:
        return np.random.default_rng([self.seed, epoch, 3]).permutation(self.scans)


class ScanLoss:
    """``E_phys + lambda_3d E_3d`` of predicted cloth at rest in the scans' poses; without physics the second alone."""

    def __init__(
        self, objective: Objective, chamfer: Chamfer, targets: Sequence[Target], weight: float, physics: bool = True
    ) -> None:
        """``targets`` in the order of the motions' frames; ``weight`` is lambda_3d [J/m^2]."""
        self.objective, self.chamfer, self.targets = objective, chamfer, targets
        self.weight, self.physics = weight, physics
        self.distance = 0.0
        """Root mean square of both sides' distances in the last call [m]."""

    def judge(self, motions: Motions, windows: Windows, offsets: Tensor, past: Past) -> tuple[Tensor, Tensor, Past]:
        """Positions (B, 1, V, 3) [m] and loss (B, 1) [J] at offsets (B, 1, V, 3) in the last frame of each window."""
        x, potential = self._cloth(motions, windows, offsets)
        targets = [self.targets[scan] for scan in windows.frames[:, -1].tolist()]
        still = x[:, 0].detach().cpu().double().numpy()
        found = in_threads(lambda i: self.chamfer.look(still[i], targets[i]), len(targets))
        squares = torch.stack([self.chamfer(*each) for each in zip(x[:, 0], targets, found, strict=True)])
        self.distance = float((0.5 * squares.detach().mean()).sqrt())
        return x, potential + self.weight * squares[:, None], past

    def _cloth(self, motions: Motions, windows: Windows, offsets: Tensor) -> tuple[Tensor, Tensor]:
        """World positions (B, 1, V, 3) [m] and their potential (B, 1) [J]."""
        objective = self.objective
        if not self.physics:
            transforms = motions.transforms[windows.frames[:, -1:]].to(offsets)
            x = skin(blend_transforms(objective.weights, transforms), objective.template + offsets)
            return x, x.new_zeros(x.shape[:2])
        still = torch.zeros_like(offsets[:, 0])
        one = replace(windows, frames=windows.frames[:, -1:], scored=np.zeros_like(windows.scored))
        scene, _ = objective.scene(motions, one, offsets, Past(still, still))
        return scene.x, objective.potential.loss(scene.x, scene.step, scene.body)

    def under(self, potential: Potential) -> ScanLoss:
        """The same with another physics."""
        other = copy.copy(self)
        other.objective = self.objective.under(potential)
        return other


@dataclass(frozen=True, eq=False)
class Scans:
    """Scans that a training is supervised by: their poses as clips of one frame, and what is asked there."""

    motions: Motions
    loss: ScanLoss

    @classmethod
    def of(
        cls,
        points: Sequence[ScanPoints],
        worn: str,
        over: Sequence[str],
        objective: Objective,
        driving: Sequence[int],
        weight: float = LAMBDA_3D,
        physics: bool = True,
    ) -> Scans:
        """Supervision of the garment ``worn`` (a part of the points) by scans; parts ``over`` it may hide it.

        Raises:
            CaphyError: there are no scans, or one shows nothing of the garment.
        """
        if not points:
            raise CaphyError("there must be at least one scan to train on, got none")
        cloth = objective.potential.cloth
        targets = [Target.of(scan, worn, over) for scan in points]
        chamfer = Chamfer(cloth.faces, cloth.vertices, cloth.vertex_area)
        motions = scan_motions(points, objective.body, driving, 1 / objective.dt, objective.betas)
        return cls(motions, ScanLoss(objective, chamfer, targets, weight, physics))

    def under(self, potential: Potential) -> Scans:
        """The same with another physics."""
        return replace(self, loss=self.loss.under(potential))


def scan_motions(
    points: Sequence[ScanPoints], body: BodyModel, driving: Sequence[int], fps: float, betas=None
) -> Motions:
    """The scans' poses, each a clip of one frame."""
    clips = [
        PoseSequence(scan.pose[None], scan.transl[None], fps, source=scan.name, pelvis=body.joints[0])
        for scan in points
    ]
    return Motions.of(clips, body, driving, fps, betas)


def innermost_first(
    points: Sequence[ScanPoints], worn: Mapping[str, tuple[np.ndarray, np.ndarray]], motions: Motions
) -> list[str]:
    """The two garments in the order in which they are worn, as the scans show it: what is hidden lies inside.

    worn: for each part its template (V, 3) [m] and skinning weights (V, 55); motions: the scans' poses, one frame
    each. A template's vertices count as hidden where the other garment's points are nearer than its own.
    """
    one, other = worn
    hidden = {}
    for mine, others in ((one, other), (other, one)):
        template, weights = worn[mine]
        posed = skin(blend_transforms(weights, motions.transforms.double().numpy()), template)
        shares = [_share_nearer(x, getattr(s, others), getattr(s, mine)) for x, s in zip(posed, points, strict=True)]
        hidden[mine] = float(np.mean(shares))
    return [one, other] if hidden[one] >= hidden[other] else [other, one]


def _share_nearer(x: np.ndarray, these: np.ndarray, those: np.ndarray) -> float:
    if not len(these) or not len(those):
        return 0.0
    return float((KDTree(these).query(x)[0] < KDTree(those).query(x)[0]).mean())
