"""The page that follows a feed, in headless Chromium: what is sent is what is seen."""

from __future__ import annotations

import numpy as np
from test_viewer_page import browser, faults, garment, opened, until  # noqa: F401  fixtures too

from service.clients.feed import FeedClient
from service.engine import GarmentEngine


def test_the_page_shows_what_a_feed_sends(browser, url, faults, bundle, motion):  # noqa: F811
    page = opened(browser, f"{url}/?avatar=shell&feed=camera", faults)
    until(page, "caphy.state.kind === 'gone'")
    assert "Waiting for somebody who sends on feed “camera”" in page.locator("#state").text_content()
    assert not page.locator("#play").is_visible()
    poses, transl = motion.poses.astype(np.float32), motion.transl.astype(np.float32)
    with FeedClient(url, "shell", "camera", fps=bundle.fps) as feed:
        until(page, "caphy.feed.stream?.open")  # its stream lives from the first pose on
        for frame in range(12):
            feed.send(poses[frame], transl[frame])
            until(page, f"caphy.shown === {frame} || caphy.feed.poses.size === 0 && caphy.shown !== null")
        until(page, "caphy.feed.poses.size === 0")
        for engine in (GarmentEngine(garment) for garment in bundle.garments):
            expected = engine.run(poses[:12], transl[:12], engine.initial_state())[0][-1]
            np.testing.assert_allclose(garment(page, engine.name), expected, atol=1e-4)
        root = page.evaluate("caphy.model.bones[0].position.toArray()")
        np.testing.assert_allclose(root, bundle.joints[0] + transl[11], atol=1e-4)
        assert page.locator("#state").is_hidden()
        assert "ms" in page.locator("#latency").text_content()
    until(page, "caphy.state.kind === 'gone'")  # nobody sends any more
    page.locator("#file").set_input_files([])
    assert faults == []
    page.context.close()


def test_a_feed_of_no_name_is_told(browser, url, faults):  # noqa: F811
    page = opened(browser, f"{url}/?feed=a%20b", faults)
    until(page, "caphy.state.kind === 'error'")
    assert "a feed's name has 1 to 40 letters" in page.locator("#state").text_content()
    page.context.close()
