"""A panel of cloth hung between two bars of a frame that is turned: gravity pulls at it from every side."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from caphy.body.model import BodyModel
from caphy.conventions import JOINT_COUNT, JOINT_PARENTS
from caphy.effects.cloth import Cloth
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.fabric.stills import Still, Worn
from caphy.garment.template import Garment, read_npz, write_npz
from caphy.solve.integrators import ImplicitEuler, State
from caphy.solve.newton import Newton
from caphy.solve.rollout import Simulator
from caphy.solve.statics import drape

SIZE, SLACK = 0.30, 0.03
"""Side of the panel [m], and by how much the bars stand nearer to each other than it is wide."""


SWINGS = 5
"""Steps of a fifth of a second in which it swings before it is brought to rest; without them it rests in odd folds."""


def frame() -> BodyModel:
    """A box 60 cm below the panel, turned by the root alone; the panel never touches it."""
    corners = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.7, -0.6) for z in (-0.1, 0.1)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], dtype=np.int32)
    weights = np.zeros((8, JOINT_COUNT))
    weights[:, 0] = 1
    return BodyModel(
        v_template=corners,
        faces=faces,
        joints=np.zeros((JOINT_COUNT, 3)),
        weights=weights,
        parents=np.array(JOINT_PARENTS, dtype=np.int32),
        shapedirs=np.zeros((8, 3, 1)),
        joint_shapedirs=np.zeros((JOINT_COUNT, 3, 1)),
        expressiondirs=np.zeros((8, 3, 0)),
        joint_expressiondirs=np.zeros((JOINT_COUNT, 3, 0)),
    )


def panel(rows: int) -> Garment:
    """The panel in ``rows`` rows of vertices from bar to bar, along which the weft runs; held along the bars.

    Triangles are as good as equilateral, as those of garments are: hinges on squares with diagonals bend otherwise.
    """
    step = SIZE / (rows - 1)
    columns = round(SIZE / (2 * step / np.sqrt(3))) + 1
    i, j = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    flat = np.stack([i * step, (j + 0.5 * (i % 2)) * SIZE / (columns - 0.5)], -1).reshape(-1, 2)
    index, odd = np.arange(rows * columns).reshape(rows, columns), (np.arange(rows - 1) % 2 == 1)[:, None, None]
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    first = np.where(odd, np.stack([a, b, c], -1), np.stack([a, b, d], -1))
    second = np.where(odd, np.stack([a, c, d], -1), np.stack([b, c, d], -1))
    faces = np.concatenate([first.reshape(-1, 3), second.reshape(-1, 3)]).astype(np.int32)
    weights = np.zeros((len(flat), JOINT_COUNT))
    weights[:, 0] = 1
    held = np.isclose(flat[:, 0] % SIZE, 0, atol=1e-9) | np.isclose(flat[:, 0], SIZE)
    vertices = np.column_stack([(flat[:, 0] - SIZE / 2) * (1 - SLACK), np.zeros(len(flat)), SIZE / 2 - flat[:, 1]])
    regions, none = np.full(len(flat), "panel"), np.zeros(len(flat))
    return Garment(
        "panel", vertices, faces, flat[faces], weights, regions, layer_thickness=none, attached=held.astype(float)
    )


def turns(count: int, seed: int) -> np.ndarray:
    """Poses (count, 55, 3) [rad] with the root turned at random and everything else at rest."""
    random = np.random.default_rng(seed)
    axis = np.array([random.normal(size=3) for _ in range(count)])  # the first are the same, however many there are
    angle = np.random.default_rng([seed, 1]).uniform(0, np.pi, (count, 1))
    axis *= angle / np.linalg.norm(axis, axis=1, keepdims=True)
    poses = np.zeros((count, JOINT_COUNT, 3))
    poses[:, 0] = axis
    return poses


@dataclass
class Stills:
    """The panel of a fabric at rest in turned frames, by the solver on a mesh of its own."""

    model: Model
    rows: int
    poses: np.ndarray
    seed: int = 0
    kept: Path | None = None
    """Where stills are kept, and taken from if made in the same way before (.npz)."""
    cloth: list[np.ndarray] = field(default_factory=list)
    """Vertices (V, 3) [m] of each still."""

    def __post_init__(self) -> None:
        self.truth = panel(self.rows)
        cloth = Cloth.of(self.truth, self.model.density)
        newton = Newton(Potential(self.model, cloth), tolerance=1e-6)
        key = f"{self.rows} {self.seed} {self.model.to_json()}"
        if self.kept is not None and self.kept.is_file():
            found = read_npz(self.kept)
            self.cloth = list(found["x"][: len(self.poses)]) if str(found["key"]) == key else []
        for number in range(len(self.cloth), len(self.poses)):
            random = np.random.default_rng([self.seed, number])
            self.cloth.append(_settled(newton, self._worn(self.poses[number], self.truth), random))
            if self.kept is not None:
                write_npz(self.kept, {"key": np.array(key), "x": np.array(self.cloth)})

    def scans(self, garment: Garment, noise: float, spacing: float = 0.006) -> list[Worn]:
        """The stills as points ``spacing`` apart with noise [m], the garment being another mesh of the panel."""
        random = np.random.default_rng(self.seed + 1)
        scans = []
        for number, (x, pose) in enumerate(zip(self.cloth, self.poses, strict=True)):
            corners = x[self.truth.faces]
            area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
            count = int(area.sum() / spacing**2)
            face, weights = random.choice(len(area), count, p=area / area.sum()), random.dirichlet(np.ones(3), count)
            points = np.einsum("nk,nkc->nc", weights, corners[face]) + noise * random.normal(size=(count, 3))
            scans.append(Worn(Still(f"still_{number:02d}", points, pose, np.zeros(3)), frame(), garment))
        return scans

    @staticmethod
    def _worn(pose: np.ndarray, garment: Garment) -> Worn:
        return Worn(Still("truth", np.zeros((1, 3)), pose, np.zeros(3)), frame(), garment)


def _settled(newton: Newton, worn: Worn, random: np.random.Generator) -> np.ndarray:
    """Where the panel comes to rest (V, 3), swinging first, from a template that is not quite flat."""
    x = torch.from_numpy(worn.skinned() + 1e-3 * random.normal(size=newton.potential.cloth.vertices.shape))
    simulator = Simulator(newton.within(5e-3), worn.motion, ImplicitEuler())
    state = State(0.0, x, torch.zeros_like(x))
    for _ in range(SWINGS):
        state, _ = simulator.advance(state, 0.2)
    x, report = drape(newton, state.x, worn.seen)
    if not report.converged:
        raise RuntimeError(f"a still did not come to rest: {report.reason}")
    return x.numpy()
