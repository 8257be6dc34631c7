"""What the page is sent: every frame, on its ground, a reset where a motion begins."""

from __future__ import annotations

import numpy as np

from caphy.conditioning import Did, Frame
from caphy.io.bundle import AvatarBundle
from service.clients.monocular.live import LiveWardrobe


class Notes:
    """A feed, and a wardrobe, that only remember."""

    page, name = "http://somewhere/", "notes"

    def __init__(self) -> None:
        self.sent: list[object] = []

    def reset(self) -> None:
        self.sent.append("reset")

    def send(self, poses: np.ndarray, transl: np.ndarray) -> None:
        self.sent.append(transl)

    def wear(self, frames: list[Frame]) -> list[dict[str, np.ndarray]]:
        return [{"hat": np.zeros(3)} for _ in frames]

    def close(self) -> None:
        self.sent.append("closed")


def test_frames_stand_on_the_pages_ground_from_where_their_motion_begins(bundle: AvatarBundle) -> None:
    standing, feed = np.zeros((55, 3)), Notes()
    heights = (-1.3, -1.2, 0.4, 0.5)  # seen from the camera; another scene after two frames
    frames = [
        Frame(i / 30, standing, np.array([0.5, height, -4.0]), Did.RESET if i % 2 == 0 else Did.NOTHING)
        for i, height in enumerate(heights)
    ]
    assert LiveWardrobe(feed, bundle, None).wear(frames) == [{}] * 4  # type: ignore[arg-type]
    assert [item for item in feed.sent if isinstance(item, str)] == ["reset", "reset"]
    assert isinstance(feed.sent[0], str)
    assert isinstance(feed.sent[3], str)
    sent = np.array([item for item in feed.sent if not isinstance(item, str)])
    sole = float(bundle.body.vertices[:, 1].min())
    np.testing.assert_allclose(sent[[0, 2], 1] + sole, 0, atol=0.02)  # the soles, not the pelvis
    np.testing.assert_allclose(np.diff(sent[:, 1])[[0, 2]], 0.1, atol=1e-9)
    np.testing.assert_array_equal(sent[:, [0, 2]], [[0.5, -4.0]] * 4)


def test_what_is_drawn_too_is_dressed_too(bundle: AvatarBundle) -> None:
    feed, drawn = Notes(), Notes()
    wardrobe = LiveWardrobe(feed, bundle, drawn)  # type: ignore[arg-type]
    frame = Frame(0.0, np.zeros((55, 3)), np.zeros(3), Did.RESET)
    assert wardrobe.wear([frame])[0].keys() == {"hat"}
    assert wardrobe.name == "the page (http://somewhere/)"
    wardrobe.close()
    assert (feed.sent[-1], drawn.sent[-1]) == ("closed", "closed")
