"""The avatar bundle: a directory with everything that serving a dressed body needs, and nothing to train it.

``avatar.json`` (the manifest), ``arrays.npz`` (meshes, sparse skinning weights, joints; plain arrays) and one
``<garment>.onnx`` per garment. The manifest states the SHA-256 of every other file, and reading checks them.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from caphy.body.kinematics import joint_transforms
from caphy.body.skinning import blend_transforms, skin
from caphy.conventions import JOINT_COUNT, JOINT_NAMES
from caphy.errors import CaphyError
from caphy.io.places import new_folder
from caphy.rotations import matrix_from_axis_angle

SCHEMA: Final = "caphy-avatar-1"
MANIFEST: Final = "avatar.json"
ARRAYS: Final = "arrays.npz"
INFLUENCES: Final = 4
"""Most joints that move one vertex, as glTF viewers take them."""
UNITS: Final = {"length": "m", "angle": "rad", "time": "s"}
AXES: Final = {"up": "y", "forward": "z", "left_hand": "x"}
FPS: Final = (1.0, 1000.0)
"""Frame rates at which a network may run [Hz]."""
MOST_BYTES: Final = 512 << 20
"""Of one file of a bundle, packed or not: a garment's is a few million."""
NAME_PATTERN: Final = re.compile(r"[a-z0-9][a-z0-9_-]{0,38}")
"""Names of garments: they become file names and header fields."""


@dataclass(frozen=True, eq=False)
class SkinnedMesh:
    """A triangle mesh in T-pose with sparse skinning weights.

    vertices: (V, 3) float32 [m]. faces: (F, 3) int32, counter-clockwise seen from outside.
    joint_index: (V, 4) uint8. joint_weight: (V, 4) float32, rows sum to one, unused entries are zero.
    region: (V,) uint8 index into ``region_names``.
    """

    vertices: np.ndarray
    faces: np.ndarray
    joint_index: np.ndarray
    joint_weight: np.ndarray
    region: np.ndarray
    region_names: tuple[str, ...] = ("all",)

    @classmethod
    def from_dense(
        cls, vertices: np.ndarray, faces: np.ndarray, weights: np.ndarray, regions: np.ndarray | None = None
    ) -> SkinnedMesh:
        """A mesh from weights (V, 55), at most four of which are not zero per row, and region names (V,).

        Raises CaphyError where a vertex hangs on more than four joints.
        """
        count = np.count_nonzero(weights, axis=1)
        if count.max(initial=0) > INFLUENCES:
            raise CaphyError(
                f"a vertex may hang on at most {INFLUENCES} joints, vertex {int(count.argmax())} hangs on {count.max()}"
            )
        order = np.argsort(-weights, axis=1, kind="stable")[:, :INFLUENCES]
        weight = np.take_along_axis(weights, order, axis=1)
        names, region = np.unique(["all"] * len(vertices) if regions is None else regions, return_inverse=True)
        return cls(
            vertices=np.asarray(vertices, np.float32),
            faces=np.asarray(faces, np.int32),
            joint_index=np.where(weight > 0, order, 0).astype(np.uint8),
            joint_weight=(weight / weight.sum(axis=1, keepdims=True)).astype(np.float32),
            region=region.astype(np.uint8),
            region_names=tuple(str(name) for name in names),
        )

    def dense_weights(self) -> np.ndarray:
        """Skinning weights (V, 55) float64."""
        weights = np.zeros((len(self.vertices), JOINT_COUNT))
        rows = np.arange(len(self.vertices))[:, None]
        np.add.at(weights, (rows, self.joint_index), self.joint_weight)
        return weights

    def posed(self, transforms: np.ndarray) -> np.ndarray:
        """Vertices (T, V, 3) [m] carried by joint transforms (T, 55, 3, 4), see :meth:`AvatarBundle.transforms`."""
        weights, points = self.dense_weights(), self.vertices.astype(np.float64)
        frames = [skin(blend_transforms(weights, part[None]), points)[0] for part in transforms]
        return np.stack(frames)


@dataclass(frozen=True, eq=False)
class BundledGarment:
    """One garment: its mesh, the bytes of its ONNX graph, and the length S of the state the graph carries."""

    name: str
    mesh: SkinnedMesh
    onnx: bytes
    state_size: int


