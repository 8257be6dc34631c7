"""What the overlay draws, against inside-tests of single points and against rays cast by another library."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial import Delaunay

from caphy.conventions import JOINT_NAMES
from caphy.io.bundle import AvatarBundle
from service.clients.monocular.overlay import Overlay
from service.clients.monocular.raster import painted

SIZE, FOCAL = (480, 360), 420.0
EYE = np.array([0.3, 0.1, 2.4])


def _inside(triangle: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether points (N, 2) lie in a triangle (3, 2), and whether nearly on its border."""
    sides = np.roll(triangle, -1, axis=0) - triangle
    to = points[:, None] - triangle
    area = sides[:, 0] * to[..., 1] - sides[:, 1] * to[..., 0]
    along = np.einsum("nkc,kc->nk", to, sides) / np.maximum(np.einsum("kc,kc->k", sides, sides), 1e-12)
    away = np.linalg.norm(to - along.clip(0, 1)[..., None] * sides, axis=-1).min(axis=1) > 1e-6
    return (area > 0).all(axis=1) | (area < 0).all(axis=1), away


def test_the_last_triangle_that_covers_a_point_is_found() -> None:
    random = np.random.default_rng(0)
    triangles = random.uniform(-15, 55, (300, 1, 2)) + random.normal(0, 6, (300, 3, 2))
    triangles[:20] += random.normal(0, 200, (20, 3, 2))  # large, and far out
    triangles[20:30, 2] = triangles[20:30, 1]  # of no area
    triangles[30:40] = np.rint(triangles[30:40])  # corners and level edges on points
    points = np.stack(np.meshgrid(np.arange(40), np.arange(30)), axis=-1).reshape(-1, 2)
    expected, sure = np.full(len(points), -1), np.ones(len(points), bool)
    for i, triangle in enumerate(triangles):
        inside, away = _inside(triangle, points)
        expected[inside] = i
        sure &= away
    found = painted(triangles.transpose(2, 1, 0), (40, 30)).ravel()
    assert sure.mean() > 0.6
    assert (expected[sure] >= 0).any()
    np.testing.assert_array_equal(found[sure], expected[sure])


def test_triangles_that_share_edges_leave_no_gap_and_no_overlap() -> None:
    random = np.random.default_rng(1)
    border = [(-1.0, -1.0), (41.0, -1.0), (-1.0, 31.0), (41.0, 31.0)]
    corners = np.concatenate([random.uniform(0, (40, 30), (150, 2)), border])
    triangles = corners[Delaunay(corners).simplices].transpose(2, 1, 0)
    times = sum((painted(triangles[..., i : i + 1], (40, 30)) >= 0).astype(int) for i in range(triangles.shape[2]))
    np.testing.assert_array_equal(times, 1)


def test_no_triangle_covers_nothing() -> None:
    np.testing.assert_array_equal(painted(np.zeros((2, 3, 0)), (4, 3)), np.full((3, 4), -1))


def _reach(rays: np.ndarray, vertices: np.ndarray, faces: np.ndarray, front_only: bool) -> np.ndarray:
    """How far rays (N, 3) from the origin go to a mesh (N,) by embree, infinite where they miss."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    kept = (np.einsum("fc,fc->f", normals, a) < 0) | (not front_only)
    mesh = trimesh.Trimesh(vertices, faces[kept], process=False)
    places, ray, _ = mesh.ray.intersects_location(np.zeros_like(rays), rays, multiple_hits=False)
    reach = np.full(len(rays), np.inf)
    reach[ray] = np.linalg.norm(places, axis=1)
    return reach


@pytest.fixture(scope="module")
def folded(bundle: AvatarBundle) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Somebody with a forearm before the chest and a knee lifted: poses, transl and garments."""
    poses = np.zeros((55, 3))
    bends = {"right_shoulder": (0, 0.3, 1.2), "right_elbow": (0, 1.9, 0), "left_shoulder": (0, 0, -1.0)}
    for name, bend in {**bends, "left_hip": (-1.2, 0, 0), "left_knee": (1.4, 0, 0)}.items():
        poses[JOINT_NAMES.index(name)] = bend
    transforms = bundle.transforms(poses[None], np.zeros((1, 3)))
    worn = {garment.name: garment.mesh.posed(transforms)[0] for garment in bundle.garments}
    return poses, np.zeros(3), worn


def _turn() -> np.ndarray:
    """From the axes of a camera that looks at the belly, leaning a little, to the world's."""
    ahead = -EYE
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.1, 1.0, 0.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(ahead, right), ahead], axis=1)


