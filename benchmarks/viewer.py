"""Pictures a second of `neuido view` in headless Chromium, and of `neuido render`, on the CPU.

    python benchmarks/viewer.py [--particles 20000] [--seconds 10] [--csv research/results/viewer.csv]

The page has no graphics card here: Chromium draws it with SwiftShader. Counted are the pictures that the server sends, those that the page
receives, and those that the page draws (`requestAnimationFrame`) meanwhile; the least of them is what a person sees. On a machine that
does other work too, the processor time of a picture says what it would be: of the server, and of all processes of Chromium.
"""

import argparse
import csv
import os
import time
from pathlib import Path
from shutil import which

import numpy as np

from neuido.data.files.writing import atomic_write
from neuido.viewer.content import Content, Motion
from neuido.viewer.picture import Painter, View
from neuido.viewer.playback import Playback

FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
DRAWN = """(seconds) => new Promise(done => { let n = 0; const start = performance.now();
    const count = () => { n++; const passed = performance.now() - start;
        passed > 1000 * seconds ? done(1000 * n / passed) : requestAnimationFrame(count) }; count() })"""


def content(particles: int, frames: int = 60) -> Content:
    """Return a ball of particles that turns and swells."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(particles, 3))
    x *= 0.2 * rng.random((particles, 1)) ** (1 / 3) / np.linalg.norm(x, axis=1, keepdims=True)
    turn = np.linspace(0.0, 2 * np.pi, frames)
    path = [x @ np.array([[np.cos(a), 0, np.sin(a)], [0, 1 + 0.2 * np.sin(a), 0], [-np.sin(a), 0, np.cos(a)]]).T for a in turn]
    times = np.linspace(0.0, 2.0, frames)
    return Content("ball", [Motion("ball", times, np.stack(path).astype(np.float32))], times=times)


def in_the_browser(particles: int, seconds: float, warm: float) -> dict[str, float]:
    """Return pictures a second that were sent, received and drawn while a motion plays, and the processor time of each."""
    from playwright.sync_api import sync_playwright

    program = which("chromium") or which("chromium-browser") or which("google-chrome")
    page, received = Playback(content(particles), port=8940), [0]
    page.speed.value = "1"
    try:
        with sync_playwright() as driver:
            browser = driver.chromium.launch(executable_path=program, args=FLAGS)
            tab = browser.new_page(viewport={"width": 1000, "height": 600})
            tab.set_default_timeout(300_000)

            def listen(socket: object) -> None:
                socket.on("framereceived", lambda message: received.__setitem__(0, received[0] + (len(message) > 10 * particles)))

            tab.on("websocket", listen)
            tab.goto(page.url)
            tab.wait_for_selector("canvas")
            page.play.value = True
            tab.wait_for_timeout(1000 * warm)
            sent, got, begun = page.pictures, received[0], time.monotonic()
            before = time.process_time(), of_chromium()
            drawn = tab.evaluate(DRAWN, seconds)
            passed = time.monotonic() - begun
            spent = time.process_time() - before[0], of_chromium() - before[1]
            rates = {"sent": (page.pictures - sent) / passed, "received": (received[0] - got) / passed, "drawn": drawn}
            out = {f"{name} [1/s]": rate for name, rate in rates.items()}
            out["server [CPU ms/picture]"] = 1000 * spent[0] / max(page.pictures - sent, 1)
            out["Chromium [CPU ms/picture]"] = 1000 * spent[1] / max(drawn * passed, 1)
            browser.close()
    finally:
        page.stop()
    return out


def of_chromium() -> float:
    """Return the processor time of the processes below this one [s]."""
    import psutil

    return sum(sum(child.cpu_times()[:2]) for child in psutil.Process().children(recursive=True))


def without_display(particles: int, count: int = 5) -> float:
    """Return the seconds that a picture of 800 x 600 px takes."""
    shown = content(particles)
    painter = Painter(shown, shown.quantities()[0], View())
    painter.picture(0)
    begun = time.monotonic()
    for k in range(count):
        painter.picture(k)
    return (time.monotonic() - begun) / count


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--particles", type=int, default=20_000)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--warm", type=float, default=20.0, help="seconds before the count, in which Chromium compiles its shaders")
    parser.add_argument("--csv", type=Path)
    given = parser.parse_args()
    found = in_the_browser(given.particles, given.seconds, given.warm)
    row = {"particles": given.particles, "cores": os.cpu_count(), "load": round(os.getloadavg()[0], 1)}
    row |= {name: round(value, 1) for name, value in found.items()}
    row["render [s]"] = round(without_display(given.particles), 2)
    print(", ".join(f"{name}: {value}" for name, value in row.items()))
    if given.csv:
        with atomic_write(given.csv) as hidden, hidden.open("w") as file:
            writer = csv.DictWriter(file, row)
            writer.writeheader()
            writer.writerow(row)


if __name__ == "__main__":
    main()
