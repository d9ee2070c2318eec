"""Make the pictures of docs/howto/view.md and render.md: every mode of `neuido view` in headless Chromium, and a rendered frame.

    python docs/pictures/make_viewer_pictures.py [NAME ...]

It needs the extras `viewer` and `browser` and a Chromium, and takes some minutes without a graphics card.
"""

import json
import sys
import tempfile
import time
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from shutil import which

import numpy as np
import torch
from PIL import Image

from neuido import Body, Gaussians, Scene, Simulator, Walls, laws, render, shapes
from neuido.data import cameras
from neuido.models import attach_gaussians, deform
from neuido.physics.colliders import Cuboid, Cylinder, Sphere
from neuido.viewer.content import Content, content_of_frames
from neuido.viewer.live.live_page import LivePage
from neuido.viewer.live.live_run import LiveRun, classical_family
from neuido.viewer.notebook import player
from neuido.viewer.picture import Painter, View
from neuido.viewer.playback import Playback
from neuido.viewer.sources import read_content

HERE = Path(__file__).parent
SIZE = (1100, 660)
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
LAW = laws.FixedCorotated(3e4, 0.3)


def drop(spacing: float = 0.016, colliders: tuple = (), height: float = 0.4) -> tuple[Scene, Body]:
    scene = Scene(cells=32, dt=5e-4, walls=Walls(inset=2.0, friction=0.3), colliders=colliders)
    return scene, shapes.ball(centre=(0.5, height, 0.5), radius=0.16, spacing=spacing, velocity=(0.0, -2.0, 0.0))


def moved(scene: Scene, body: Body, steps: int = 360, law: object = LAW) -> object:
    with torch.no_grad():
        return Simulator(scene, body, device="cpu").rollout(steps, *(law if isinstance(law, tuple) else (law,)), every=12)


def rollout() -> Content:
    scene, body = drop()
    return content_of_frames(moved(scene, body), title="drop", scene=scene, law=LAW)


def diagnosis(folder: Path) -> Content:
    """Return a throw whose model lacks drag, as `neuido diagnose` stores it."""
    axis = np.linspace(-0.06, 0.06, 4)
    points = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    points = points[(np.abs(points).max(axis=1) > 0.05)]
    t = np.linspace(0.0, 0.4, 26)

    def path(drag: float) -> np.ndarray:
        decay = (1.0 - np.exp(-drag * t)) / drag if drag else t
        fall = (t - decay) / drag if drag else 0.5 * t**2
        return np.stack([1.4 * decay, 1.9 * decay - 9.81 * fall, 0.0 * t], axis=1)[:, None] + points + np.array([0.1, 0.2, 0.1])

    noise = np.random.default_rng(0).normal(scale=0.002, size=(len(t), len(points), 3))
    (folder / "predicted").mkdir(parents=True)
    np.savez(folder / "predicted" / "throw.npz", t=t, measured=path(1.1) + noise, before=path(0.0), after=path(1.05))
    plane = {"point": [0.0, 0.0, 0.0], "normal": [0.0, 1.0, 0.0], "contact": "separate", "friction": 0.3}
    told = {"experiment": "foam block", "effects": [{"name": "drag_linear"}]}
    told["recordings"] = {"throw": {"gravity": [0.0, -9.81, 0.0], "colliders": [plane]}}
    (folder / "diagnosis.json").write_text(json.dumps(told))
    return read_content(folder)


def coloured(x: torch.Tensor, volume: torch.Tensor) -> Gaussians:
    wave = 0.5 + 0.5 * torch.sin(40.0 * x)
    return attach_gaussians(x.float(), volume.float(), torch.stack([0.9 * wave[:, 0], 0.4 + 0.3 * wave[:, 1], 0.8 - 0.5 * wave[:, 2]], 1))


def filmed(folder: Path) -> Content:
    """Return a drop with five cameras and the pictures that they took of its Gaussians."""
    import cv2

    scene, body = drop()
    frames = moved(scene, body)
    content = content_of_frames(frames, title="recording", scene=scene)
    around = cameras.orbit(5, target=(0.5, 0.25, 0.5), radius=1.1, elevations=(15.0, 30.0), width=200, height=150)
    splats = coloured(body.x, body.volume)
    rows = []
    for k in range(len(frames.x)):
        images, _ = render(deform(splats, frames.F[k], frames.x[k]), around, background=torch.ones(3))
        for v, image in enumerate(images):
            cv2.imwrite(str(folder / f"{v}_{k}.png"), (255 * image.flip(-1).clamp(0, 1)).byte().numpy())
    rows = tuple(tuple(folder / f"{v}_{k}.png" for k in range(len(frames.x))) for v in range(5))
    content.cameras, content.views, content.images = around, tuple("abcde"), rows
    return content


def splats() -> Content:
    scene, body = drop()
    frames = moved(scene, body)
    own = coloured(body.x, body.volume)
    parts = [deform(own, F, x) for F, x in zip(frames.F, frames.x)]
    return Content("splats", gaussians=parts, planes=content_of_frames(frames, scene=scene).planes, times=frames.times.numpy())


