"""The body of one person as a model of its own: what garments are made, trained and exported on."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from caphy.body.model import BodyModel
from caphy.garment.template import write_npz
from caphy.register.fit import BodyFit
from caphy.register.template import dressed_body

SUBJECT_BODY = "subject_body.npz"


def body_arrays(body: BodyModel) -> dict[str, np.ndarray]:
    """What an SMPL-X-format npz of a body holds; :meth:`BodyModel.load` gives the body back (in float32).

    Joints are written as they are (``J``, ``J_shapedirs``): a regressor would move them with the displaced skin. How
    joints follow the expression is lost, which no pose here uses.
    """
    parents = np.asarray(body.parents, dtype=np.int64)
    arrays = {
        "v_template": body.v_template,
        "weights": body.weights,
        "shapedirs": np.concatenate([body.shapedirs, body.expressiondirs], axis=2),
        "J": body.joints,
        "J_shapedirs": body.joint_shapedirs,
    }
    if body.posedirs is not None:
        arrays["posedirs"] = body.posedirs
    for key, sides in (("hands_components", body.hand_components), ("hands_mean", body.hand_means)):
        arrays |= {key + side[0]: values for side, values in (sides or {}).items()}
    whole = {"f": body.faces, "kintree_table": np.stack([parents, np.arange(len(parents))])}
    return {name: array.astype(np.float32) for name, array in arrays.items()} | whole


def write_subject_body(fit: BodyFit, folder: Path) -> Path:
    """Write ``subject_body.npz`` of a fit into a folder, whole or not at all; every ``--body`` takes it.

    Its mean shape is the fitted one with the displacement, so it is posed without betas.
    """
    path = folder / SUBJECT_BODY
    write_npz(path, body_arrays(dressed_body(fit.figure)))
    return path
