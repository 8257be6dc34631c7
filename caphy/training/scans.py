"""Supervision by scans: static windows of their poses, and how far predicted cloth lies from their points.

CaPhy, section 3.3: ``E_phys + lambda_3d E_3d`` with E_3d the two-sided squared Chamfer distance between the garment and
the scan's points of it.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

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
from caphy.register.points import ScanPoints
from caphy.training.counterparts import Counterparts, Grouped, Target, look
from caphy.training.motions import Motions
from caphy.training.objective import Objective, Past, ground_energies
from caphy.training.streams import HELD_WINDOWS, WINDOW, Windows

LAMBDA_3D = 3000.0
"""Weight of the squared distances [J/m^2]; see docs/supervised.md for how it was chosen."""
FARTHEST = 0.10
"""A point farther than this from the cloth [m] has no counterpart (a wrong label): it does not pull."""
RANDOM_EPOCHS, SCAN_EPOCHS = 1, 4
"""Turns of random poses and of the scans' (CaPhy, section 4.1)."""


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

    def __call__(self, x: Tensor, targets: Sequence[Target]) -> Tensor:
        """Sums (B,) of both mean squared distances [m^2] of vertices x (B, V, 3) in scans, differentiable."""
        return self.apart(x, look(self.surface, x, targets))

    def apart(self, x: Tensor, found: Counterparts) -> Tensor:
        """The same at the counterparts that were found for x."""
        return self.to_points(x, found) + self.to_cloth(x, found)

    def to_points(self, x: Tensor, found: Counterparts) -> Tensor:
        """Mean squared distances (B,) of the cloth from the scans' points [m^2]."""
        weight = self.area.to(x) * found.shown
        square = (x - found.point).square().sum(-1)
        return (weight * square).sum(-1) / weight.sum(-1).clamp_min(1e-12)

    def to_cloth(self, x: Tensor, found: Counterparts) -> Tensor:
        """Mean squared distances (B,) of the scans' points from the cloth [m^2]."""
        corners = x.gather(1, found.corners.flatten(1)[..., None].expand(-1, -1, 3)).unflatten(1, (-1, 3))
        square = ((found.barycentric[..., None] * corners).sum(-2) - found.sample).square().sum(-1)
        return (found.share * square.clamp_max(FARTHEST**2)).sum(-1)


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
        self._grouped: Grouped | None = None
        self.distance = 0.0
        """Root mean square of both sides' distances in the last call [m]."""

    def judge(self, motions: Motions, windows: Windows, offsets: Tensor, past: Past) -> tuple[Tensor, Tensor, Past]:
        """Positions (B, 1, V, 3) [m] and loss (B, 1) [J] at offsets (B, 1, V, 3) in the last frame of each window."""
        x, potential = self._cloth(motions, windows, offsets)
        squares = self.chamfer.apart(x[:, 0], self._look(x[:, 0], windows.frames[:, -1].tolist()))
        self.distance = float((0.5 * squares.detach().mean()).sqrt())
        return x, potential + self.weight * squares[:, None], past

    def _look(self, x: Tensor, scans: Sequence[int]) -> Counterparts:
        if x.device.type == "cpu":
            return look(self.chamfer.surface, x, [self.targets[scan] for scan in scans])
        if self._grouped is None:
            self._grouped = Grouped(self.chamfer.surface, self.targets, x.device)
        return self._grouped.look(x, scans)

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
        with torch.no_grad():  # as of motions, it counts from the skinned template's weight
            ground = sum(ground_energies(objective.potential, scene.body.anchor).values())
        return scene.x, objective.potential.loss(scene.x, scene.step, scene.body) - ground

    def only(self, scans: Sequence[int]) -> ScanLoss:
        """The same of some scans alone, by their numbers."""
        targets = [self.targets[scan] for scan in scans]
        return ScanLoss(self.objective, self.chamfer, targets, self.weight, self.physics)

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
    left_out: tuple[str, ...] = ()
    """What is said of scans that show too little of the garment."""

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

    def only(self, names: Sequence[str]) -> Scans:
        """The same of the scans ``names`` alone, in that order."""
        own, chosen = self.motions, [self.motions.names.index(name) for name in names]
        frames = own.poses[chosen], own.transl[chosen], own.features[chosen], own.transforms[chosen]
        motions = Motions(*frames, np.arange(len(chosen) + 1), tuple(names))
        return replace(self, motions=motions, loss=self.loss.only(chosen))

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
