"""A network carried over to another mesh, body and set of joints, and a training that begins so."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from small_world import swaying, tube

from caphy.body.bundled import default_body
from caphy.effects.cloth import Cloth
from caphy.effects.potential import Potential
from caphy.effects.presets import snug_model
from caphy.errors import CaphyError
from caphy.garment.families import Tshirt, make
from caphy.garment.template import Garment
from caphy.io.poses import PoseSequence
from caphy.io.procedural import procedural_motion
from caphy.network.features import pose_features
from caphy.network.garment_network import GarmentNetwork
from caphy.rotations import matrix_from_axis_angle
from caphy.training.initial import read_likeness
from caphy.training.motions import Motions
from caphy.training.objective import Objective
from caphy.training.transfer import carried_over
from caphy.training.validate import validate

JOINTS = default_body().joints
AVATAR = Path(__file__).parents[2] / "caphy" / "data" / "avatars" / "default"


def trained(garment: Garment) -> GarmentNetwork:
    """A network whose offsets, of centimetres, follow the poses."""
    torch.manual_seed(3)
    network = GarmentNetwork(garment.vertices, garment.weights, JOINTS, layers=2, width=24)
    torch.nn.init.normal_(network.head.weight, std=0.02)
    torch.nn.init.normal_(network.head.bias, std=0.01)
    return network


def halved(garment: Garment) -> tuple[Garment, np.ndarray]:
    """The garment with a vertex added in the middle of each of its first ten faces' first edges, and these edges."""
    edges = garment.faces[:10, :2]
    places, weights = (np.concatenate([v, v[edges].mean(axis=1)]) for v in (garment.vertices, garment.weights))
    others = {
        name: np.resize(getattr(garment, name), len(places)) for name in ("regions", "layer_thickness", "attached")
    }
    return replace(garment, vertices=places, weights=weights, **others), edges


def moving(network: GarmentNetwork, motion: PoseSequence) -> np.ndarray:
    """Canonical offsets (T, V, 3) [m] in a motion."""
    rotations, transl = matrix_from_axis_angle(torch.tensor(motion.poses).float()), torch.tensor(motion.transl).float()
    features, _ = pose_features(rotations, transl, torch.zeros(16), network.driving, 30.0)
    return network.offsets(features[None])[0][0].detach().numpy()


def test_on_its_own_garment_it_stays_the_same():
    garment = tube()
    network, motion = trained(garment), swaying(20, 1)
    other, apart = carried_over(network, garment.faces, garment, JOINTS)
    np.testing.assert_allclose(
        other.stream(motion.poses, motion.transl), network.stream(motion.poses, motion.transl), atol=1e-6
    )
    assert apart < 1e-6


def test_new_vertices_move_as_the_place_they_lie_on():
    garment = tube()
    finer, edges = halved(garment)
    network, motion = trained(garment), swaying(20, 2)
    own, theirs = moving(carried_over(network, garment.faces, finer, JOINTS)[0], motion), moving(network, motion)
    np.testing.assert_allclose(own[:, : len(garment.vertices)], theirs, atol=1e-6)
    np.testing.assert_allclose(own[:, len(garment.vertices) :], theirs[:, edges].mean(axis=2), atol=1e-6)
    assert np.abs(theirs).max() > 0.005


def test_a_garment_on_another_body_is_found_where_its_joints_are():
    garment, shift = tube(), np.array([0.02, 0.3, -0.1])
    network = trained(garment)
    moved, apart = carried_over(
        network, garment.faces, replace(garment, vertices=garment.vertices + shift), JOINTS + shift
    )
    assert apart < 1e-6
    np.testing.assert_allclose(moved.head.weight.detach(), network.head.weight.detach(), atol=1e-6)
    assert carried_over(network, garment.faces, replace(garment, vertices=garment.vertices + shift), JOINTS)[1] > 0.05


def test_joints_that_the_first_network_did_not_see_have_no_say():
    garment = tube()
    network, motion = trained(garment), swaying(20, 4)
    weights = 0.9 * garment.weights
    weights = weights + 0.1 * np.eye(len(JOINTS))[16]
    other, _ = carried_over(network, garment.faces, replace(garment, weights=weights), JOINTS)
    assert set(other.driving) > set(network.driving)
    more = np.zeros((len(JOINTS), 3))
    more[16] = 0.5
    turned = replace(motion, poses=motion.poses + more)
    np.testing.assert_allclose(moving(other, turned), moving(network, motion), atol=1e-6)


def test_a_shirt_begins_as_the_default_one_and_nearly_at_rest():
    """A coarse T-shirt of another cut on a taller, broader body: its potential on a motion, by SNUG's cotton."""
    body = default_body()
    larger = replace(body, v_template=1.05 * body.v_template, joints=1.05 * body.joints)
    garment = make(Tshirt(edge_length=0.036, ease=0.035, length=0.62), larger)
    model = snug_model()
    fresh = GarmentNetwork(garment.vertices, garment.weights, larger.joints)
    network = read_likeness(AVATAR, garment, larger.joints).network
    potential = Potential(model, Cloth.of(garment, model.density), torch.float32)
    objective = Objective(potential, larger, fresh.template, fresh.weights, 30.0)
    motions = Motions.of([procedural_motion(5, 4.0, 30.0)], larger, fresh.driving, 30.0)
    begun, unknowing = (validate(each, objective, motions).summary()["potential_J"] for each in (network, fresh))
    assert begun < 0.6 * unknowing


def test_what_is_not_like_any_garment_is_refused(tmp_path):
    garment = tube()
    far = replace(garment, vertices=garment.vertices + np.array([0, 0, 0.5]))
    with pytest.raises(CaphyError, match=r"none of its garments is like 'tube'.*leave --transfer out"):
        read_likeness(AVATAR, far, JOINTS)
    with pytest.raises(CaphyError, match="is not an avatar"):
        read_likeness(tmp_path, garment, JOINTS)
