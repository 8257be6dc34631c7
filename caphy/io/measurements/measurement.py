"""Cloth in motion as a camera rig saw it, checked when it is made."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from caphy.conventions import JOINT_COUNT
from caphy.errors import CaphyError

INTEGERS = ("faces", "offsets", "pinned", "body_faces")
"""Fields that hold indices."""
PLAIN = ("name", "fps", "noise_mm", "source", "notes", "numbering")
"""Attributes that are no arrays."""


@dataclass(frozen=True, eq=False)
class Measurement:
    """T frames of a piece of cloth at a steady frame rate, in metres with y up (see docs/measurements.md).

    The cloth is either registered (``vertices``) or a cloud per frame (``points`` and ``offsets``). It hangs on pins
    (``pinned``), on a posed body (``poses``), on a body mesh (``body_vertices``), or on nothing. Missing frames are
    frames whose vertices are all NaN, or whose cloud is empty; holes are vertices that are NaN or not visible.

    Raises :class:`CaphyError`, naming the source and the key, where shapes or values do not fit together.
    """

    name: str
    fps: float
    """Frames per second [Hz]."""
    vertices: np.ndarray | None = None
    """Registered positions (T, V, 3) [m]; NaN where nothing was seen."""
    points: np.ndarray | None = None
    """All frames' clouds one after another (N, 3) [m]."""
    offsets: np.ndarray | None = None
    """Where each frame's cloud starts in ``points``, and N at the end (T + 1,)."""
    faces: np.ndarray | None = None
    """Triangles (F, 3), counter-clockwise seen from outside."""
    rest_vertices: np.ndarray | None = None
    """The cloth without load (V, 3) [m]; for clothing on the body's T-pose."""
    material: np.ndarray | None = None
    """Flat rest shape of each face in its thread frame (F, 3, 2) [m]: weft u, warp v."""
    regions: np.ndarray | None = None
    """Name of the part each vertex belongs to (V,)."""
    weights: np.ndarray | None = None
    """Skinning weights of clothing (V, 55)."""
    layer_thickness: np.ndarray | None = None
    """Extra distance each vertex keeps from the body (V,) [m]."""
    attached: np.ndarray | None = None
    """Strength in [0, 1] with which each vertex is held to the body (V,)."""
    poses: np.ndarray | None = None
    """SMPL-X joint rotations (T, 55, 3) [rad]."""
    transl: np.ndarray | None = None
    """Translation added after posing (T, 3) [m]."""
    pelvis: np.ndarray | None = None
    """Where the pelvis of the body that ``transl`` refers to rests (3,) [m]; that of the body in use unless given."""
    betas: np.ndarray | None = None
    """Shape of the body (B,)."""
    preroll_poses: np.ndarray | None = None
    """The motion that led to the first frame (P, 55, 3) [rad]."""
    preroll_transl: np.ndarray | None = None
    """(P, 3) [m]."""
    body_vertices: np.ndarray | None = None
    """The body as a moving closed mesh (T, B, 3) [m]."""
    body_faces: np.ndarray | None = None
    """Its triangles (G, 3), counter-clockwise seen from outside."""
    pinned: np.ndarray | None = None
    """Indices of the vertices that are held (P,)."""
    pinned_positions: np.ndarray | None = None
    """Where they are held (T, P, 3) [m]."""
    visibility: np.ndarray | None = None
    """Whether each vertex was really seen (T, V); positions that were filled in count as holes."""
    noise: np.ndarray | None = None
    """Standard deviation of each coordinate, per vertex (V,), per frame and vertex (T, V), or per point (N,) [m]."""
    noise_mm: float | None = None
    """Standard deviation of each coordinate of all points [mm]."""
    source: str = ""
    """The file it came from."""
    notes: tuple[str, ...] = ()
    """What the reader had to assume, in plain words."""
    numbering: tuple[int, int] = (0, 1)
    """The number that the first frame has in its source, and by how much the numbers of frames rise."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is not None and field.name not in PLAIN:
                object.__setattr__(self, field.name, self._array(field.name, value))
        if (self.vertices is None) == (self.points is None):
            raise self.error("must hold either registered 'vertices' (T, V, 3) or 'points' (N, 3) with 'offsets'")
        if not (np.isfinite(self.fps) and self.fps > 0):
            raise self.error(f"fps must be positive [Hz], got {self.fps}")
        if self.noise_mm is not None and not (np.isfinite(self.noise_mm) and self.noise_mm >= 0):
            raise self.error(f"noise_mm must not be negative, got {self.noise_mm}")
        if self.noise_mm is not None and self.noise is not None:
            raise self.error("must state either 'noise', of each point [m], or 'noise_mm', of all; it has both")
        self._require_groups()
        self._require_shapes()
        self._require_values()

    def __len__(self) -> int:
        """Number of frames T."""
        return len(self.vertices) if self.vertices is not None else len(self.offsets) - 1  # type: ignore[arg-type]

    @property
    def registered(self) -> bool:
        """Whether the same vertices were followed through all frames."""
        return self.vertices is not None

    @property
    def vertex_count(self) -> int | None:
        """Number of vertices V of the cloth; none for clouds without a mesh."""
        if self.rest_vertices is not None:
            return len(self.rest_vertices)
        return None if self.vertices is None else self.vertices.shape[1]

    @cached_property
    def observed(self) -> np.ndarray:
        """Which vertices of a registered measurement were seen, (T, V)."""
        if self.vertices is None:
            raise CaphyError(f"{self.source or self.name}: a point cloud has no vertices; register it first")
        seen = np.asarray(np.isfinite(self.vertices).all(axis=-1))
        return seen if self.visibility is None else seen & self.visibility

    @cached_property
    def seen_vertices(self) -> np.ndarray:
        """Vertices (T, V, 3) [m] of a registered measurement, NaN where not seen, whatever is written there."""
        return np.where(self.observed[..., None], self.vertices, np.nan)  # type: ignore[arg-type]

    @cached_property
    def seen_frames(self) -> np.ndarray:
        """Frames in which anything was seen, (K,)."""
        if self.registered:
            return np.flatnonzero(self.observed.any(axis=1))
        return np.flatnonzero(np.diff(self.offsets) > 0)  # type: ignore[arg-type]

    def cloud(self, frame: int) -> np.ndarray:
        """The points seen in a frame (n, 3) [m]."""
        if self.vertices is not None:
            return self.vertices[frame][self.observed[frame]]
        assert self.points is not None and self.offsets is not None
        return self.points[self.offsets[frame] : self.offsets[frame + 1]]

    def number(self, frame: int | np.integer) -> int:
        """The number that a frame has in the source, to tell it by."""
        first, step = self.numbering
        return first + step * int(frame)

    def with_notes(self, *notes: str) -> Measurement:
        """The same measurement with further remarks."""
        return replace(self, notes=(*self.notes, *notes))

    def about(self, pelvis: np.ndarray) -> Measurement:
        """The same with ``transl`` as a body whose pelvis rests at ``pelvis`` (3,) [m] is moved by."""
        if self.pelvis is None:
            return self
        given = {name: getattr(self, name) for name in ("transl", "preroll_transl")}
        moved = {name: value + self.pelvis - pelvis for name, value in given.items() if value is not None}
        return replace(self, pelvis=None, **moved)

    def every(self, step: int) -> Measurement:
        """The first and each further ``step``-th frame, at a rate so many times lower; the preroll likewise."""
        kept = np.arange(0, len(self), step)
        of_frames = ("vertices", "poses", "transl", "body_vertices", "pinned_positions", "visibility")
        fewer = {name: value[kept] for name in of_frames if (value := getattr(self, name)) is not None}
        if self.preroll_poses is not None and self.preroll_transl is not None:
            led = slice(len(self.preroll_poses) % step, None, step)  # the last of them a step before the first frame
            fewer |= {"preroll_poses": self.preroll_poses[led], "preroll_transl": self.preroll_transl[led]}
        if self.noise is not None and self.noise.ndim == 2:
            fewer["noise"] = self.noise[kept]
        if self.points is not None and self.offsets is not None:
            seen = np.diff(self.offsets)
            of_kept = np.repeat(np.arange(len(self)) % step == 0, seen)
            fewer |= {"points": self.points[of_kept], "offsets": np.r_[0, np.cumsum(seen[kept])]}
            if self.noise is not None:
                fewer["noise"] = self.noise[of_kept]
        numbering = (self.numbering[0], step * self.numbering[1])
        return replace(self, fps=self.fps / step, numbering=numbering, **fewer)

    def error(self, message: str) -> CaphyError:
        """What is wrong with this measurement, with its file before it."""
        return CaphyError(f"{self.source or self.name or 'measurement'}: {message}")

    def _array(self, name: str, value: object) -> np.ndarray:
        array = np.asarray(value)
        wanted = "U" if name == "regions" else "biuf"
        if name in INTEGERS and array.dtype.kind == "b":
            raise self.error(f"{name} must be indices, got a mask; give numpy.flatnonzero of it")
        if array.dtype.kind not in wanted:
            raise self.error(f"{name} must be {'text' if wanted == 'U' else 'numbers'}, got {array.dtype}")
        if name == "regions":
            return array
        if name in INTEGERS and array.dtype.kind == "f" and not np.array_equal(array, np.round(array)):
            raise self.error(f"{name} must be whole numbers (indices), got {array.dtype}")
        if name == "visibility" and not np.isin(array, (0, 1)).all():
            raise self.error("visibility must be true or false (1 or 0); compare confidences with a limit of your own")
        dtype = np.int64 if name in INTEGERS else bool if name == "visibility" else np.float64
        return np.ascontiguousarray(array, dtype=dtype)

    def _require_groups(self) -> None:
        """Keys that only mean something together."""
        for names in (
            ("points", "offsets"),
            ("poses", "transl"),
            ("preroll_poses", "preroll_transl"),
            ("body_vertices", "body_faces"),
            ("pinned", "pinned_positions"),
        ):
            given = [name for name in names if getattr(self, name) is not None]
            if len(given) == 1:
                missing = next(name for name in names if name not in given)
                raise self.error(f"{given[0]} needs {missing} beside it")
        if self.registered and self.faces is None:
            raise self.error("registered vertices need 'faces' (F, 3)")

    def _require_shapes(self) -> None:
        if self.vertices is not None and self.vertices.ndim != 3:
            raise self.error(f"vertices must have shape (T, V, 3), got {self.vertices.shape}")
        if self.offsets is not None and (self.offsets.ndim != 1 or len(self.offsets) < 2):
            raise self.error(f"offsets must have shape (T + 1,), got {self.offsets.shape}")
        if len(self) == 0:
            raise self.error("holds no frames")
        t, v = len(self), self.vertex_count
        f = None if self.faces is None else len(self.faces)
        p = None if self.pinned is None else len(self.pinned)
        shapes: dict[str, tuple[int | None, ...]] = {
            "vertices": (t, v, 3),
            "points": (None, 3),
            "faces": (None, 3),
            "rest_vertices": (None, 3),
            "material": (f, 3, 2),
            "regions": (v,),
            "weights": (v, JOINT_COUNT),
            "layer_thickness": (v,),
            "attached": (v,),
            "poses": (t, JOINT_COUNT, 3),
            "transl": (t, 3),
            "pelvis": (3,),
            "betas": (None,),
            "preroll_poses": (None, JOINT_COUNT, 3),
            "preroll_transl": (None if self.preroll_poses is None else len(self.preroll_poses), 3),
            "body_vertices": (t, None, 3),
            "body_faces": (None, 3),
            "pinned": (None,),
            "pinned_positions": (t, p, 3),
            "visibility": (t, v),
        }
        for name, shape in shapes.items():
            self._require_shape(name, shape, t)
        allowed = {(v,), (t, v)} if self.registered else {(len(self.points),)}  # type: ignore[arg-type]
        if self.noise is not None and self.noise.shape not in allowed:
            raise self.error(f"noise must have shape {' or '.join(map(str, allowed))}, got {self.noise.shape}")

    def _require_shape(self, name: str, shape: tuple[int | None, ...], frames: int) -> None:
        value = getattr(self, name)
        if value is None:
            return
        fits = value.ndim == len(shape) and all(w in (None, n) for w, n in zip(shape, value.shape, strict=True))
        if fits:
            return
        wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ("," if len(shape) == 1 else "") + ")"
        hint = ""
        if value.ndim == len(shape) and shape[0] == frames and value.shape[1:] == shape[1:]:
            hint = (
                f"; the cloth has {frames} frames at {self.fps:g} fps. If {name} was recorded at another rate "
                f"({len(value) / frames * self.fps:.4g} fps?), resample it to the cloth's; if "
                "the file has frame_index or frame_count, check those"
            )
        elif name.endswith("poses") and value.ndim == 3 and value.shape[-1] == 3 and value.shape[1] != JOINT_COUNT:
            hint = (
                f"; SMPL-X has {JOINT_COUNT} joints, these are {value.shape[1]}: convert them with caphy poses convert"
            )
        elif name == "preroll_transl":
            hint = "; one place for each of preroll_poses"
        elif value.ndim == len(shape) and value.shape[-1:] == shape[-1:]:
            hint = "; do the mesh and the recording have the same topology?"
        raise self.error(f"{name} must have shape {wanted}, got {value.shape}{hint}")

    def _require_values(self) -> None:
        for name in ("points", "rest_vertices", "material", "weights", "poses", "transl", "pelvis", "body_vertices"):
            self._require_finite(name)
        for name in ("layer_thickness", "attached", "betas", "preroll_poses", "preroll_transl", "pinned_positions"):
            self._require_finite(name)
        if self.offsets is not None and self.points is not None:
            rising = (
                self.offsets[0] == 0 and (np.diff(self.offsets) >= 0).all() and self.offsets[-1] == len(self.points)
            )
            if not rising:
                raise self.error(f"offsets must rise from 0 to the number of points, {len(self.points)}")
        count = self.vertex_count
        for name, limit in (("faces", count), ("pinned", count), ("body_faces", _second(self.body_vertices))):
            index = getattr(self, name)
            if index is not None and limit is not None and len(index) and not 0 <= index.min() <= index.max() < limit:
                raise self.error(
                    f"{name} must index {limit} vertices, got {index.min()} to {index.max()}; is it of another mesh, "
                    "or counted from 1?"
                )
        if self.pinned is not None and len(np.unique(self.pinned)) < len(self.pinned):
            raise self.error("pinned must name each held vertex once")
        if self.pinned is not None and not 0 < len(self.pinned) < (count or np.inf):
            raise self.error(
                f"pinned must hold some of the {count} vertices, and not all, got {len(self.pinned)}; leave pinned and "
                "pinned_positions out where nothing is held"
            )
        self._require_no_infinity()
        if len(self.seen_frames) == 0:
            raise self.error("no frame shows anything: all vertices are NaN or not visible")
        if self.attached is not None and not 0 <= self.attached.min() <= self.attached.max() <= 1:
            raise self.error(
                f"attached must lie between 0 (free) and 1 (held to the body), got {self.attached.min():g} to "
                f"{self.attached.max():g}"
            )
        if self.noise is not None and (np.isnan(self.noise).all() or np.nanmin(self.noise) < 0):
            raise self.error("noise must be standard deviations in metres, not negative")

    def _require_no_infinity(self) -> None:
        """Of vertices; what was not seen is NaN."""
        if self.vertices is None:
            return
        infinite = np.isinf(self.vertices).any(axis=-1) & (True if self.visibility is None else self.visibility)
        if not infinite.any():
            return
        frame, vertex = map(int, np.argwhere(infinite)[0])
        raise self.error(
            "vertices must be finite, or NaN where they were not seen, got infinity in frame "
            f"{self.number(frame)}, vertex {vertex}"
        )

    def _require_finite(self, name: str) -> None:
        value = getattr(self, name)
        if value is None or np.isfinite(value).all():
            return
        place = tuple(int(i) for i in np.argwhere(~np.isfinite(value))[0])
        hint = "; leave points that were not seen out of the cloud" if name == "points" else ""
        raise self.error(f"{name} must be finite, got {value[place]} at index {place}{hint}")


def _second(array: np.ndarray | None) -> int | None:
    return None if array is None else array.shape[1]