@dataclass(frozen=True, eq=False)
class AvatarBundle:
    """A body and its garments.

    fps: frame rate the garments were trained for [Hz]. joints: (55, 3) rest joints [m]. parents: (55,), root -1.
    licence: of the body and the garments, in words. provenance, metrics: JSON-ready facts of how it came to be.
    """

    name: str
    fps: float
    joints: np.ndarray
    parents: np.ndarray
    body: SkinnedMesh
    garments: tuple[BundledGarment, ...]
    licence: str
    provenance: Mapping[str, Any] = field(default_factory=dict)
    metrics: Mapping[str, Any] = field(default_factory=dict)

    def transforms(self, poses: np.ndarray, transl: np.ndarray) -> np.ndarray:
        """Rest-to-posed joint transforms (T, 55, 3, 4) of poses (T, 55, 3) [rad] and transl (T, 3) [m], both in."""
        rotations = matrix_from_axis_angle(np.asarray(poses, np.float64))
        transforms = joint_transforms(rotations, self.joints, self.parents.tolist())
        transforms[..., 3] += np.asarray(transl, np.float64)[:, None]
        return transforms

    def garment(self, name: str) -> BundledGarment:
        """The garment of that name; raises CaphyError listing those there are."""
        for garment in self.garments:
            if garment.name == name:
                return garment
        names = ", ".join(g.name for g in self.garments)
        raise CaphyError(f"avatar {self.name!r} has no garment {name!r}; it has {names}")


def write_bundle(bundle: AvatarBundle, folder: str | Path) -> None:
    """Write a bundle; a reader sees the old directory or the new one, or for an instant none, never half of one.

    Raises CaphyError where the bundle's arrays do not fit together, or ``folder`` holds something else.
    """
    require_place(Path(folder))
    folder = Path(os.path.realpath(folder))  # a link stays one
    require_consistent(bundle, str(folder))
    files = {ARRAYS: _arrays_bytes(bundle), **{f"{g.name}.onnx": g.onnx for g in bundle.garments}}
    files[MANIFEST] = json.dumps(_manifest(bundle, files), indent=1, allow_nan=False).encode()
    with new_folder(folder) as partial:
        for name, content in files.items():
            (partial / name).write_bytes(content)


def require_place(folder: Path) -> None:
    """Raise :class:`CaphyError` where a bundle would overwrite something else, or the current folder."""
    if not folder.exists():
        return
    if Path.cwd().is_relative_to(folder.resolve()):
        raise CaphyError(f"{folder}: is or holds the current folder, which cannot be replaced; name one in it")
    if not (folder / MANIFEST).is_file():
        if not folder.is_dir() or any(folder.iterdir()):
            raise CaphyError(f"{folder}: exists and is no avatar bundle; choose another place or remove it")
        return
    others = sorted(p.name for p in folder.iterdir() if p.name not in (MANIFEST, ARRAYS) and p.suffix != ".onnx")
    if others:
        raise CaphyError(
            f"{folder}: holds {others[0]}{f' and {len(others) - 1} more' if len(others) > 1 else ''} beside an avatar "
            "bundle, and is replaced whole; move that, or choose another place"
        )


