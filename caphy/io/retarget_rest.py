"""The body that motions are retargeted to when none is named."""

from __future__ import annotations

from functools import cache

import numpy as np

from caphy.body.bundled import default_body
from caphy.body.model import BodyModel
from caphy.io.retarget import RestBody


def rest_of(body: BodyModel, betas: np.ndarray | None = None) -> RestBody:
    """Rest joints and soles of ``body`` with shape ``betas``."""
    vertices, joints = body.rest(betas)
    return RestBody(np.asarray(joints), float(vertices[:, 1].min()))


@cache
def default_rest() -> RestBody:
    """Rest joints and soles of the bundled body."""
    return rest_of(default_body())
