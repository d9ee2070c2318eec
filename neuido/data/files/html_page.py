"""Self-contained HTML pages with tables, inline figures, pictures and videos. Figures need matplotlib."""

import base64
import html
import io
import math
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from neuido.errors import shortened

STYLE = """body{font:15px/1.45 system-ui,sans-serif;color:#222;max-width:1120px;margin:2em auto;padding:0 1em}
h1{font-size:1.5em}h2{font-size:1.2em;margin-top:2em;border-bottom:1px solid #ddd}img,svg{max-width:100%;height:auto}
table{border-collapse:collapse;margin:.6em 0}td,th{padding:.2em .8em;text-align:left;border-bottom:1px solid #eee;font-size:.93em}
td.n{text-align:right;font-variant-numeric:tabular-nums}.best{font-weight:bold}.note{color:#666;font-size:.9em}
figure{display:inline-block;margin:.3em;vertical-align:top}figcaption{font-size:.85em}video{max-width:520px}"""


class Best(NamedTuple):
    """Value of a table cell that is shown in bold."""

    value: Any


def page(title: str, body: str, *, style: str = "") -> str:
    """Return a complete HTML page.

    Args:
        title: Title of the window.
        body: HTML of the body.
        style: CSS that is added to `STYLE`.
    """
    head = f'<meta charset="utf-8"><title>{escaped(title)}</title><style>{STYLE}{style}</style>'
    return f'<!doctype html>\n<html lang="en"><head>{head}</head><body>\n{body}\n</body></html>\n'


def escaped(value: Any) -> str:
    """Convert a value to text with HTML characters escaped."""
    return html.escape(str(value))


def table(head: Sequence[str], rows: Sequence[Sequence[Any]], *, digits: int = 4) -> str:
    """Format a table as HTML: numbers right-aligned with `digits` significant digits, NaN and None empty, `Best` in bold."""
    if not rows:
        return "<p>None.</p>"

    def cell(value: Any) -> str:
        bold = " best" if isinstance(value, Best) else ""
        value = value.value if isinstance(value, Best) else value
        if value is None or (isinstance(value, float) and math.isnan(value)):
            return "<td></td>"
        if isinstance(value, float | int) and not isinstance(value, bool):
            return f'<td class="n{bold}">{value:.{digits}g}</td>'
        return f'<td class="t{bold}">{escaped(value)}</td>' if bold else f"<td>{escaped(value)}</td>"

    lines = ["<tr>" + "".join(f"<th>{escaped(h)}</th>" for h in head) + "</tr>"] if any(head) else []
    lines += ["<tr>" + "".join(cell(v) for v in row) + "</tr>" for row in rows]
    return "<table>" + "\n".join(lines) + "</table>"


def picture(path: Path) -> str:
    """Embed a PNG file in HTML."""
    return png(path.read_bytes(), path.stem)


def png(data: bytes, name: str) -> str:
    """Embed the bytes of a PNG file in HTML; `name` is the alternative text."""
    return f'<p><img alt="{escaped(name)}" src="data:image/png;base64,{base64.b64encode(data).decode()}"></p>'


def video(path: Path, caption: str, *, width: int = 520) -> str | None:
    """Embed a video file in HTML; return None if OpenCV cannot read it.

    The video is converted to WebM, because browsers do not play the MPEG-4 files that OpenCV writes.

    Args:
        path: The video file.
        caption: Text below the video.
        width: Largest width [px].
    """
    data = webm(path, width)
    if data is None:
        return None
    source = f"data:video/webm;base64,{base64.b64encode(data).decode()}"
    return f'<figure><video controls loop muted playsinline src="{source}"></video><figcaption>{escaped(caption)}</figcaption></figure>'


def webm(path: Path, width: int) -> bytes | None:
    """Convert a video file to WebM (VP9), at most `width` pixels wide; return None if OpenCV cannot read or write it."""
    import cv2

    if not path.is_file():
        return None
    with _silenced_stderr():
        source = cv2.VideoCapture(str(path))
    size = [int(source.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
    if not source.isOpened() or min(size) < 2:
        return None
    scale = min(1.0, width / size[0])
    smaller = tuple(max(2, round(scale * n) // 2 * 2) for n in size)  # the codec wants even sides
    handle, name = tempfile.mkstemp(suffix=".webm")
    os.close(handle)
    try:
        with _silenced_stderr():
            sink = cv2.VideoWriter(name, cv2.VideoWriter.fourcc(*"VP90"), source.get(cv2.CAP_PROP_FPS) or 20.0, smaller)
            if not sink.isOpened():
                return None
            while (read := source.read())[0]:
                sink.write(cv2.resize(read[1], smaller, interpolation=cv2.INTER_AREA))
            sink.release()
        return Path(name).read_bytes() or None
    finally:
        source.release()
        Path(name).unlink()


class _silenced_stderr:
    """Context that discards stderr, where FFmpeg reports a damaged file and a codec tag that WebM does not use."""

    def __enter__(self) -> None:
        import sys

        sys.stderr.flush()
        self.kept, sink = os.dup(2), os.open(os.devnull, os.O_WRONLY)
        os.dup2(sink, 2)
        os.close(sink)

    def __exit__(self, *details: object) -> None:
        os.dup2(self.kept, 2)
        os.close(self.kept)


def figure(rows: int, columns: int, size: tuple[float, float]) -> tuple[Any, Any] | None:
    """Create a matplotlib figure without a window and its axes (rows, columns); return None if matplotlib is not installed."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        return None
    made = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(made)
    return made, made.subplots(rows, columns, squeeze=False)


def svg(made: Any) -> str:
    """Convert a matplotlib figure to an inline SVG element."""
    import matplotlib

    stream = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "neuido"}):
        made.savefig(stream, format="svg", metadata={"Date": None})
    return stream.getvalue().partition("<svg")[1] + stream.getvalue().partition("<svg")[2]


def plain(text: str) -> str:
    """Return text that a figure shows as it is: no mathematics between dollar signs, which fails where it is malformed."""
    return shortened(text).replace("$", r"\$")


def style_axes(ax: Any) -> None:
    """Style the axes of a report figure: small tick labels, no upper and right frame line."""
    ax.tick_params(which="both", labelsize=7)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
