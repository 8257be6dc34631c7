"""Trained avatars on the motion of a measurement: the exported ONNX graph, frame after frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from caphy.body.bundled import default_body
from caphy.body.kinematics import joint_transforms
from caphy.body.skinning import blend_transforms, skin
from caphy.conventions import BODY_JOINT_COUNT
from caphy.errors import CaphyError
from caphy.io.bundle import AvatarBundle, BundledGarment
from caphy.io.measurements import Measurement
from caphy.io.poses import PoseSequence
from caphy.measure.pace import PACE
from caphy.measure.prediction import Prediction
from caphy.measure.scene import one_mesh
from caphy.measure.windows import LENGTH
from caphy.rotations import matrix_from_axis_angle

_SAME_BODY = 0.02  # [m]
_CHUNK = 120
_GROUP = LENGTH / PACE  # seconds of rows that belong together when uncertainty is told, as in windows of the solver


def predict_with_avatar(measurement: Measurement, bundle: AvatarBundle, garment: BundledGarment) -> Prediction:
    """What an avatar's garment does in a measured motion, preroll included, at the measured frames.

    The network runs at the bundle's frame rate; positions between its frames are interpolated linearly.

    Raises:
        CaphyError: the measurement has no poses, or the graph cannot be run.
    """
    measurement = measurement.about(bundle.joints[0])
    motion, before = _motion(measurement)
    assert measurement.poses is not None and measurement.transl is not None
    resampled = motion.resample(bundle.fps)
    vertices = run_graph(garment, resampled.poses, resampled.transl)
    frames = measurement.seen_frames
    place = (frames + before) * bundle.fps / measurement.fps
    reached = place <= len(vertices) - 1 + 1e-6  # the network's last frame may lie before the measurement's
    if reached.any():
        frames, place = frames[reached], place[reached]
    place = np.clip(place, 0, len(vertices) - 1)
    first = np.minimum(place.astype(int), max(len(vertices) - 2, 0))
    share = (place - first)[:, None, None]
    second = np.minimum(first + 1, len(vertices) - 1)
    faces = garment.mesh.faces
    return Prediction(
        frames=frames,
        vertices=(1 - share) * vertices[first] + share * vertices[second],
        faces=faces,
        registered=measurement.faces is not None and measurement.registered and one_mesh(measurement.faces, faces),
        lag=None,
        window=np.floor(frames / (_GROUP * measurement.fps) + 1e-9).astype(int),
        converged=np.ones(len(frames), bool),
        material=measurement.material,
        body_vertices=_body(bundle, measurement.poses[frames], measurement.transl[frames]),
        body_faces=bundle.body.faces,
        cautions=_another_body(measurement, bundle),
    )


def _another_body(measurement: Measurement, bundle: AvatarBundle) -> tuple[str, ...]:
    """What must be said where the measured body is not the avatar's."""
    if measurement.betas is None:
        return ()
    joints = default_body().rest(measurement.betas)[1]
    apart = np.linalg.norm((joints - joints[0]) - (bundle.joints - bundle.joints[0]), axis=1)[:BODY_JOINT_COUNT].max()
    if apart < _SAME_BODY:
        return ()
    return (
        f"the measured body's betas put its joints up to {1000 * apart:.0f} mm from where the avatar's are in the rest "
        "pose; an avatar wears its clothes on its own body",
    )


def matching_garment(measurement: Measurement, bundle: AvatarBundle, name: str | None = None) -> BundledGarment:
    """The avatar's garment to compare: the named one, the one with the measured mesh, or the only one there is."""
    same = [g for g in bundle.garments if measurement.faces is not None and one_mesh(g.mesh.faces, measurement.faces)]
    if name is not None:
        named = bundle.garment(name)
        if same and named not in same:
            raise CaphyError(
                f"{measurement.source}: its mesh is the avatar's {same[0].name}, not its {name}; give --garment "
                f"{same[0].name}, or leave --garment out"
            )
        return named
    if len(same) == 1 or len(bundle.garments) == 1:
        return (same or list(bundle.garments))[0]
    names = ", ".join(g.name for g in bundle.garments)
    raise CaphyError(
        f"{measurement.source}: which garment of avatar {bundle.name!r} is it? Give --garment, one of {names}"
    )


def run_graph(garment: BundledGarment, poses: np.ndarray, transl: np.ndarray) -> np.ndarray:
    """Vertices (T, V, 3) [m] of poses (T, 55, 3) [rad] and translations (T, 3) [m], from the initial state."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    try:
        session = onnxruntime.InferenceSession(garment.onnx, options, providers=["CPUExecutionProvider"])
        state, parts = np.zeros(garment.state_size, np.float32), []
        for start in range(0, len(poses), _CHUNK):
            chunk = slice(start, start + _CHUNK)
            feed = {
                "poses": poses[chunk].astype(np.float32),
                "transl": transl[chunk].astype(np.float32),
                "state": state,
            }
            vertices, state = session.run(["vertices", "next_state"], feed)
            parts.append(vertices)
    except Exception as error:
        raise CaphyError(f"garment {garment.name!r}: its graph cannot be run: {error}; export it again") from error
    return np.concatenate(parts).astype(np.float64)


def _body(bundle: AvatarBundle, poses: np.ndarray, transl: np.ndarray) -> np.ndarray:
    """The avatar's body (N, B, 3) [m] in poses (N, 55, 3) [rad] moved by ``transl`` (N, 3) [m]."""
    transforms = joint_transforms(matrix_from_axis_angle(poses), bundle.joints, bundle.parents)
    blended = blend_transforms(bundle.body.dense_weights(), transforms)
    return skin(blended, bundle.body.vertices.astype(np.float64)) + transl[:, None]


def _motion(measurement: Measurement) -> tuple[PoseSequence, int]:
    """Preroll and motion as one sequence, and the number of preroll frames."""
    if measurement.poses is None or measurement.transl is None:
        where = measurement.source or measurement.name
        raise CaphyError(
            f"{where}: an avatar is driven by poses (T, 55, 3) and transl (T, 3); the measurement has none"
        )
    motion = PoseSequence(measurement.poses, measurement.transl, measurement.fps, source=measurement.source)
    if measurement.preroll_poses is None or measurement.preroll_transl is None:
        return motion, 0
    poses = np.concatenate([measurement.preroll_poses, measurement.poses])
    transl = np.concatenate([measurement.preroll_transl, measurement.transl])
    return replace(motion, poses=poses, transl=transl), len(measurement.preroll_poses)
