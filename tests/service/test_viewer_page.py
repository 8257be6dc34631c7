"""The page in headless Chromium against a running service: what it draws, says and does."""

from __future__ import annotations

import base64
import hashlib
import io
import re
import shutil
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from live_service import live_service
from playwright.sync_api import Browser, Page, sync_playwright
from test_viewer_files import amass

import service.viewer
from caphy.body.surface import nearest_on_surface
from caphy.io.bundle import write_bundle
from service.engine import GarmentEngine
from service.protocol import decode_request

FOLDER = Path(service.viewer.__file__).parent
FLAGS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-gl=angle",
    "--use-angle=swiftshader-webgl",
    "--enable-unsafe-swiftshader",
]
CONTROLS = {
    "play",
    "scrub",
    "speed",
    "clip",
    "go-live",
    "shaded",
    "strain",
    "depth",
    "wireframe",
    "body",
    "tshirt",
    "trousers",
}
SIZE = {"width": 640, "height": 460}
LONG = 60.0
"""Seconds to wait for what is drawn in software on a busy machine."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    place = shutil.which("chromium")
    assert place, "this test needs chromium (Debian: apt-get install chromium)"
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=place, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def faults() -> list[str]:
    """What the page complained about."""
    return []


@pytest.fixture(scope="module")
def page(browser: Browser, url: str, faults: list[str]) -> Iterator[Page]:
    """The page with its motion loaded, paused at the start."""
    page = opened(browser, url, faults)
    until(page, "caphy.clip?.ready > 80")
    yield page
    page.context.close()


@pytest.fixture
def still(page: Page) -> Page:
    """The page as a test may expect it: a clip, shaded, everything shown, paused at frame 0."""
    page.evaluate("""() => {
        caphy.play(false); caphy.goLive(false); caphy.colour(''); caphy.state.clear();
        for (const button of document.querySelectorAll("#parts button"))
            if ((button.getAttribute("aria-pressed") === "true") === (button.id === "wireframe")) button.click();
        document.activeElement.blur();
        caphy.seek(0);
    }""")
    return page


def opened(browser: Browser, url: str, faults: list[str], **context) -> Page:
    context = browser.new_context(**{"viewport": SIZE, "reduced_motion": "reduce", **context})
    context.set_default_timeout(1000 * LONG)
    page = context.new_page()
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("console", lambda message: message.type == "error" and faults.append(message.text))
    page.goto(url)
    return page


def until(page: Page, condition: str, seconds: float = LONG) -> None:
    """Wait for a condition in the page; its policy forbids what Playwright's own waiting needs."""
    deadline = time.monotonic() + seconds
    while not page.evaluate(condition):
        assert time.monotonic() < deadline, f"{condition}; the page says {page.locator('#state').text_content()!r}"
        page.wait_for_timeout(100)


def floats(page: Page, expression: str) -> np.ndarray:
    """A Float32Array of the page."""
    encoded = page.evaluate(
        f"""() => {{
            const bytes = new Uint8Array(Float32Array.from({expression}).buffer);
            let text = "";
            for (const byte of bytes) text += String.fromCharCode(byte);
            return btoa(text);
        }}"""
    )
    return np.frombuffer(base64.b64decode(encoded), "<f4")


def garment(page: Page, name: str) -> np.ndarray:
    return floats(page, f'caphy.model.garments.get("{name}").vertices').reshape(-1, 3)


@pytest.fixture(scope="module")
def expected(bundle, http):
    """The bundled motion, and the garments' vertices (T, V, 3) on its first 90 frames."""
    request = decode_request(http.get("/avatars/shell/poses").content)
    poses, transl = request.poses[:90].copy(), request.transl[:90].copy()
    engines = [GarmentEngine(garment) for garment in bundle.garments]
    return request, {e.name: e.run(poses, transl, e.initial_state())[0] for e in engines}


def picture(page: Page) -> np.ndarray:
    """What is drawn (H, W, 3), toolbar left out."""
    png = page.locator(".stage").screenshot()
    return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR).astype(int)


def test_static_files_are_built_from_these_sources():
    digest = hashlib.sha256()
    for path in [*sorted((FOLDER / "src").iterdir()), FOLDER.parent / "clients" / "stream.js"]:
        digest.update(path.read_bytes())
    for name in ("three.js", "viewer.js"):
        built = (FOLDER / "static" / name).read_text()
        assert digest.hexdigest() in built[:200], f"static/{name} is older than its sources: run `make viewer`"
    assert "MIT" in (FOLDER / "static" / "three.LICENSE.txt").read_text()


