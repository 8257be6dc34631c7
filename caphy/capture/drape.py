"""Clothes on a posed body."""

from __future__ import annotations

from typing import Any

import numpy as np

from caphy.capture.subject import Subject
from caphy.io.poses import PoseSequence
from caphy.solve.body_motion import BodyMotion


class Dresser:
    """Clothes that simply follow the skeleton: skinned templates."""

    def __init__(self, subject: Subject, poses: PoseSequence, simulate: bool = True) -> None:
        self.subject, self.poses, self.simulate = subject, poses, simulate

    def dressed(self, index: int) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Garments' vertices by label (V, 3) [m] in pose ``index``, and a report."""
        return {
            label: BodyMotion(self.subject.body, self.poses, garment).anchors(np.array([float(index)]))[0]
            for label, garment in self.subject.garments.items()
        }, {}
