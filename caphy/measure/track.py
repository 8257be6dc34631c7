"""Registering point clouds: a cloth that moves as the model says is drawn to each frame's points.

A filter in time: the state is advanced by one frame, then the cloth settles between where the model put it and the
points, with its own elasticity, weight and contact in force. Points draw along the normal only, so that the cloth may
slide under them; its rim is drawn to where they end. Cloth whose points end elsewhere is registered again, in the size
that they ask for: cloth that is too large for its points buckles between them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from caphy.body.surface import nearest_on_surface
from caphy.effects.base import Effect, Elements, Values
from caphy.effects.candidates import switched_off
from caphy.effects.cloth import Cloth
from caphy.effects.model import Model
from caphy.effects.potential import Potential, Term
from caphy.effects.registry import find_effect
from caphy.effects.vectors import dot, isotropic
from caphy.errors import CaphyError
from caphy.measure.mesh_body import MeshBody
from caphy.measure.noise import measurement_noise
from caphy.measure.rim import Rim
from caphy.measure.scene import Scene
from caphy.solve.integrators import State
from caphy.solve.newton import Body, Newton
from caphy.solve.rollout import Simulator

PULL = 12_000.0
"""Stiffness over mass of the springs to the points [1/s^2], as strong as those that start windows."""
PRIOR = 900.0
"""The same towards where the model put the cloth: inertia over one frame at 30 frames per second."""
RIM = 1_000.0
"""The same from each end of a boundary edge to where the points end; more buckles cloth whose model is too large."""
FEWEST = 50
"""Points without which a frame counts as missing."""

_ROUNDS, _FIRST_ROUNDS = 6, 40  # of nearest points, in each frame and in the first
_TRUSTED = 0.5  # share of a correction that velocities take over
_FAR = 0.03  # metres: points farther from the cloth than this and five times the noise belong to something else
_SUBSTEPS = 2
_SIZE, _WAYS = "shrinkage_directional", ("weft", "warp")
_SAME = 4e-3  # of lengths: sizes that do not differ
_SIZINGS = 4  # registrations at most
_MOST = 0.2  # of lengths: who asks for more has not seen where the cloth ends
_LOOSE = 1.0  # of the prior [1/s^2] where a size is asked for: what keeps cloth still that nothing else does
_TOLERANCE = 2e-4  # of the solver [N]

Progress = Callable[[str, int, int], None]


class DrawnToPoints(Effect):
    """Springs to the points along the normal, at the rim to where they end across it, and to the predicted state.

    E = 1/2 x.G x - target.x + prior/2 |x - Q|^2 + push.x [J] per vertex, where G = sum k n n^T and target = sum
    k n n.P of springs along unit vectors n to places P; Q is the prediction, and the push balances the cloth there. Not
    registered: it is no physics.
    """

    name = "drawn_to_points"
    element = "vertex"
    reference = "Bouaziz, Tagliasacchi, Pauly, Sparse ICP, SGP 2013, section 2 (point to plane); Kalman 1960"

    def rest(self, cloth: Cloth) -> dict[str, np.ndarray]:
        zeros = np.zeros((3, 3, len(cloth.vertices)))
        names = ("target", "predicted", "push")
        return {"grip": zeros, "prior": zeros[0, 0], **dict.fromkeys(names, zeros[0])}

    def energy(self, e: Elements, p: Values) -> Tensor:
        (x,) = e.x
        away = x - e.rest["predicted"]
        gripped = (e.rest["grip"] * x[None]).sum(1)
        return 0.5 * (dot(x, gripped) + e.rest["prior"] * dot(away, away)) + dot(e.rest["push"] - e.rest["target"], x)

    def gradient(self, e: Elements, p: Values) -> tuple[Tensor, Tensor]:
        """In closed form."""
        (x,) = e.x
        force = (e.rest["grip"] * x[None]).sum(1) + e.rest["prior"] * (x - e.rest["predicted"])
        return self.energy(e, p), (force + e.rest["push"] - e.rest["target"])[None]

    def hessian(self, e: Elements, p: Values) -> Tensor:
        """Constant and positive semi-definite."""
        return isotropic(e.rest["prior"], e.x) + e.rest["grip"].reshape(1, 3, 1, 3, -1)

    def projected_hessian(self, e: Elements, p: Values) -> Tensor:
        return self.hessian(e, p)


def registered(scene: Scene, model: Model, progress: Progress | None = None) -> Scene:
    """A scene whose cloud has become vertices (T, V, 3) of the garment; one that is registered stays as it is.

    Vertices with no point near them count as not seen. What the tracker cannot see, sliding along itself, follows the
    model, so that the scene :attr:`~caphy.measure.scene.Scene.slides`: it is compared across the cloth, and across its
    rim, where it knows the :attr:`~caphy.measure.scene.Scene.ends` of the cloud.

    Raises:
        CaphyError: fewer than two frames hold enough points, or the first ones are far from any cloth.
    """
    if scene.measurement.vertices is not None:
        return scene
    known = model.effects.get(_SIZE) or switched_off(_SIZE)
    size = own = np.array([known[way] for way in _WAYS])
    left = _SIZINGS
    while True:
        tracker = _Tracker(scene, model)
        vertices, visible, ends = tracker.run(progress)
        left -= 1
        wanted = size + tracker.size()
        if not left or np.abs(wanted - size).max() < _SAME or np.abs(wanted).max() > _MOST:
            break
        size = wanted
        model = model.with_effect(_SIZE, **dict(zip(_WAYS, size, strict=True)))
    seen = np.where(visible[..., None], vertices, np.nan)
    return registered_as(scene, seen, ends, "registered with the model's help" + _resized(size - own))


def registered_as(scene: Scene, vertices: np.ndarray, ends: np.ndarray, note: str) -> Scene:
    """A scene whose cloud has become ``vertices`` (T, V, 3) [m], NaN where not seen, with the cloth's ``ends``."""
    noise = measurement_noise(scene.measurement)
    measurement = replace(
        scene.measurement,
        vertices=vertices,
        faces=scene.garment.faces,
        points=None,
        offsets=None,
        noise=None,
        noise_mm=None if noise is None else 1e3 * noise.sigma,
        notes=(*scene.measurement.notes, note),
    )
    return replace(scene, measurement=measurement, ends=ends, cloud=scene.measurement)


