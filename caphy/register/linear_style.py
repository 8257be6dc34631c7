"""A linear style basis, as TailorNet's (Patel et al., CVPR 2020): a mean garment and directions it varies in.

The file is an npz without pickles: ``mean`` (V, 3) [m] on the body in T-pose, ``components`` (K, V, 3) [m per unit],
``faces`` (F, 3), and, if known, ``deviations`` (K,), the standard deviation of each coefficient (else one).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from caphy.errors import CaphyError
from caphy.garment.attach import skinning_weights
from caphy.garment.from_mesh import garment_from_mesh
from caphy.garment.landmarks import Landmarks
from caphy.garment.template import Garment, read_npz
from caphy.garment.usermesh import UserMesh
from caphy.register.articulation import Figure
from caphy.register.chamfer import MOST, Target
from caphy.register.template import COMPARED, LEAST_POINTS, NOTHING, STYLES, dressed_body

SPREAD = 2.0
"""Coefficients are looked at up to this many standard deviations."""
STEPS = 8
"""Gauss-Newton steps that refine the best of them."""
NOISE = 0.01
"""How far cloth lies from its template [m]: what the coefficients' own spread is weighed against."""

UNUSUAL = 0.0002
"""Cost [m] of a coefficient a standard deviation from the mean garment's: decides what no camera saw."""


KEYS = ("mean", "components", "deviations", "faces")


@dataclass(frozen=True, eq=False)
class LinearStyle:
    """A mean garment and its directions."""

    name: str
    mean: np.ndarray
    """(V, 3) [m]."""
    components: np.ndarray
    """(K, V, 3) [m per unit of a coefficient]."""
    deviations: np.ndarray
    """Standard deviation of each coefficient (K,)."""
    faces: np.ndarray
    """(F, 3)."""

    @classmethod
    def load(cls, path: Path) -> LinearStyle:
        """Read a basis.

        Raises:
            CaphyError: a key is missing, or what it holds is no such basis.
        """
        arrays = read_npz(path)
        missing = {"mean", "components", "faces"} - arrays.keys()
        if missing:
            raise CaphyError(
                f"{path}: a style basis needs mean (V, 3), components (K, V, 3) and faces (F, 3); "
                f"{', '.join(sorted(missing))} missing"
            )
        _require_numbers(path, arrays)
        count, rank = max(1, len(arrays["mean"])), max(1, len(arrays["components"]))  # an empty one is refused
        arrays.setdefault("deviations", np.ones(rank))
        shapes = {"mean": (count, 3), "components": (rank, count, 3), "deviations": (rank,)}
        for name, shape in shapes.items():
            if arrays[name].shape != shape or not np.isfinite(arrays[name]).all():
                raise CaphyError(
                    f"{path}: {name} must be finite and of shape {shape}, got {arrays[name].shape}; components are "
                    "(coefficient, vertex, axis)"
                )
        if (least := arrays["deviations"].min()) <= 0:
            raise CaphyError(
                f"{path}: deviations must be positive, got {least:g}; leave out components that do not vary, or "
                "deviations where they are not known"
            )
        return cls(
            name=path.stem,
            mean=arrays["mean"].astype(np.float64),
            components=arrays["components"].astype(np.float64),
            deviations=arrays["deviations"].astype(np.float64),
            faces=_triangles(path, arrays["faces"], count),
        )

    def vertices(self, coefficients: np.ndarray) -> np.ndarray:
        """The garment (V, 3) [m] of coefficients (K,)."""
        return self.mean + np.tensordot(coefficients, self.components, axes=1)