def read_bundle(folder: str | Path) -> AvatarBundle:
    """Read a bundle and check its hashes, shapes and values.

    Raises CaphyError naming the file and what to do.
    """
    folder = Path(folder)
    manifest = _read_manifest(folder)
    try:
        files = {name: _read_hashed(folder, name, entry["sha256"]) for name, entry in manifest["files"].items()}
        arrays = _read_arrays(files[ARRAYS], folder / ARRAYS)
        _require_convention(manifest, folder / MANIFEST)
        bundle = AvatarBundle(
            name=manifest["name"],
            fps=float(manifest["fps"]),
            joints=arrays["joints"],
            parents=np.array(manifest["parents"], np.int32),
            body=_mesh(arrays, "body", manifest["body"]["regions"]),
            garments=tuple(
                BundledGarment(
                    name=g["name"],
                    mesh=_mesh(arrays, f"garment.{g['name']}", g["regions"]),
                    onnx=files[g["model"]],
                    state_size=int(g["state_size"]),
                )
                for g in manifest["garments"]
            ),
            licence=str(manifest["licence"]),
            provenance=manifest["provenance"],
            metrics=manifest["metrics"],
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise CaphyError(
            f"{folder / MANIFEST}: does not follow schema {SCHEMA} ({type(error).__name__}: {error}); export it again"
        ) from error
    require_consistent(bundle, str(folder))
    return bundle


def _require_convention(manifest: Mapping[str, Any], path: Path) -> None:
    """Raise CaphyError where a manifest's numbers mean something else than a bundle's, or its remarks are none."""
    for name, wanted in (("units", UNITS), ("axes", AXES)):
        if manifest[name] != wanted:
            raise CaphyError(f"{path}: {name} must be {wanted}, got {manifest[name]}; export it again")
    for name, kind in (("name", str), ("licence", str), ("provenance", dict), ("metrics", dict)):
        if not isinstance(manifest[name], kind):
            raise TypeError(f"{name} must be a {kind.__name__}, got {manifest[name]!r:.40}")


def require_garment_name(name: str, where: str, remedy: str = "") -> None:
    """Raise CaphyError unless a garment can be part of a bundle by its name."""
    if not NAME_PATTERN.fullmatch(name) or name == "body":
        raise CaphyError(
            f"{where}: garment names are lower-case letters, digits, - and _, 39 at most, and not body, got {name!r}"
            f"{remedy and f'; {remedy}'}"
        )


def require_consistent(bundle: AvatarBundle, where: str) -> None:
    """Raise CaphyError unless names, shapes, indices and values of a bundle fit together."""
    names = [g.name for g in bundle.garments]
    if not names or len(set(names)) < len(names):
        raise CaphyError(f"{where}: an avatar must have garments of different names, got {names}")
    for name in names:
        require_garment_name(name, where)
    if not FPS[0] <= bundle.fps <= FPS[1]:
        raise CaphyError(f"{where}: fps must lie between {FPS[0]:g} and {FPS[1]:g}, got {bundle.fps:g}")
    parents = bundle.parents
    if bundle.joints.shape != (JOINT_COUNT, 3) or not np.isfinite(bundle.joints).all():
        raise CaphyError(f"{where}: joints must be finite of shape ({JOINT_COUNT}, 3), got {bundle.joints.shape}")
    if parents.shape != (JOINT_COUNT,) or parents[0] != -1 or not _is_tree(parents):
        raise CaphyError(f"{where}: parents must name an earlier joint for each of {JOINT_COUNT}, and -1 for the root")
    for name, mesh in [("body", bundle.body), *((g.name, g.mesh) for g in bundle.garments)]:
        _require_mesh(mesh, f"{where}: {name}")
    for garment in bundle.garments:
        if garment.state_size < 0 or not garment.onnx:
            raise CaphyError(f"{where}: {garment.name} must have an ONNX graph and a state size, not negative")


def _is_tree(parents: np.ndarray) -> bool:
    return bool((parents[1:] >= 0).all() and (parents[1:] < np.arange(1, len(parents))).all())


def _require_mesh(mesh: SkinnedMesh, where: str) -> None:
    count = len(mesh.vertices)
    shapes = {
        "vertices": (count, 3),
        "faces": (len(mesh.faces), 3),
        "joint_index": (count, INFLUENCES),
        "joint_weight": (count, INFLUENCES),
        "region": (count,),
    }
    for name, shape in shapes.items():
        if getattr(mesh, name).shape != shape:
            raise CaphyError(f"{where}: {name} must have shape {shape}, got {getattr(mesh, name).shape}")
    if count == 0 or len(mesh.faces) == 0:
        raise CaphyError(f"{where}: the mesh is empty")
    if mesh.faces.min() < 0 or mesh.faces.max() >= count:
        raise CaphyError(f"{where}: faces must index its {count} vertices")
    if mesh.joint_index.max() >= JOINT_COUNT or mesh.region.max() >= len(mesh.region_names):
        raise CaphyError(f"{where}: joint or region index out of range")
    if not np.isfinite(mesh.vertices).all():
        raise CaphyError(f"{where}: vertices must be finite")
    weight = mesh.joint_weight
    if not ((weight >= 0).all() and np.allclose(weight.sum(axis=1), 1, atol=1e-4)):
        raise CaphyError(f"{where}: skinning weights must not be negative and sum to one per vertex")


def _arrays_bytes(bundle: AvatarBundle) -> bytes:
    arrays: dict[str, Any] = {"joints": bundle.joints.astype(np.float64)}
    for key, mesh in [("body", bundle.body), *((f"garment.{g.name}", g.mesh) for g in bundle.garments)]:
        for name in ("vertices", "faces", "joint_index", "joint_weight", "region"):
            arrays[f"{key}.{name}"] = getattr(mesh, name)
    stream = io.BytesIO()
    np.savez_compressed(stream, allow_pickle=False, **arrays)
    return stream.getvalue()


def _manifest(bundle: AvatarBundle, files: Mapping[str, bytes]) -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        "name": bundle.name,
        "units": UNITS,
        "axes": AXES,
        "fps": bundle.fps,
        "joints": list(JOINT_NAMES),
        "parents": bundle.parents.tolist(),
        "licence": bundle.licence,
        "body": _describe(bundle.body),
        "garments": [
            {"name": g.name, "model": f"{g.name}.onnx", "state_size": g.state_size, **_describe(g.mesh)}
            for g in bundle.garments
        ],
        "metrics": dict(bundle.metrics),
        "provenance": dict(bundle.provenance),
        "files": {n: {"sha256": hashlib.sha256(b).hexdigest(), "bytes": len(b)} for n, b in files.items()},
    }


