"""The page of a motion that was recorded or simulated before: play, pause, time, speed, colours and what is shown."""

import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from neuido.data.files.html_page import escaped
from neuido.viewer.content import Content
from neuido.viewer.world import HOST, PORT, Drawn, address_of, close_server, furnish, legend_html, open_server, show_surface

SPEEDS = ("1/100", "1/20", "1/5", "1/2", "1", "2", "5")
"""Speeds of playing relative to the motion."""
LEAST_SECONDS = 2.0
"""A motion that is shorter is played slower at first, so that it takes at least as long."""
PACE = 30.0
"""Largest number of pictures a second that the server sends."""
TOLD_SECONDS = 0.3
"""Time between two updates of the controls while a motion plays [s]."""
IMAGE_WIDTH = 480
"""Width to which the images of cameras are reduced [px]."""


class Playback:
    """A page that plays a content.

    Args:
        content: What is shown.
        colour: Name of the quantity by which particles are coloured at first; the first one where absent.
        host: Address that the server listens at.
        port: Port; another one is taken where it is in use.

    Attributes:
        server: The viser server.
        frame: The frame that is shown.
    """

    def __init__(self, content: Content, *, colour: str | None = None, host: str = HOST, port: int = PORT) -> None:
        self.content, self.title, self.frame, self.pictures = content, content.title, 0, 0
        self.server = open_server("neuido", host, port)
        self._lock, self._ended = threading.RLock(), threading.Event()
        self._groups = furnish(self.server, content)
        self.drawn = [Drawn(self.server, content, i) for i in range(len(content.motions))]
        self._surfaces: list[Any] = [None] * len(content.surfaces)
        self._splats: Any = None
        self._colour = colour or content.quantities()[0]
        self._add_controls()
        self.show(0)
        self._thread = threading.Thread(target=self._play, daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Address of the page."""
        return address_of(self.server)

    def _add_controls(self) -> None:
        gui, content = self.server.gui, self.content
        gui.add_markdown(f"**{escaped(content.title)}**" + "".join(f"\n\n{escaped(note)}" for note in content.notes))
        many = content.frames > 1
        self.play = gui.add_checkbox("play", False, visible=many, hint="plays again from the start at the end")
        self.slider = gui.add_slider("frame", 0, max(content.frames - 1, 1), 1, 0, visible=many)
        self.time = gui.add_text("time" if content.timed else "frame", content.words(0), disabled=True, visible=many)
        self.speed = gui.add_dropdown("speed", SPEEDS, initial_value=self._first_speed(), visible=many)
        self.colour = gui.add_dropdown("colour", content.quantities(), initial_value=self._colour, visible=bool(content.motions))
        self.legend = gui.add_html(legend_html(content.quantity(self._colour)), visible=bool(content.motions))
        self.slider.on_update(self._slid)
        self.colour.on_update(lambda event: self._recolour(str(self.colour.value)))
        with gui.add_folder("shown", expand_by_default=False):
            self.size = gui.add_slider("point size", 0.2, 3.0, 0.1, 1.0, visible=bool(content.motions))
            self.size.on_update(lambda event: self._resize(float(self.size.value)))
            for name, handles in self._groups.items():
                self._switch(name, lambda on, handles=handles: [setattr(handle, "visible", on) for handle in handles])
            kinds = {"particles": bool(content.motions), "skin": any(d.motion.skins for d in self.drawn)}
            kinds |= dict.fromkeys(("measured", "arrows"), any(d.motion.reference is not None for d in self.drawn))
            for name in (name for name, there in kinds.items() if there):
                self._switch(name, lambda on, name=name: self._choose(name, on))
            if content.gaussians:
                self._switch("splats", lambda on: setattr(self._splats, "visible", on))

    def _switch(self, name: str, act: Any) -> None:
        box = self.server.gui.add_checkbox(name, True)
        box.on_update(lambda event: act(bool(box.value)))

    def _first_speed(self) -> str:
        length = float(self.content.times[-1] - self.content.times[0])
        fitting = [each for each in SPEEDS[:5] if length / speed_factor(each) >= LEAST_SECONDS]
        return fitting[-1] if fitting else SPEEDS[0]

    def show(self, frame: int, *, told: bool = True) -> None:
        """Show a frame; `told`: also in the controls, which cost a browser more than the particles."""
        content = self.content
        with self._lock, self.server.atomic():
            self.frame = frame = int(np.clip(frame, 0, content.frames - 1))
            self.pictures += 1
            for drawn in self.drawn:
                drawn.show(frame, self._colour)
            for i, surface in enumerate(content.surfaces):
                self._surfaces[i] = show_surface(self.server, i, surface, frame, self._surfaces[i])
            if content.gaussians and (len(content.gaussians) > 1 or self._splats is None):
                self._show_splats(frame)
            self._show_images(frame)
            if told:
                self.time.value, self.slider.value = content.words(frame), frame
        self.server.flush()

    def _slid(self, event: Any) -> None:
        if event.client_id is not None:  # not moved by `_play`
            self.show(int(self.slider.value))

    def _show_splats(self, frame: int) -> None:
        from neuido.models.render.gaussians import colours_of

        own = self.content.gaussians[frame]
        colours = colours_of(own.harmonics[:, :1], None, degree=0).clamp(0, 1)
        parts = [part.detach().cpu().numpy().astype(np.float32) for part in (own.means, own.covariances, colours, own.opacities[:, None])]
        self._splats = self.server.scene.add_gaussian_splats("/splats", *parts)

    def _show_images(self, frame: int) -> None:
        for handle, row in zip(self._groups.get("cameras", ()), self.content.images):
            path = row[min(frame, len(row) - 1)]
            if path is not None:
                handle.image = small_image(path)

    def _recolour(self, name: str) -> None:
        with self._lock:
            self._colour = name
            self.legend.content = legend_html(self.content.quantity(name))
            self.show(self.frame)

    def _resize(self, scale: float) -> None:
        with self._lock:
            for drawn in self.drawn:
                for cloud in (drawn.cloud, drawn.measured):
                    cloud.scale = scale
                    cloud.resize(0.55 if drawn.motion.reference is not None else 1.0)

    def _choose(self, name: str, on: bool) -> None:
        for drawn in self.drawn:
            drawn.shown[name] = on
        self.show(self.frame)

    def _play(self) -> None:
        """Move on in time while `play` is set; the slider follows, and a move of the slider is followed."""
        times = self.content.times - self.content.times[0]
        length = float(times[-1]) * (1 + 1 / max(len(times) - 1, 1))  # the last frame stays as long as the others
        now, before, told = 0.0, time.monotonic(), 0.0
        while not self._ended.wait(1.0 / PACE):
            passed, before = time.monotonic() - before, time.monotonic()
            if not self.play.value or length <= 0:
                if told and self.slider.value != self.frame:  # just stopped
                    self.show(self.frame)
                self._prepare()
                continue
            if int(np.searchsorted(times, now, side="right")) - 1 != self.frame:  # someone moved the slider
                now = float(times[self.frame])
            now = (now + passed * speed_factor(str(self.speed.value))) % length
            frame = max(int(np.searchsorted(times, now, side="right")) - 1, 0)
            if frame != self.frame:
                due = time.monotonic() - told > TOLD_SECONDS
                told = time.monotonic() if due else told
                self.show(frame, told=due)

    def _prepare(self) -> None:
        """Send a frame that is not shown yet, so that playing does not wait for it."""
        with self._lock:
            for drawn in self.drawn:
                if drawn.prepare(self._colour):
                    self.server.flush()
                    return

    def wait(self) -> None:
        """Serve until `stop` is called or the process is interrupted."""
        self._ended.wait()

    def stop(self) -> None:
        """End the server."""
        self._ended.set()
        self._thread.join(timeout=5.0)
        close_server(self.server)


def speed_factor(speed: str) -> float:
    """Return a speed of `SPEEDS` as a number."""
    over, _, under = speed.partition("/")
    return float(over) / float(under or 1)


def small_image(path: Path) -> np.ndarray:
    """Return the image of a file, RGB (H, W, 3) uint8, at most `IMAGE_WIDTH` wide; transparent parts are white."""
    import cv2

    from neuido.data.files.parsing import read_image

    image = read_image(path)
    image = (image >> 8).astype(np.uint8) if image.dtype == np.uint16 else image
    image = np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image
    if image.shape[2] == 4:
        share = image[..., 3:].astype(np.float32) / 255.0
        image = (share * image[..., :3] + 255.0 * (1.0 - share)).astype(np.uint8)
    width = min(IMAGE_WIDTH, image.shape[1])
    small = cv2.resize(image, (width, max(1, round(image.shape[0] * width / image.shape[1]))), interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(small[..., ::-1])