def _require_numbers(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    for name in KEYS:
        if name in arrays and (arrays[name].ndim == 0 or arrays[name].dtype.kind not in "fiu"):
            raise CaphyError(
                f"{path}: {name} must be an array of numbers, got {arrays[name].dtype} of shape "
                f"{arrays[name].shape}; write it as floats, faces as integers"
            )


def _triangles(path: Path, faces: np.ndarray, count: int) -> np.ndarray:
    """Faces (F, 3) int32 of a file whose mesh has ``count`` vertices."""
    triangles = faces.ndim == 2 and faces.shape[1] == 3 and len(faces) > 0
    if triangles and np.array_equal(faces, np.round(faces)) and faces.min() >= 0 and faces.max() < count:
        return faces.astype(np.int32)
    span = f" from {faces.min():g} to {faces.max():g}" if faces.size else ""
    raise CaphyError(
        f"{path}: faces must be triangles (F, 3), one at least, of whole numbers of its {count} vertices, 0 to "
        f"{count - 1}; got {faces.dtype} of shape {faces.shape}{span}; as of an OBJ they count from 1: subtract 1"
    )


@dataclass(frozen=True, eq=False)
class LinearChoice:
    """The coefficients that fit best."""

    coefficients: np.ndarray
    """(K,)."""
    distance: float
    """Mean two-way distance from the scans' cloth [m]."""
    looked_at: int


def choose_linear(
    style: LinearStyle, figure: Figure, targets: Sequence[Target], seed: int = 0, count: int = STYLES
) -> LinearChoice:
    """The best of ``count`` random styles of a basis, refined; of ``targets`` the plainest come first."""
    targets = targets[:COMPARED]
    marks, rng = Landmarks.of(dressed_body(figure)), np.random.default_rng(seed)
    weights = skinning_weights(style.mean, style.faces, marks.body, marks.vertices)
    drawn = style.deviations * np.clip(rng.standard_normal((count, len(style.deviations))), -SPREAD, SPREAD)
    drawn[0] = 0.0

    def score(coefficients: np.ndarray) -> float:
        unusual = UNUSUAL * float(((coefficients / style.deviations) ** 2).sum())
        return _distance(style, weights, targets, coefficients) + unusual

    best = min(drawn, key=score)
    for _ in range(STEPS):
        tried = _refined(style, weights, targets, best)
        if score(tried) >= score(best):
            break
        best = tried
    return LinearChoice(best, _distance(style, weights, targets, best), count)


def linear_garment(style: LinearStyle, choice: LinearChoice, figure: Figure, kind: str) -> Garment:
    """The chosen style as a garment on the fitted body, named by its kind: a file's name need not be a garment's."""
    mesh = UserMesh(style.vertices(choice.coefficients), style.faces, None)
    told = {"coefficients": " ".join(f"{value:.4f}" for value in choice.coefficients), "basis": style.name}
    marks = Landmarks.of(dressed_body(figure))
    return garment_from_mesh(mesh, kind, marks, waistband=kind == "lower", provenance=told)


def _distance(style: LinearStyle, weights: np.ndarray, targets: Sequence[Target], coefficients: np.ndarray) -> float:
    """Mean two-way distance [m]; of the garment only what the scans show counts, not what lies under a shirt."""
    score = 0.0
    for target in targets:
        posed = target.posed(style.vertices(coefficients), weights)
        known = target.seen(posed)[0]
        if known.sum() < LEAST_POINTS:
            return NOTHING
        score += target.from_garment(posed[known]).mean() + target.to_garment(posed)
    return score / (2 * len(targets))


def _refined(
    style: LinearStyle, weights: np.ndarray, targets: Sequence[Target], coefficients: np.ndarray
) -> np.ndarray:
    """Coefficients after one step towards nearest points, both ways, held by their own spread."""
    matrix, right = np.diag(1 / style.deviations**2), -coefficients / style.deviations**2
    for target in targets:
        blend = np.tensordot(weights, target.placed.transforms, axes=1)[..., :3]
        moves = np.einsum("vij,kvj->vik", blend, style.components)
        posed = target.posed(style.vertices(coefficients), weights)
        away, own = target.cloth_tree.query(posed)
        back, vertex = KDTree(posed).query(target.cloth)
        gaps = np.concatenate([target.cloth_tree.data[own] - posed, target.cloth - posed[vertex]])
        near = np.concatenate([(away < MOST) & target.seen(posed)[0], back < MOST])
        rows = np.concatenate([moves, moves[vertex]])[near].reshape(-1, len(coefficients))
        scale = 1 / (NOISE**2 * len(gaps) * len(targets)) * 100  # a hundred points' worth of evidence
        matrix = matrix + scale * rows.T @ rows
        right = right + scale * rows.T @ gaps[near].ravel()
    return coefficients + np.linalg.solve(matrix, right)