def test_the_foremost_garment_is_seen_as_rays_see_it(bundle: AvatarBundle, folded: tuple) -> None:
    """Pixels whose four corners and middle see the same: that garment's colour, or the picture where there is none.

    Skin hides clothes where it is clearly before them; where it is near them either may be seen.
    """
    poses, transl, worn = folded
    pixels = np.random.default_rng(0).integers(90, 110, (SIZE[1], SIZE[0], 3)).astype(np.uint8)
    drawn = Overlay(bundle, FOCAL, SIZE).draw(pixels, poses, transl, worn, _turn(), EYE)
    random = np.random.default_rng(3)
    places = np.column_stack([random.integers(150, 330, 900), random.integers(90, 350, 900)])
    around = np.array([(0.5, 0.5), (0, 0), (1, 0), (0, 1), (1, 1)])
    spots = (places[:, None] + around).reshape(-1, 2)
    rays = np.concatenate([(spots - np.array(SIZE) / 2) / FOCAL, np.ones((len(spots), 1))], axis=1) @ _turn().T
    body = bundle.body.posed(bundle.transforms(poses[None], transl[None]))[0]
    reach = [_reach(rays, body - EYE, bundle.body.faces, front_only=False)]
    reach += [_reach(rays, worn[g.name] - EYE, g.mesh.faces, front_only=True) for g in bundle.garments]
    reach = np.stack(reach).reshape(len(reach), len(places), len(around))
    near = reach[1:].min(axis=0)
    which = np.where(np.isfinite(near), 1 + reach[1:].argmin(axis=0), 0)
    which = np.where(reach[0] < near - 0.04, 0, which)  # bare or not: nothing is drawn before it
    sure = (which == which[:, :1]).all(axis=1) & ~((reach[0] < near) & (reach[0] > near - 0.04)).any(axis=1)
    nearest = np.sort(reach[1:].clip(0, 99), axis=0)
    sure &= (nearest[1] - nearest[0] > 0.01).all(axis=1) | (which[:, 0] == 0)
    colour = drawn[places[:, 1], places[:, 0]].astype(float)
    untouched = (colour == pixels[places[:, 1], places[:, 0]]).all(axis=1)
    redder = colour[:, 2] > colour[:, 0]  # the shirt is orange, trousers are blue
    names = ["", *(g.name for g in bundle.garments)]
    expected = np.array(names)[which[:, 0]]
    seen = np.where(untouched, "", np.where(redder, "tshirt", "trousers"))
    assert [(expected[sure] == name).sum() > 40 for name in ("", "tshirt", "trousers")] == [True] * 3
    assert (seen[sure] == expected[sure]).mean() > 0.99


def test_a_hand_before_the_clothes_stays_as_filmed(bundle: AvatarBundle, folded: tuple) -> None:
    poses, transl, worn = folded
    pixels = np.full((SIZE[1], SIZE[0], 3), 100, np.uint8)
    drawn = Overlay(bundle, FOCAL, SIZE).draw(pixels, poses, transl, worn, _turn(), EYE)
    moved = bundle.transforms(poses[None], transl[None])[0]
    joints = np.einsum("jab,jb->ja", moved[..., :3], bundle.joints) + moved[..., 3]
    seen = (joints - EYE) @ _turn()
    x, y = (FOCAL * seen[:, :2] / seen[:, 2:] + np.array(SIZE) / 2).astype(int).T
    wrist, chest = JOINT_NAMES.index("right_wrist"), JOINT_NAMES.index("spine2")
    ray = (_turn() @ [(x[wrist] + 0.5 - SIZE[0] / 2) / FOCAL, (y[wrist] + 0.5 - SIZE[1] / 2) / FOCAL, 1.0])[None]
    behind = [_reach(ray, worn[g.name] - EYE, g.mesh.faces, front_only=True)[0] for g in bundle.garments]
    assert np.linalg.norm(joints[wrist] - EYE) < min(behind) < 5.0  # there are clothes that the hand hides
    assert (drawn[y[wrist], x[wrist]] == 100).all()
    assert (drawn[y[chest], x[chest]] != 100).any()


def test_what_is_behind_or_beside_the_camera_is_not_drawn(bundle: AvatarBundle, folded: tuple) -> None:
    poses, transl, worn = folded
    pixels = np.full((SIZE[1], SIZE[0], 3), 100, np.uint8)
    overlay = Overlay(bundle, FOCAL, SIZE)
    for origin in (EYE + 6 * _turn()[:, 2], EYE + 30 * _turn()[:, 0]):
        np.testing.assert_array_equal(overlay.draw(pixels, poses, transl, worn, _turn(), origin), pixels)
    inside = overlay.draw(pixels, poses, transl, worn, _turn(), np.zeros(3))
    assert inside.shape == pixels.shape


def test_edges_are_mixed_with_the_picture(bundle: AvatarBundle, folded: tuple) -> None:
    """No dark rim: over a picture of one colour every pixel of an outline lies between it and the cloth's."""
    poses, transl, worn = folded
    pixels = np.full((SIZE[1], SIZE[0], 3), 255, np.uint8)
    drawn = Overlay(bundle, FOCAL, SIZE).draw(pixels, poses, transl, worn, _turn(), EYE).astype(int)
    cloth = (drawn != 255).any(axis=2).astype(np.uint8)
    rim = (cloth - cv2.erode(cloth, np.ones((3, 3), np.uint8))).astype(bool)
    assert rim.sum() > 300
    within = cv2.erode(cloth, np.ones((5, 5), np.uint8)).astype(bool)
    assert drawn[rim].min(axis=1).mean() > drawn[within].min(axis=1).mean()
    assert drawn[rim].max(axis=1).min() >= drawn[within].max(axis=1).min() - 5