def _describe(mesh: SkinnedMesh) -> dict[str, Any]:
    return {"vertices": len(mesh.vertices), "faces": len(mesh.faces), "regions": list(mesh.region_names)}


def _read_manifest(folder: Path) -> dict[str, Any]:
    path = folder / MANIFEST
    try:
        manifest = json.loads(path.read_bytes())
    except OSError as error:
        raise CaphyError(
            f"{folder}: is no avatar bundle, {MANIFEST} cannot be read ({error.strerror}); write one with caphy export"
        ) from error
    except (ValueError, RecursionError) as error:
        raise CaphyError(f"{path}: is not JSON ({error}); export it again") from error
    if not isinstance(manifest, dict) or manifest.get("schema") != SCHEMA:
        got = manifest.get("schema") if isinstance(manifest, dict) else type(manifest).__name__
        raise CaphyError(f"{path}: must be of schema {SCHEMA!r}, got {got!r}; export it with this version of caphy")
    if manifest.get("joints") != list(JOINT_NAMES):
        raise CaphyError(f"{path}: must list the {JOINT_COUNT} SMPL-X joints in their order; export it again")
    return manifest


def _read_hashed(folder: Path, name: str, expected: str) -> bytes:
    if Path(name).name != name:
        raise CaphyError(f"{folder / MANIFEST}: file names must lie in the bundle itself, got {name!r}")
    try:
        size = (folder / name).stat().st_size
        if size > MOST_BYTES:
            raise CaphyError(f"{folder / name}: may have {MOST_BYTES >> 20} MiB, got {size >> 20}; export it again")
        content = (folder / name).read_bytes()
    except OSError as error:
        raise CaphyError(f"{folder / name}: cannot be read ({error.strerror}); copy the whole bundle again") from error
    found = hashlib.sha256(content).hexdigest()
    if found != expected:
        raise CaphyError(
            f"{folder / name}: is damaged or was exchanged: SHA-256 must be {expected[:12]}..., got {found[:12]}...; "
            "copy or export the bundle again"
        )
    return content


def _read_arrays(content: bytes, path: Path) -> dict[str, np.ndarray]:
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as packed:
            size = sum(entry.file_size for entry in packed.infolist())
        if size > MOST_BYTES:
            raise CaphyError(f"{path}: may unpack to {MOST_BYTES >> 20} MiB, got {size >> 20}; export the bundle again")
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (ValueError, OSError, MemoryError, NotImplementedError, EOFError, zlib.error, zipfile.BadZipFile) as error:
        raise CaphyError(f"{path}: must be an npz of plain arrays ({error}); export the bundle again") from error


def _mesh(arrays: Mapping[str, np.ndarray], key: str, region_names: list[str]) -> SkinnedMesh:
    return SkinnedMesh(
        vertices=arrays[f"{key}.vertices"].astype(np.float32),
        faces=arrays[f"{key}.faces"].astype(np.int32),
        joint_index=arrays[f"{key}.joint_index"].astype(np.uint8),
        joint_weight=arrays[f"{key}.joint_weight"].astype(np.float32),
        region=arrays[f"{key}.region"].astype(np.uint8),
        region_names=tuple(region_names),
    )
