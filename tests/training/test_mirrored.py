"""Scans in a mirror: the garment fits the image as it fits the scan, and one-sided clothes have none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_scans import posed, scan, write_run
from small_world import swaying, tube

from caphy.body.bundled import default_body
from caphy.body.surface import nearest_on_surface
from caphy.cli import main
from caphy.garment.template import Garment
from caphy.io.poses import write_poses
from caphy.training.mirrored import symmetric, with_mirror_images


def one_sided() -> Garment:
    """The tube, 4 cm longer on the left."""
    garment = tube()
    lower = 0.04 * np.clip(garment.vertices[:, 0] / 0.1, 0, 1) * (garment.vertices[:, 1] < -0.1)
    return replace(garment, vertices=garment.vertices - lower[:, None] * np.array([0, 1, 0]))


def test_the_garment_in_the_mirrored_pose_fits_the_image_as_it_fits_the_scan():
    garment, body = tube(), default_body()
    shown = replace(scan(1), transl=np.array([0.7, 0.1, -0.3]))
    along = (shown.transl - scan(1).transl).astype(np.float32)
    shown = replace(shown, lower=shown.lower + along, body=shown.body + along)
    own, image = with_mirror_images([shown], body.joints[0])
    assert own is shown and image.name == "scan1, mirrored"
    apart = [
        nearest_on_surface(each.lower, posed(garment.vertices, garment.weights, each.pose, each.transl), garment.faces)
        for each in (own, image)
    ]
    np.testing.assert_allclose(apart[1].distance, apart[0].distance, atol=1e-4)
    assert np.abs(image.lower[:, 0].mean() + own.lower[:, 0].mean()) < 1e-6 and abs(own.lower[:, 0].mean()) > 0.5
    # Nor is the bundled body quite the same on both sides.
    skin = body.pose(image.pose[None], image.transl[None])[0]
    assert np.quantile(np.abs(nearest_on_surface(image.body, skin, body.faces).distance), 0.95) < 0.002


def test_what_is_the_same_on_both_sides():
    garment, body = tube(), default_body()
    assert symmetric([(body.v_template, body.faces), (garment.vertices, garment.faces)])
    assert not symmetric([(body.v_template, body.faces), (one_sided().vertices, garment.faces)])


@pytest.mark.parametrize(("garment", "told"), [(tube(), "5 scans and their mirror images,"), (one_sided(), "5 scans,")])
def test_training_says_whether_it_learns_from_images(garment, told, tmp_path, capsys):
    run = write_run(tmp_path / "run")
    garment.save(run / "lower.npz")
    write_poses(swaying(40, 0), tmp_path / "motion.npz")
    where = [str(run / "lower.npz"), str(tmp_path / "motion.npz"), "-o", str(tmp_path / "out"), "--scans", str(run)]
    assert main(["train", *where, "--steps", "1"]) == 0
    assert told in capsys.readouterr().out