def test_the_page_loads_nothing_from_elsewhere(http):
    answer = http.get("/")
    assert answer.headers["content-type"].startswith("text/html")
    assert "script-src 'self'" in answer.headers["content-security-policy"]
    for name in ("index.html", "style.css", "viewer.js"):
        found = http.get(f"/viewer/{name}")
        assert found.status_code == 200
        assert not re.search(r"https?://|//cdn", found.text)


def test_loads_without_complaints_and_draws_a_body_in_clothes(still, faults):
    assert "procedural motion" in still.locator("#source").text_content()
    image = picture(still)
    background = image[40, -10]
    drawn = np.abs(image - background).max(axis=-1) > 40
    assert 0.02 < drawn.mean() < 0.5
    middle = image[:, image.shape[1] // 3 : -image.shape[1] // 3]
    blue = (middle[..., 0] > middle[..., 2] + 30).mean()  # the shirt
    skin = (middle[..., 2] > middle[..., 0] + 30).mean()
    assert blue > 0.01
    assert skin > 0.005
    assert faults == []


@pytest.mark.parametrize("frame", [0, 45, 75])  # the last one is of the second part that was fetched
def test_garments_are_where_the_service_puts_them(still, expected, frame):
    still.evaluate(f"caphy.seek({frame})")
    for name, vertices in expected[1].items():
        assert np.abs(garment(still, name) - vertices[frame]).max() < 5e-5  # kept as 16-bit steps


def test_between_frames_things_are_between(still, expected):
    still.evaluate("caphy.seek(30.5)")
    between = expected[1]["tshirt"][30:32].mean(axis=0)
    assert np.abs(garment(still, "tshirt") - between).max() < 5e-5


def test_the_body_moves_with_the_poses(still, bundle, expected):
    request, _ = expected
    still.evaluate("caphy.seek(50)")
    shown = floats(
        still,
        """(() => {
            const { body, root } = caphy.model, found = [], point = body.position.clone();
            root.updateMatrixWorld(true);
            for (let i = 0; i < body.geometry.attributes.position.count; i += 37)
                found.push(...body.getVertexPosition(i, point).applyMatrix4(body.matrixWorld).toArray());
            return found;
        })()""",
    ).reshape(-1, 3)
    posed = bundle.body.posed(bundle.transforms(request.poses[[50]], request.transl[[50]]))[0][::37]
    assert np.abs(shown - posed).max() < 1e-4


def test_strain_is_the_largest_singular_value_of_the_deformation(still, bundle, expected):
    still.evaluate("caphy.colour('strain'); caphy.seek(45)")
    mesh = bundle.garment("tshirt").mesh

    def edges(vertices):
        a, b, c = (vertices[mesh.faces[:, i]].astype(float) for i in range(3))
        return np.stack([b - a, c - a], axis=-1)

    rest, now = edges(mesh.vertices), edges(expected[1]["tshirt"][45])
    flat, _ = np.linalg.qr(rest)
    local = np.swapaxes(flat, 1, 2) @ rest
    stretch = np.linalg.svd(now @ np.linalg.inv(local), compute_uv=False)[:, 0] - 1
    shown = floats(still, 'caphy.model.garments.get("tshirt").stretch')
    good = np.linalg.norm(np.cross(rest[..., 0], rest[..., 1]), axis=1) > 2e-5
    assert good.mean() > 0.9
    np.testing.assert_allclose(shown[good], np.maximum(stretch, 0)[good], atol=2e-2)
    assert still.locator("#legend").is_visible()
    assert "25 %" in still.locator("#legend").text_content()
    assert re.search(r"95 % below \d+ %", still.locator("#legend-now").text_content())


def test_penetration_is_the_distance_to_the_surface_from_inside(still, bundle, expected):
    request, garments = expected
    still.evaluate("caphy.seek(45); caphy.colour('depth')")
    posed = bundle.body.posed(bundle.transforms(request.poses[[45]], request.transl[[45]]))[0]
    deepest = []
    for name, vertices in garments.items():
        inside = np.maximum(-nearest_on_surface(vertices[45], posed, bundle.body.faces).distance, 0)
        shown = floats(still, f'caphy.model.garments.get("{name}").depth')
        reach = inside < 0.04  # deeper is not looked for
        assert reach.mean() > 0.95
        gap = np.abs(shown - inside)[reach]
        assert np.percentile(gap, 99) < 1e-4  # the nearest vertex does not always have the nearest face
        assert gap.max() < 5e-3
        deepest.append(shown.max())
    assert max(deepest) > 5e-3
    assert still.evaluate("caphy.model.body.material.transparent")
    legend = still.locator("#legend").text_content()
    assert "10 mm" in legend
    assert f"most {1e3 * max(deepest):.1f} mm" in legend
    still.keyboard.press("p")
    assert still.evaluate("caphy.heat === '' && !caphy.model.body.material.transparent")
    assert not still.locator("#legend").is_visible()


def test_heat_and_wireframe_change_the_picture(still):
    plain = picture(still)
    for change in ("caphy.colour('strain')", "document.getElementById('wireframe').click()"):
        still.evaluate(change)
        still.wait_for_timeout(400)
        changed = picture(still)
        assert (np.abs(changed - plain).max(axis=-1) > 25).mean() > 0.005
        plain = changed


def test_the_keyboard_does_everything(still):
    def shown(expression):
        return still.evaluate(expression)

    press = still.keyboard.press
    for _ in range(3):
        press("ArrowRight")
    press("ArrowLeft")
    assert shown("caphy.time") == 2
    press("Shift+ArrowRight")
    assert shown("caphy.time") == 32
    press("Home")
    assert shown("caphy.time") == 0
    press("b")
    press("2")
    assert shown("caphy.model.body.visible") is False
    assert [shown(f'caphy.model.garments.get("{n}").mesh.visible') for n in ("tshirt", "trousers")] == [True, False]
    press("h")
    assert still.locator("#strain").get_attribute("aria-pressed") == "true"
    press("w")
    assert still.locator("#wireframe").get_attribute("aria-pressed") == "true"
    press("]")
    assert shown("caphy.speed") == 2
    press("[")
    press("?")
    assert still.locator("#keys").is_visible()
    press("Escape")
    until(still, "document.activeElement === document.body")
    press(" ")
    until(still, "caphy.playing && caphy.time > 1")
    press(" ")
    assert shown("caphy.playing") is False
    still.locator("#view").focus()
    before = shown("caphy.stage.camera.position.x")
    press("ArrowLeft")
    assert shown("caphy.stage.camera.position.x") != before
    assert shown("caphy.time") > 1  # on the picture arrows turn, they do not step
    press("c")


def test_every_control_is_reached_by_tab_has_a_name_and_shows_the_focus(still):
    still.evaluate("document.getElementById('view').focus()")
    seen = []
    for _ in range(16):
        still.keyboard.press("Tab")
        seen.append(
            still.evaluate("""() => {
                const e = document.activeElement, style = getComputedStyle(e);
                const outlined = style.outlineStyle !== "none" && parseFloat(style.outlineWidth) >= 2;
                return [e.id || e.dataset.garment, outlined];
            }""")
        )
    assert {name for name, _ in seen} >= CONTROLS | {"open", "camera", "help"}
    assert all(visible for name, visible in seen if name)
    snapshot = still.locator("main").aria_snapshot()
    for line in re.findall(r"- (?:button|slider|combobox).*", snapshot):
        assert '"' in line, line
    assert 'slider "Time"' in snapshot


def test_a_pose_file_is_opened_and_played(still, faults):
    still.locator("#file").set_input_files({"name": "walk.npz", "mimeType": "x", "buffer": amass()})
    until(still, 'caphy.clip.source === "walk.npz" && caphy.clip.ready === 10')
    assert "10 frames at 30" in still.locator("#source").text_content()
    assert faults == []


def test_a_dropped_file_and_words_for_one_that_cannot_be_read(still, faults):
    drop(still, "notes.txt", b"hello")
    until(still, 'caphy.state.kind === "error"')
    assert ".npz or .bvh" in still.locator("#state").text_content()
    still.locator("#dismiss").click()
    assert still.locator("#state").is_hidden()

    plain = io.BytesIO()
    np.savez(plain, poses=np.zeros((12, 165)) + 1e-3, trans=np.zeros((12, 3)))
    drop(still, "plain.npz", plain.getvalue())
    until(still, 'caphy.state.kind === "error"')
    assert "frame rate" in still.locator("#state").text_content()
    still.locator("#fps").fill("30")
    still.locator("#rate-form button").click()
    until(still, 'caphy.clip.source === "plain.npz" && caphy.clip.ready === 12')
    assert all("422" in fault or "415" in fault for fault in faults)
    faults.clear()


def drop(page: Page, name: str, content: bytes) -> None:
    page.evaluate(
        """([name, content]) => {
            const bytes = Uint8Array.from(atob(content), (c) => c.charCodeAt(0)), dataTransfer = new DataTransfer();
            dataTransfer.items.add(new File([bytes], name));
            dispatchEvent(new DragEvent("drop", { dataTransfer, bubbles: true, cancelable: true }));
        }""",
        [name, base64.b64encode(content).decode()],
    )


def test_live_frames_are_those_of_the_stream(browser, url, expected, faults):
    page = opened(browser, url, faults)
    until(page, "caphy.clip?.ready > 0")
    page.evaluate("caphy.seek(0); caphy.goLive(true)")
    until(page, "caphy.live.seen === 1")
    for frame in (1, 2, 6):  # the page had no time for 3 to 5, but cloth lives through them
        page.evaluate(f"caphy.seek({frame})")
        until(page, f"caphy.shown === {frame}")
    for name, vertices in expected[1].items():
        assert np.abs(garment(page, name) - vertices[6]).max() < 1e-4
    page.evaluate("caphy.seek(40)")  # a cut: the cloth starts anew
    until(page, "caphy.shown === 40")
    assert np.abs(garment(page, "tshirt") - expected[1]["tshirt"][40]).max() > 1e-4
    page.evaluate("caphy.play(true)")
    until(page, "caphy.live.seen > 12")
    page.evaluate("caphy.play(false)")
    page.wait_for_timeout(600)
    assert re.fullmatch(r"[\d.]+, [\d.]+ ms", page.locator("#latency").text_content())
    assert re.fullmatch(r"\d+ of \d+", page.locator("#dropped").text_content())
    assert faults == []
    page.context.close()


def test_a_service_that_goes_away_and_comes_back(browser, avatars):
    faults: list[str] = []
    with live_service(avatars) as service:
        page, port = opened(browser, service.url, faults), service.port
        until(page, "caphy.clip && caphy.clip.ready === caphy.clip.frames")
        page.evaluate("caphy.goLive(true)")
        until(page, "caphy.live.seen === 1")
        service.process.kill()
        service.process.wait()
        until(page, 'caphy.state.kind === "gone"')
        assert "Disconnected" in page.locator("#state").text_content()
    with live_service(avatars, "--port", str(port)):
        until(page, 'caphy.state.kind === ""')
        page.evaluate("caphy.seek(1)")
        until(page, "caphy.shown === 1")
    page.context.close()


def test_another_avatar_can_be_chosen(browser, bundle, tmp_path):
    write_bundle(bundle, tmp_path / "a")
    write_bundle(replace(bundle, name="other", garments=bundle.garments[:1]), tmp_path / "b")
    faults: list[str] = []
    with live_service(tmp_path) as service:
        page = opened(browser, service.url, faults)
        until(page, "caphy.clip?.ready > 0")
        page.evaluate("caphy.play(true)")
        page.locator("#avatar").select_option("b")
        until(page, 'caphy.avatar.id === "b" && caphy.clip?.ready > 0')
        assert page.locator("#parts [data-garment]").all_text_contents() == ["tshirt"]
        assert faults == []
        page.context.close()


def test_a_link_to_another_avatar_says_that_there_is_none(browser, url):
    page = browser.new_page()
    page.goto(f"{url}/?avatar=nope&feed=camera")
    until(page, 'globalThis.caphy?.state.kind === "error"')
    assert "There is no avatar 'nope'; there is shell." in page.locator("#state").text_content()
    page.close()


def test_a_key_is_asked_for(browser, avatars):
    with live_service(avatars, CAPHY_API_KEY="swordfish-swordfish") as service:
        page = opened(browser, service.url, [])
        until(page, 'caphy.state.kind === "key"')
        page.locator("#key").fill("swordfish-swordfish")
        page.locator("#key-form button").click()
        until(page, "caphy.clip?.ready > 0")
        page.evaluate("caphy.goLive(true)")
        until(page, "caphy.live.seen === 1")
        page.context.close()


def test_a_browser_without_webgl_is_told(browser, url):
    context = browser.new_context(viewport=SIZE)
    context.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page = context.new_page()
    page.goto(url)
    until(page, 'globalThis.caphy?.state.kind === "error"')
    assert "WebGL" in page.locator("#state").text_content()
    context.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_fits_a_phone(browser, url, faults, scheme):
    page = opened(browser, url, faults, viewport={"width": 360, "height": 640}, color_scheme=scheme)
    until(page, "caphy.clip?.ready > 0")
    page.evaluate("caphy.colour('strain')")
    page.wait_for_timeout(500)
    assert page.evaluate(
        "document.documentElement.scrollWidth <= innerWidth && document.body.scrollHeight <= innerHeight"
    )
    for control in ("play", "scrub", "speed", "clip", "strain"):
        box = page.locator(f"#{control}").bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= 360
        assert box["height"] >= 30
    page.locator("#help").scroll_into_view_if_needed()
    assert page.locator("#help").bounding_box()["x"] + 30 <= 360
    background = picture(page)[-5, 5].mean()
    assert background > 200 if scheme == "light" else background < 80
    assert faults == []
    page.context.close()