def live() -> LivePage:
    scene, body = drop(0.02, height=0.3)
    family = classical_family({"law": "fixed_corotated", "young": 3e4, "poisson": 0.3}, {"law": "identity"})
    return LivePage(LiveRun(Simulator(scene, body, device="cpu"), family), "jelly", port=8930)


def pulled(page: LivePage) -> None:
    """Let the body fall, and pull it up at one side."""
    page.run.play()
    wait(lambda: page.run.time > 0.15)
    corner = page.run.state.x[page.run.state.x.sum(dim=1).argmax()].numpy()
    page.run.grip(corner)
    page.run.drag(corner + np.array([0.1, 0.25, 0.05]))
    begun = page.run.time
    wait(lambda: page.run.time > begun + 0.12)
    page.run.play(False)
    page.show()


def flattened() -> Content:
    """Return a drop of plasticine, which has all quantities of a single body."""
    scene, body = drop(0.02)
    law = laws.Sigma(1e5, 0.3), laws.VonMises(2e3, 1e5, 0.3)
    return content_of_frames(moved(scene, body, 288, law), title="plasticine", scene=scene, law=law[0])


def colours(browser: object, out: Path, settle: float = 12.0) -> None:
    """Photograph each way to colour the particles, beside one another."""
    page = Playback(flattened(), port=8920)
    tab = browser.new_page(viewport={"width": 700, "height": 380})
    tab.set_default_timeout(240_000)
    tab.goto(page.url)
    tab.wait_for_selector("canvas")
    pictures = []
    for name in page.content.quantities():
        page.colour.value = name
        page._recolour(name)
        page.show(24)
        tab.wait_for_timeout(1000 * settle)
        for cross in tab.locator(".mantine-Notification-closeButton").all():
            cross.click()
        pictures.append(Image.open(BytesIO(tab.screenshot())).convert("RGB"))
    tab.close()
    page.stop()
    sheet = Image.new("RGB", (2 * 700, 380 * -(-len(pictures) // 2)), "white")
    for k, picture in enumerate(pictures):
        sheet.paste(picture, (700 * (k % 2), 380 * (k // 2)))
    sheet.save(out, quality=80)


def wait(done: Callable[[], bool], seconds: float = 300.0) -> None:
    end = time.monotonic() + seconds
    while not done():
        if time.monotonic() > end:
            raise SystemExit("the simulation did not get so far")
        time.sleep(0.05)


def rendered(path: Path) -> None:
    solids = (
        Sphere(radius=0.12, position=(0.42, 0.2, 0.5)),
        Cylinder(radius=0.05, length=0.4, position=(0.72, 0.12, 0.5), rotation=(0.7071, 0.7071, 0.0, 0.0)),
        Cuboid(size=(0.14, 0.14, 0.14), position=(0.24, 0.135, 0.66), rotation=(0.92, 0.0, 0.38, 0.0)),
    )
    scene, body = drop(0.014, solids, 0.56)
    content = content_of_frames(moved(scene, body, 480), title="drop", scene=scene, law=LAW)
    Image.fromarray(Painter(content, "speed", View(width=900, height=600)).picture(20)).save(path, quality=82)


def photograph(browser: object, url: str, path: Path, settle: float = 25.0, act: Callable[[], None] = lambda: None) -> None:
    tab = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
    tab.set_default_timeout(240_000)
    tab.goto(url)
    tab.wait_for_selector("canvas")
    act()
    tab.wait_for_timeout(1000 * settle)  # the software renderer reduces its resolution at first
    for cross in tab.locator(".mantine-Notification-closeButton").all():
        cross.click()
    tab.wait_for_timeout(4000)
    png = path.with_suffix(".png")
    tab.screenshot(path=png)
    Image.open(png).convert("RGB").save(path, quality=80)
    png.unlink()
    tab.close()


def main(names: list[str]) -> None:
    from playwright.sync_api import sync_playwright

    program = which("chromium") or which("chromium-browser") or which("google-chrome")
    wanted = names or ["view", "diagnosis", "recording", "splats", "live", "notebook", "render", "colours"]
    with tempfile.TemporaryDirectory() as place, sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program, args=FLAGS)
        folder = Path(place)
        made = {
            "view": lambda: (rollout(), "von Mises stress", 22),
            "diagnosis": lambda: (diagnosis(folder / "diagnosis"), "residual", 20),
            "recording": lambda: (filmed(folder), "speed", 14),
            "splats": lambda: (splats(), None, 18),
        }
        for name in wanted:
            out = HERE / f"viewer-{name}.webp"
            if name == "render":
                rendered(out)
            elif name == "colours":
                colours(browser, out)
            elif name == "live":
                page = live()
                photograph(browser, page.url, out, act=lambda page=page: pulled(page))
                page.stop()
            elif name == "notebook":
                html = player(rollout(), colour="strain").save(folder / "motion.html")
                photograph(browser, html.as_uri(), out)
            else:
                content, colour, frame = made[name]()
                page = Playback(content, colour=colour, port=8920)
                page.show(frame)
                page.slider.value = frame
                photograph(browser, page.url, out)
                page.stop()
            print(f"{out.name}: {out.stat().st_size / 1000:.0f} kB", flush=True)
        browser.close()


if __name__ == "__main__":
    main(sys.argv[1:])