def _resized(change: np.ndarray) -> str:
    """By how much cloth was smaller than its model, in words; empty where it was not."""
    ways = [
        f"{way} {100 * abs(by):.1f} % {'shorter' if by > 0 else 'longer'}"
        for way, by in zip(_WAYS, change, strict=True)
    ]
    return f", with {' and '.join(ways)} than the model has it" if change.any() else ""


def _rim(scene: Scene) -> Rim:
    try:
        return Rim.of(scene.garment.vertices, scene.garment.faces)
    except ValueError as error:
        raise CaphyError(
            f"{scene.garment.name}: points are drawn to where the cloth ends, so its boundary must be of loops that do "
            "not touch, got one that is pinched at a vertex; repair the mesh (split that vertex)"
        ) from error


class _Tracker:
    def __init__(self, scene: Scene, model: Model) -> None:
        self.scene, self.measurement = scene, scene.measurement
        self.potential = scene.potential(model)
        self.drawn = Potential(model, self.potential.cloth)
        effect, vertex = DrawnToPoints(), Potential(Model(model.density, {"gravity": {}}), self.potential.cloth)
        term = vertex.terms["gravity"]
        rest = {name: torch.from_numpy(value) for name, value in effect.rest(self.potential.cloth).items()}
        self.drawn.terms[effect.name] = Term(effect, term.index, term.incidence, rest, {})
        self.newton = Newton(self.drawn, scene.fixed, _TOLERANCE)
        self.simulator = Simulator(
            Newton(self.potential, scene.fixed, _TOLERANCE),
            scene.motion,  # type: ignore[arg-type]
            pins=scene.pins,
        )
        noise = measurement_noise(self.measurement)
        self.noise = 0.0 if noise is None else noise.sigma
        self.reach = _FAR + 5 * self.noise
        self.faces, self.mass = scene.garment.faces, self.potential.cloth.mass
        self.rim = _rim(scene)
        self.sized: Potential | None = None
        if find_effect(_SIZE).lenders(model.effects) is not None:
            there = _SIZE in model.effects
            self.sized = scene.potential(model if there else model.with_effect(_SIZE, **switched_off(_SIZE)))
        self.sizes: list[np.ndarray] = []

    def run(self, progress: Progress | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices (T, V, 3) [m], which of them were seen (T, V), and where the cloth ends (T, E, 3) [m]."""
        fps, count = self.measurement.fps, len(self.measurement)
        clouds = [self.measurement.cloud(frame) for frame in range(count)]
        enough = [len(cloud) >= FEWEST for cloud in clouds]
        if sum(enough) < 2:
            where = self.measurement.source or self.measurement.name
            raise CaphyError(
                f"{where}: at least two frames must hold {FEWEST} points or more, {sum(enough)} of {count} do"
            )
        vertices, visible = np.full((count, len(self.mass), 3), np.nan), np.zeros((count, len(self.mass)), bool)
        ends = np.full((count, len(self.rim.edges), 3), np.nan)
        first = enough.index(True)
        x, visible[first], ends[first] = self._first(clouds[first], first / fps)
        vertices[first] = x.numpy()
        state = State(first / fps, x, torch.zeros_like(x))
        for frame in range(first + 1, count):
            state, _ = self.simulator.advance(state, 1 / fps, _SUBSTEPS)
            vertices[frame] = state.x.numpy()
            if enough[frame]:
                x, visible[frame], ends[frame] = self._settled(state.x, clouds[frame], frame / fps, PRIOR, _ROUNDS)
                state = State(state.time, x, state.v + _TRUSTED * fps * (x - state.x))
                vertices[frame] = x.numpy()
            if progress is not None:
                progress("registering", frame + 1, count)
        return vertices, visible, ends

    def _first(self, cloud: np.ndarray, time: float) -> tuple[Tensor, np.ndarray, np.ndarray]:
        """The cloth in the first frame: from where it is worn, or laid into the cloud by its pins and middle."""
        motion = self.scene.motion
        if motion is not None and not isinstance(motion, MeshBody):
            place = motion.anchors(np.array([time]))[0]
        else:
            place = self._laid(cloud, time)
        found = self._settled(torch.from_numpy(place), cloud, time, 0.0, _FIRST_ROUNDS, reach=np.inf)
        x = found[0]
        gap = np.abs(nearest_on_surface(cloud, x.numpy(), self.faces).distance)
        if np.median(gap) > _FAR:
            where = self.measurement.source or self.measurement.name
            raise CaphyError(
                f"{where}: the cloth must be near the first cloud; half of its points are farther than "
                f"{1e3 * np.median(gap):.0f} mm; check units, axes and pins"
            )
        return found

    def _laid(self, cloud: np.ndarray, time: float) -> np.ndarray:
        rest, ends = self.scene.garment.vertices, [cloud.mean(0)]
        starts = [rest.mean(0)]
        if self.scene.fixed is not None and self.scene.pins is not None:
            starts += list(rest[self.scene.fixed])
            ends += list(self.scene.pins(time).numpy())
        a, b = np.array(starts), np.array(ends)
        left, _, right = np.linalg.svd((a - a.mean(0)).T @ (b - b.mean(0)))
        flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
        turn = left @ flip @ right
        return (rest - a.mean(0)) @ turn + b.mean(0)

    def _settled(
        self, x: Tensor, cloud: np.ndarray, time: float, prior: float, rounds: int, reach: float | None = None
    ) -> tuple[Tensor, np.ndarray, np.ndarray]:
        """The cloth between prediction and points, which vertices had points near them, and where the cloth ends."""
        rest, motion = self.drawn.terms[DrawnToPoints.name].rest, self.scene.motion
        body = None if motion is None else lambda at: motion.state(time, at.numpy(), 1 / self.measurement.fps)
        push = torch.zeros_like(x)
        if prior:
            push = -self.potential.gradient(x, None, None if body is None else body(x))[1]
        rest["prior"] = torch.from_numpy(prior * self.mass)
        rest["predicted"], rest["push"] = x.T.contiguous(), push.T.contiguous()
        reach = self.reach if reach is None else reach
        x = x.clone()
        if self.scene.pins is not None and self.scene.fixed is not None:
            x[torch.from_numpy(np.flatnonzero(self.scene.fixed))] = self.scene.pins(time)
        place, share, normal, ends = self._matched(x.numpy(), cloud, reach)
        for _ in range(rounds):
            grip, target = _springs(PULL * self.mass * np.minimum(share, 1), normal, place)
            at_rim = self._rim_springs(x.numpy(), ends)
            rest["grip"] = torch.from_numpy(np.ascontiguousarray(np.moveaxis(grip + at_rim[0], 0, -1)))
            rest["target"] = torch.from_numpy(np.ascontiguousarray((target + at_rim[1]).T))
            last, x = x, self.newton.minimise(x, None, body)[0]
            if torch.equal(x, last):  # within the solver's tolerance: so it would be in all further rounds
                break
            place, share, normal, ends = self._matched(x.numpy(), cloud, reach)
        rest["prior"] = torch.from_numpy(_LOOSE * self.mass)
        self._ask_size(x, ends, body)
        return x, share > 0, ends

    def _ask_size(self, x: Tensor, ends: np.ndarray, body: Body | None) -> None:
        """Note by how much smaller the cloth must be to end where the points do, other forces as they are."""
        known = np.isfinite(ends).all(1)
        if self.sized is None or known.sum() < 2 * len(_WAYS):
            return
        found = self.sized.parameter_gradients(
            x, None, None if body is None else body(x), {f"{_SIZE}.{way}" for way in _WAYS}
        )
        force = torch.stack([found[f"{_SIZE}.{way}"] for way in _WAYS], -1).numpy()  # (V, 3, 2)
        if self.scene.fixed is not None:
            force[self.scene.fixed] = 0
        moved = -self.newton.factorize(x, None, body).solve(force)
        middle, _, out = self.rim.frames(x.numpy())
        shift = np.einsum("ec,eck->ek", out, moved[self.rim.edges].mean(1))[known]
        short = ((ends - middle) * out).sum(1)[known]
        self.sizes.append(np.linalg.solve(shift.T @ shift + 1e-9 * np.eye(len(_WAYS)), shift.T @ short))

    def size(self) -> np.ndarray:
        """The shares of lengths along weft and warp by which the cloth is smaller than the model has it; medians over
        frames."""
        return np.median(self.sizes, axis=0) if self.sizes else np.zeros(len(_WAYS))

    def _rim_springs(self, x: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As :func:`_springs`, of each boundary edge on its two vertices."""
        _, _, out = self.rim.frames(x)
        known = np.isfinite(ends).all(1)
        grip, target = np.zeros((len(x), 3, 3)), np.zeros((len(x), 3))
        for vertex in self.rim.edges[known].T:  # a vertex starts one edge and ends another: none occurs twice
            springs = _springs(RIM * self.mass[vertex], out[known], ends[known])
            grip[vertex] += springs[0]
            target[vertex] += springs[1]
        return grip, target

    def _matched(
        self, x: np.ndarray, cloud: np.ndarray, reach: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Where points draw each vertex (V, 3) [m], how many share it over the mean (V,), normals (V, 3), and where
        the cloth ends beside each boundary edge (E, 3) [m]."""
        found = nearest_on_surface(cloud, x, self.faces)
        kept = np.abs(found.distance) < reach
        corners, weight = self.faces[found.face[kept]], np.asarray(found.barycentric)[kept]
        away = cloud[kept] - np.asarray(found.point)[kept]
        total = np.bincount(corners.ravel(), weight.ravel(), len(x))
        drawn = np.stack(
            [np.bincount(corners.ravel(), (weight * away[:, i : i + 1]).ravel(), len(x)) for i in range(3)], 1
        )
        drawn = drawn / np.maximum(total, 1e-9)[:, None]  # of no point at all numpy counts in whole numbers
        area = np.cross(x[self.faces[:, 1]] - x[self.faces[:, 0]], x[self.faces[:, 2]] - x[self.faces[:, 0]])
        normal = np.stack([np.bincount(self.faces.ravel(), np.repeat(area[:, i], 3), len(x)) for i in range(3)], 1)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        expected = len(cloud) * self.potential.cloth.vertex_area / self.potential.cloth.vertex_area.sum()
        ends = self.rim.ends(x, cloud[kept], found.face[kept], self.noise)
        return x + drawn, total / np.maximum(expected, 1e-9), normal, ends


def _springs(stiffness: np.ndarray, along: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Matrices (N, 3, 3) [N/m] and targets (N, 3) [N] of springs (N,) along unit vectors (N, 3) to places (N, 3)."""
    matrix = (stiffness[:, None] * along)[:, :, None] * along[:, None]
    return matrix, np.einsum("nij,nj->ni", matrix, place)
