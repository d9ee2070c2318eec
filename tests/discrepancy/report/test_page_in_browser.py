"""The page of a diagnosis in a browser: no error on its console, and play, slider, legend, zoom, theme and narrow windows work."""

from shutil import which

import pytest

from neuido.discrepancy.report import page
from tests.discrepancy.report.report_content import HOSTILE, content, motion, stress_curve

ARGUMENTS = (
    "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
)  # fmt: skip
PATIENCE = 120_000
"""Milliseconds that a software renderer may take."""
DRAWN = "[...document.querySelectorAll('[data-figure]')].filter(e => e.checkVisibility()).every(e => e.dataset.drawn)"


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
def opened(browser, tmp_path):
    """Open a page at a width; what its console complained of is checked at the end."""
    complaints, tabs = [], []

    def opens(text: str, width: int = 1100, scheme: str = "light"):
        place = tmp_path / f"page{len(tabs)}.html"
        place.write_text(text)
        tab = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=scheme)
        tab.set_default_timeout(PATIENCE)
        tab.on("console", lambda m: complaints.append(m.text) if m.type == "error" else None)
        tab.on("pageerror", lambda e: complaints.append(str(e)))
        tab.on("request", lambda r: complaints.append(r.url) if not r.url.startswith(("file:", "data:", "blob:")) else None)
        tab.goto(place.as_uri())
        tab.set_viewport_size({"width": width, "height": tab.evaluate("document.documentElement.scrollHeight + 100")})
        tab.wait_for_function(DRAWN)
        tabs.append(tab)
        return tab

    yield opens
    for tab in tabs:
        tab.close()
    assert complaints == []


@pytest.mark.slow
def test_the_motion_plays(opened):
    tab = opened(page.page([content(stages={}, models=[])], [motion()], kind="experiment"))
    before = tab.evaluate("document.querySelector('.player .space').data.map(t => t.name)")
    assert {"measured", "before", "after", "residual before", "residual after", "gravity"} <= set(before)
    x = "JSON.stringify(document.querySelector('.player .space').data[0].x)"
    slider = tab.locator(".player input")
    last = int(slider.get_attribute("max"))
    first = tab.evaluate(x)
    slider.fill("0")
    tab.wait_for_function("document.querySelector('.player').dataset.shown === '0'")
    assert tab.evaluate(x) != first and tab.locator(".player output").inner_text() == "0.000 s"
    tab.locator(".player .play").click()
    tab.wait_for_function(f"+document.querySelector('.player').dataset.shown >= {min(2, last)}")
    assert tab.locator(".player .play").inner_text() == "stop"
    tab.locator(".player .play").click()
    assert tab.locator(".player .play").inner_text() == "play"
    tab.locator(".player select").select_option("1")
    tab.wait_for_function("document.querySelector('.player select').value === '1'")
    camera = "JSON.stringify(document.querySelector('.player .space')._fullLayout.scene._scene.getCamera().eye)"
    eye = tab.evaluate(camera)
    box = tab.locator(".player .space").bounding_box()
    tab.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    tab.mouse.wheel(0, -400)
    tab.wait_for_function(f"{camera} !== {eye!r}")
    tab.locator(".map input[value=after]").check()
    tab.wait_for_function("document.querySelector('.map .space').data[0].name.endsWith('after')")


@pytest.mark.slow
def test_legend_theme_and_narrow_windows(opened):
    c, arrays = stress_curve()
    text = page.page([c], [arrays], kind="material test")
    tab = opened(text)
    tab.locator(".plot .legendtoggle").first.click()
    tab.wait_for_function("document.querySelector('.plot')._fullData[0].visible === 'legendonly'")
    paper = "getComputedStyle(document.body).backgroundColor"
    assert tab.evaluate(paper) == "rgb(255, 255, 255)"
    tab.locator("#theme").click()
    tab.wait_for_function("document.querySelector('.plot')._fullLayout.paper_bgcolor === '#16191d'")
    assert tab.evaluate(paper) == "rgb(22, 25, 29)"
    narrow = opened(text, width=390, scheme="dark")
    assert narrow.evaluate("document.documentElement.scrollWidth <= 390") and narrow.evaluate(paper) == "rgb(22, 25, 29)"


@pytest.mark.slow
def test_hostile_names_do_nothing(opened):
    c, arrays = stress_curve(HOSTILE)
    c |= {"why": [HOSTILE], "settings_not_run": {HOSTILE: [HOSTILE]}}
    tab = opened(page.page([c | {"body": HOSTILE}, c | {"body": "b"}], [arrays, arrays], kind=HOSTILE, name=HOSTILE))
    assert tab.evaluate("typeof window.hit") == "undefined"
    assert tab.locator("img").count() == 0
    assert "onerror" in tab.title()
