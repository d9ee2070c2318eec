"""The viewer in headless Chromium: pages load without an error, the slider moves particles, live scenes run, the mouse pulls a body."""

import time
from shutil import which

import numpy as np
import pytest
import torch

from neuido import Frames, Scene, Simulator, shapes
from neuido.viewer.content import content_of_frames
from tests.discrepancy.report.test_page_in_browser import ARGUMENTS, PATIENCE

pytest.importorskip("viser", reason="viser is not installed: pip install neuido[viewer]")

SIZE = {"width": 720, "height": 420}
LEFT = {"x": 60, "y": 120, "width": 300, "height": 260}
"""Part of the page with the body, without the controls and the notice of a software renderer."""
OF_VISER = ("Unable to preventDefault inside passive event listener",)
"""Complaints of the browser about viser's own page, which do no harm."""


@pytest.fixture(scope="module")
def browser():
    program = which("chromium") or which("chromium-browser") or which("google-chrome")
    if program is None:
        pytest.skip("no Chromium on this machine")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install neuido[browser]")
    with playwright.sync_playwright() as driver:
        made = driver.chromium.launch(executable_path=program, args=list(ARGUMENTS))
        yield made
        made.close()


@pytest.fixture
def opened(browser):
    """Open a page; what its console complained of is checked at the end."""
    complaints, tabs = [], []

    def opens(url: str):
        tab = browser.new_page(viewport=SIZE)
        tab.set_default_timeout(PATIENCE)
        tab.on("console", lambda m: complaints.append(m.text) if m.type == "error" and not m.text.startswith(OF_VISER) else None)
        tab.on("pageerror", lambda e: complaints.append(str(e)))
        tab.on(
            "request",
            lambda r: complaints.append(r.url) if not r.url.startswith(("http://localhost:", "data:", "blob:", "file:")) else None,
        )
        tab.goto(url)
        tab.wait_for_selector("canvas")
        tabs.append(tab)
        return tab

    yield opens
    for tab in tabs:
        tab.close()
    assert complaints == []


def until(tab, what, seconds: float = 100.0) -> None:
    """Wait for the page and its server; the software renderer may take long."""
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, "it did not come"
        tab.wait_for_timeout(200)


def painted(tab) -> np.ndarray:
    """Return how yellow the pixels with the body are: where the particles are, in the colours of a fast body."""
    import cv2

    image = cv2.imdecode(np.frombuffer(tab.screenshot(clip=LEFT), np.uint8), cv2.IMREAD_COLOR).astype(int)
    return (image[..., 1] + image[..., 2] - 2 * image[..., 0]) > 120


@pytest.mark.slow
def test_the_slider_moves_the_particles(opened):
    from neuido.viewer.playback import Playback

    x = shapes.ball(centre=(0.5, 0.5, 0.5), radius=0.1, spacing=0.02).x.float()
    path = x + torch.linspace(-0.3, 0.3, 5)[:, None, None] * torch.tensor([1.0, 0.0, -1.0])
    eye = torch.eye(3).expand(*path.shape[:2], 3, 3).contiguous()
    frames = Frames(path, torch.ones_like(path), torch.zeros_like(eye), eye, dt=0.5)
    page = Playback(content_of_frames(frames, title="slide", scene=Scene()), port=8910)
    try:
        tab = opened(page.url)
        until(tab, lambda: painted(tab).sum() > 50)
        slider = tab.locator("[role=slider]").first
        assert slider.get_attribute("aria-valuemax") == "4"
        before = painted(tab)
        slider.focus()
        slider.press("End")
        until(tab, lambda: page.frame == 4)
        until(tab, lambda: (painted(tab) & ~before).sum() > 50)
        assert tab.get_by_text("speed [m/s]").count() and page.time.value == "2.000 s"
        tab.locator("input[type=checkbox]:visible").first.click()
        until(tab, lambda: page.play.value and page.frame not in (4,))
    finally:
        page.stop()


@pytest.mark.slow
def test_a_live_scene_runs_is_pulled_and_resets(opened):
    from neuido.viewer.live.live_page import LivePage
    from neuido.viewer.live.live_run import LiveRun, classical_family

    body = shapes.ball(centre=(0.5, 0.5, 0.5), radius=0.2, spacing=0.05)
    simulator = Simulator(Scene(cells=16, dt=1e-3, gravity=(0.0, 0.0, 0.0)), body, device="cpu")
    family = classical_family({"law": "fixed_corotated", "young": 3e4, "poisson": 0.3}, {"law": "identity"})
    page = LivePage(LiveRun(simulator, family), "ball", port=8915)
    run = page.run
    try:
        tab = opened(page.url)
        tab.get_by_text("gravity [m/s²]").wait_for()
        tab.locator("input[type=checkbox]:visible").first.click()
        until(tab, lambda: run.time > 0.01)
        first = run.state.x.mean(dim=0).numpy()
        x, y = 220, 230
        tab.mouse.move(x, y)

        def grips() -> bool:  # until the renderer has drawn the hull that the mouse takes hold of
            tab.mouse.up()
            tab.mouse.move(x, y)
            tab.mouse.down()
            for k in range(8):
                tab.mouse.move(x + 8 * k, y - 6 * k)
                tab.wait_for_timeout(60)
            return run.held() is not None

        until(tab, grips)
        until(tab, lambda: float(np.linalg.norm(run.state.x.mean(dim=0).numpy() - first)) > 0.004)
        assert np.linalg.norm(run.force) > 0
        tab.mouse.up()
        until(tab, lambda: run.held() is None)
        run.change("young", 1e9)
        tab.get_by_text("above the limit").wait_for()
        run.change("young", 3e4)
        tab.get_by_role("button", name="reset").click()
        until(tab, lambda: run.time == 0.0 and not run.error)
        assert torch.equal(run.state.x, simulator.state.x)
        tab.get_by_role("button", name="step").click()
        until(tab, lambda: run.steps_done > 0 and not run.playing)
    finally:
        page.stop()


@pytest.mark.slow
def test_a_player_needs_no_server(opened, tmp_path):
    x = shapes.ball(centre=(0.5, 0.5, 0.5), radius=0.1, spacing=0.03).x.float()
    path = x + torch.linspace(0.0, 0.4, 4)[:, None, None]
    eye = torch.eye(3).expand(*path.shape[:2], 3, 3).contiguous()
    player = Frames(path, torch.ones_like(path), torch.zeros_like(eye), eye, dt=0.5).show(colour="speed")
    assert "<iframe srcdoc" in player._repr_html_()
    tab = opened(player.save(tmp_path / "motion.html").as_uri())
    tab.get_by_text("speed [m/s]").wait_for()
    before = painted(tab)
    until(tab, lambda: (painted(tab) != before).sum() > 50)
