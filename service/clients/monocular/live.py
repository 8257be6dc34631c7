"""What is seen, shown live in the service's page."""

from __future__ import annotations

from typing import Final

import numpy as np

from caphy.conditioning import Did, Frame
from caphy.conditioning.body import Body, standing_height
from caphy.conditioning.quaternions import exponential
from caphy.io.bundle import AvatarBundle
from service.clients.feed import FeedClient
from service.clients.monocular.dressing import Wardrobe

FEED: Final = "camera"


class LiveWardrobe:
    """Sends every frame to a feed, for the page to dress, and has it dressed for the drawing too where there is one.

    The page's ground is where the lowest sole was in the first frame of a motion: the camera's own height is unknown.
    """

    def __init__(self, feed: FeedClient, bundle: AvatarBundle, drawn: Wardrobe | None) -> None:
        self._feed, self._drawn = feed, drawn
        self._body = Body(bundle.joints, float(bundle.body.vertices[:, 1].min()))
        self._ground = np.zeros(3)

    @property
    def name(self) -> str:
        """Over what the clothes come."""
        return f"the page ({self._feed.page})"

    def wear(self, frames: list[Frame]) -> list[dict[str, np.ndarray]]:
        """See :class:`Wardrobe`; no garments where nothing is drawn here."""
        for frame in frames:
            if Did.RESET in frame.did:
                self._feed.reset()
                soles = standing_height(self._body.soles(exponential(frame.poses)))
                self._ground = np.array([0.0, frame.transl[1] + self._body.joints[0, 1] + soles, 0.0])
            self._feed.send(frame.poses, frame.transl - self._ground)
        return [{} for _ in frames] if self._drawn is None else self._drawn.wear(frames)

    def close(self) -> None:
        """Let the service go."""
        self._feed.close()
        if self._drawn is not None:
            self._drawn.close()
