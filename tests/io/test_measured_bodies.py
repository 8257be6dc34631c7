"""Bodies that cannot have worn the cloth that was measured are told from those that can."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_measurements import dressed

from caphy.body.bundled import default_body
from caphy.errors import CaphyError
from caphy.io.measurements import Measurement, read_measurement, write_measurement
from caphy.io.measurements.checks import require_plausible
from caphy.io.poses import PoseSequence, write_poses
from caphy.measure.scene import Scene
from caphy.rotations import axis_angle_from_matrix, matrix_from_axis_angle

Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def bodied(**changes) -> Measurement:
    """The vest, its body given as a mesh alone."""
    body, worn = default_body(), dressed()
    given = replace(worn, body_vertices=body.pose(worn.poses, worn.transl), body_faces=body.faces)
    return replace(given, **({"poses": None, "transl": None} | changes))


def changed_body(change) -> Measurement:
    return bodied(body_vertices=change(bodied().body_vertices))


def turned_over() -> Measurement:
    """Cloth and body with z up."""
    worn = dressed()
    root = default_body().joints[0]
    poses = worn.poses.copy()
    poses[:, 0] = axis_angle_from_matrix(Z_UP @ matrix_from_axis_angle(poses[:, 0]))
    return replace(worn, vertices=worn.vertices @ Z_UP.T, poses=poses, transl=(worn.transl + root) @ Z_UP.T - root)


def turned_cloth() -> Measurement:
    """Cloth and places with z up, and poses that stand along y."""
    worn, root = dressed(), default_body().joints[0]
    return replace(worn, vertices=worn.vertices @ Z_UP.T, transl=(worn.transl + root) @ Z_UP.T - root)


def waving() -> Measurement:
    """Both arms, from above the head to the hips and back."""
    worn = dressed(24)
    poses = worn.poses.copy()
    poses[:, 16:18, 2] += 1.5 * np.sin(0.5 * np.arange(len(poses)))[:, None]
    return replace(worn, poses=poses)


def shuffled() -> Measurement:
    """The same in no order."""
    return replace(waving(), poses=waving().poses[np.random.default_rng(0).permutation(24)])


def away_at(frame: int) -> Measurement:
    transl = dressed().transl.copy()
    transl[frame, 0] += 2.0
    return replace(dressed(), transl=transl)


def led_by(transl: np.ndarray) -> Measurement:
    return replace(dressed(), preroll_poses=dressed().poses[:3], preroll_transl=dressed().transl[:3] + transl)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: changed_body(lambda x: x * 1000), "body_vertices must be in metres"),
        (lambda: changed_body(lambda x: x + np.array([1.0, 0, 0])), "m from its body; vertices and body_vertices"),
        (lambda: bodied(body_faces=default_body().faces[::-1][:-400]), "of its edges belong to one face only"),
        (lambda: bodied(body_faces=default_body().faces[:, ::-1]), "inside out"),
        (
            lambda: bodied(
                body_vertices=bodied().body_vertices + np.array([0.6, 0, 0]),
                poses=dressed().poses,
                transl=dressed().transl,
            ),
            "half of the joints that the poses give lie",
        ),
        (turned_over, "the body stands along z.*state up_axis = 'z'"),
        (turned_cloth, "the cloth is turned by .* degrees against its rest shape"),
        (
            lambda: replace(dressed(), rest_vertices=dressed().vertices[0] + np.array([1.0, 0, 0])),
            "give rest_vertices on the body's T",
        ),
        (shuffled, "the poses look shuffled"),
        (lambda: away_at(4), "in frame 4 the cloth lies .* m from the joints"),
        (lambda: led_by(np.array([5.0, 0, 0])), "from the last frame of the preroll to the first"),
        (lambda: replace(dressed(), poses=np.degrees(dressed().poses)), "are they degrees"),
    ],
    ids=[
        "millimetres",
        "beside the cloth",
        "open",
        "inside out",
        "away from its poses",
        "z up",
        "cloth turned",
        "rest shape elsewhere",
        "poses shuffled",
        "away for one frame",
        "preroll elsewhere",
        "degrees",
    ],
)
def test_a_body_that_cannot_have_worn_it_is_refused(make, says):
    with pytest.raises(CaphyError, match=says):
        require_plausible(make(), axes_stated=False)


@pytest.mark.parametrize(
    ("make", "stated"),
    [
        (dressed, False),
        (bodied, False),
        (lambda: bodied(poses=dressed().poses, transl=dressed().transl), False),
        (waving, False),
        (lambda: led_by(np.zeros(3)), False),
        (turned_over, True),
    ],
    ids=["poses", "mesh", "both", "waving", "preroll", "lying down, as stated"],
)
def test_one_that_can_is_believed(make, stated):
    require_plausible(make(), axes_stated=stated)


@pytest.mark.parametrize("up", ["y", "z"])
def test_a_folder_s_poses_stand_where_their_file_says_whatever_pelvis_and_axes_it_has(tmp_path, up):
    """A translation refers to where the pelvis of its own body rests: 35 cm lower in SMPL-X than in the bundled one."""
    worn, body = dressed(), default_body()
    world = worn.vertices if up == "y" else worn.vertices @ Z_UP.T
    write_measurement(replace(worn, poses=None, transl=None, vertices=world), tmp_path / "vest")
    motion = PoseSequence(worn.poses, worn.transl, worn.fps, pelvis=body.joints[0])
    write_poses(motion.about(np.array([0.003, -0.351, 0.012])), tmp_path / "vest" / "walk.npz")
    told = tmp_path / "vest" / "measurement.toml"
    told.write_text(told.read_text().replace('up_axis = "y"', f'up_axis = "{up}"') + 'poses = "walk.npz"\n')
    read = read_measurement(tmp_path / "vest")
    scene = Scene.of(read)
    np.testing.assert_allclose(scene.motion.poses.transl, worn.transl, atol=1e-6)
    np.testing.assert_allclose(scene.measurement.vertices, worn.vertices, atol=1e-5)
    write_measurement(read, tmp_path / "vest.npz")
    again = read_measurement(tmp_path / "vest.npz").about(body.joints[0])
    np.testing.assert_allclose(again.transl, worn.transl, atol=1e-6)
    assert again.pelvis is None and again.about(np.ones(3)) is again
