"""What a shirt must keep from the body where another garment is worn under it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from caphy.body.surface import Surface
from caphy.garment.families import Top
from caphy.garment.landmarks import Landmarks
from caphy.garment.template import Garment
from caphy.register.articulation import Figure
from caphy.register.template import dressed_body

CLEARS = 0.9
"""Share of the garment beneath that a shirt keeps outside of."""
MOST = 0.02
"""Greatest distance [m]: a skirt that stands off farther is pressed in."""


def over(style: Top, inner: Garment, figure: Figure) -> Top:
    """A top with the ``layer_thickness`` that keeps it outside ``inner``, which is worn on the figure's rest shape.

    Told by how far that lies from the body above the top's hem; a top that ends above it is left as it is.
    """
    marks = Landmarks.of(dressed_body(figure))
    length = marks.joint("neck")[1] - marks.crotch - 0.03 if style.length is None else style.length
    covered = inner.vertices[inner.vertices[:, 1] > marks.joint("neck")[1] - length]
    if not len(covered):
        return style
    height = Surface.of(marks.body.faces, marks.vertices).nearest(covered, marks.vertices).distance
    return replace(style, layer_thickness=float(np.clip(np.quantile(height, CLEARS), style.layer_thickness, MOST)))
