"""A player of a motion for notebooks and as one HTML file: nothing serves it and nothing is loaded from elsewhere."""

import html
import os
from pathlib import Path
from typing import Any

import numpy as np

from neuido.data.files.html_page import escaped
from neuido.data.files.writing import write_text
from neuido.errors import UserError, suggest
from neuido.types import Scene
from neuido.viewer.content import Content, content_of_frames
from neuido.viewer.playback import LEAST_SECONDS
from neuido.viewer.world import Drawn, close_server, furnish, legend_html, open_server, show_surface

ROOM = 6_000_000
"""Size of the positions and colours of a player [bytes]; a page is a third larger, and has 0.8 MB of viser beside."""
POINT_BYTES = 15
"""Position in float32 and colour of a point [bytes]."""
MOST_FRAMES, LEAST_FRAMES = 80, 20
FREE_PORT = 8980
"""Port from which a free one is sought while a player is made; nothing listens afterwards."""


NOTE = (
    "position:fixed;right:10px;top:8px;z-index:9;width:210px;padding:4px 0;font:14px system-ui,sans-serif;color:#28303a;"
    "background:rgba(255,255,255,.75);border-radius:4px"
)
"""Style of the title and the legend over the player."""


class Player:
    """A motion as a page of its own; a notebook shows it.

    Args:
        page: The whole HTML page.
        height: Height in a notebook [px].
    """

    def __init__(self, page: str, height: int) -> None:
        self.page, self.height = page, height

    def _repr_html_(self) -> str:
        return f'<iframe srcdoc="{html.escape(self.page)}" width="100%" height="{self.height}" style="border:1px solid #ddd"></iframe>'

    def __repr__(self) -> str:
        return f"Player({len(self.page) / 1e6:.1f} MB of HTML; the last line of a notebook's cell shows it, save(path) writes it)"

    def save(self, path: str | os.PathLike) -> Path:
        """Write the player as one HTML file that opens in any browser, and return its path.

        Raises:
            UserError: The name does not end in .html.
        """
        target = Path(path).expanduser()
        if target.suffix.lower() not in (".html", ".htm"):
            raise UserError(f"path = {path}: a player is an HTML file; let its name end in .html")
        write_text(target, self.page)
        return target


def show(frames: Any, *, law: Any = None, scene: Scene | None = None, colour: str | None = None, height: int = 480) -> Player:
    """Return a player of frames for a notebook, which shows it where it is the last line of a cell; it needs no server.

    Args:
        frames: `Frames`, or what else has `x`, and `v`, `C` and `F` where they are coloured by.
        law: Elastic law, or an elastic and a plastic one, for the colours of stress.
        scene: The scene of the frames, for floor and gravity.
        colour: Quantity by which particles are coloured, such as "speed" or "strain"; the first that there is where absent.
        height: Height of the player [px].

    Returns:
        The player; its `save` writes it as one HTML file.

    Raises:
        UserError: The extra `viewer` is missing, or the frames have no such quantity.
    """
    elastic = law[0] if isinstance(law, tuple | list) else law
    return player(content_of_frames(frames, scene=scene, law=elastic), colour=colour, height=height)


def player(content: Content, *, colour: str | None = None, height: int = 480) -> Player:
    """Return a player of a content.

    Long motions of many particles are thinned to `ROOM` bytes: first frames, then particles.

    Args:
        content: What is shown.
        colour: Name of the quantity by which particles are coloured; the first one where absent.
        height: Height in a notebook [px].

    Raises:
        UserError: The extra `viewer` is missing, or an unknown quantity.
    """
    names = content.quantities()
    if colour is not None and colour not in names:
        raise UserError(f"colour = {colour!r} is not known here{suggest(colour, names) or ';'} it is one of {', '.join(names)}")
    chosen = colour or names[0]
    frames = _thin(content)
    shown = content.quantity(chosen)
    server = open_server("neuido", "localhost", FREE_PORT)
    try:
        furnish(server, content)
        drawn = [Drawn(server, content, i, keeps=False) for i in range(len(content.motions))]
        surfaces: list[Any] = [None] * len(content.surfaces)
        times = content.times[frames]
        length = max(float(times[-1] - times[0]), 1e-9)
        stretch = max(1.0, LEAST_SECONDS / length) if len(frames) > 1 else 0.0
        serializer = server.get_scene_serializer()
        for i, frame in enumerate(frames):
            for each in drawn:
                each.show(int(frame), chosen)
            for k, surface in enumerate(content.surfaces):
                surfaces[k] = show_surface(server, k, surface, int(frame), surfaces[k])
            if len(frames) > 1:
                serializer.insert_sleep(float(stretch * (times[i + 1] - times[i] if i + 1 < len(times) else times[-1] - times[-2])))
        page = serializer.as_html()
    finally:
        close_server(server)
    slower = f", {stretch:.3g} times slower" if stretch > 1 and content.timed else ""
    words = f"{escaped(content.title)}{f', {length:.3g} s{slower}' if content.timed and len(frames) > 1 else ''}"
    note = f"<div style='{NOTE}'><div style='padding:0 1em'>{words}</div>{legend_html(shown)}</div>"
    at = page.rindex("</body>") if "</body>" in page else len(page)
    return Player(page[:at] + note + page[at:], height)


def _thin(content: Content) -> np.ndarray:
    """Return the frames that are kept, and set how many particles of each motion are drawn."""
    points = sum(motion.x.shape[1] for motion in content.motions)
    fitting = int(ROOM / max(points * POINT_BYTES, 1))
    many = min(content.frames, max(LEAST_FRAMES, min(MOST_FRAMES, fitting)))
    frames = np.unique(np.linspace(0, content.frames - 1, many).round().astype(int))
    for motion in content.motions:
        motion.thinning = max(1, int(np.ceil(len(frames) * points * POINT_BYTES / ROOM)))
    return frames
