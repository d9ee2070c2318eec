"""Hostile and malformed videos, images and cameras, listed by kind: one line, status 2, nothing half-written, no path outside."""

import json
import os
import random
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.command import run
from tests.data import samples
from tests.data.footage import drawn
from tests.faults.mutations import png_bomb

Case = tuple[str, Callable[[Path], list[str]]]
"""What it is, and a function that writes it into a folder and returns the arguments of the command."""


def file(name: str, content: bytes, *options: str) -> Callable[[Path], list[str]]:
    def make(folder: Path) -> list[str]:
        (folder / name).write_bytes(content)
        return ["import", str(folder / name), "--scale", "0.01", "--out", str(folder / "out"), *options]

    return make


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> bytes:
    path = tmp_path_factory.mktemp("clip") / "a.mp4"
    drawn.throw(path, count=8)
    return path.read_bytes()


def videos(clip: bytes, secret: Path) -> Iterator[Case]:
    yield "empty", file("a.mp4", b"")
    yield "text", file("a.mp4", b"t,x,y\n0,1,2\n")
    yield "page", file("a.mp4", b"<html><script>alert(1)</script></html>")
    yield "zip", file("a.mov", b"PK\x03\x04" + b"\0" * 100)
    yield "noise", file("a.avi", random.Random(0).randbytes(4000))
    yield "header alone", file("a.mp4", clip[:40])
    for share in (0.1, 0.5, 0.9):
        yield f"truncated at {share:.0%}", file("a.mp4", clip[: int(share * len(clip))])
    yield (
        "playlist that names a file",
        file("a.mp4", f"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nfile://{secret}\n#EXT-X-ENDLIST\n".encode()),
    )
    yield "list of files", file("a.mkv", f"ffconcat version 1.0\nfile '{secret}'\n".encode())
    yield "script of avisynth", file("a.avi", f'LoadPlugin("{secret}")'.encode())
    yield "picture as a video", file("a.mp4", cv2.imencode(".png", np.zeros((8, 8, 3), np.uint8))[1].tobytes())
    yield "bomb as a video", file("a.webm", png_bomb(4000, 4000))
    for options, label in (
        (["--start", "9"], "start after the end"),
        (["--end", "-1"], "end before the start"),
        (["--frame_rate", "0"], "no rate"),
        (["--frame_rate", "-30"], "negative rate"),
        (["--frame_rate", "nan"], "a rate that is none"),
        (["--background", "absent.png"], "no background"),
        (["--background", "/etc/passwd"], "a background that is no image"),
        (["--background", "/"], "a folder as background"),
        (["--kind", "body"], "a body"),
        (["--cameras", "board"], "one camera alone"),
        (["--cameras", "/nowhere"], "cameras that are nowhere"),
        (["--cameras", "board", "--board", "7x5 40 mm 30 mm 4X4_50; rm -rf /"], "a board with a command"),
        (["--cameras", "board", "--board", "__class__"], "a board that is none"),
        (["--held_out", "../../evil"], "a path as a name"),
        (["--picture", "/proc/none/sheet.png"], "a picture that cannot be written"),
        (["--picture", "/etc/passwd/sheet.png"], "a picture below a file"),
        (["--start", "one"], "a start that is no number"),
        (["--offsets", "[1, x]"], "offsets that are none"),
    ):
        yield label, file("a.mp4", clip, *options)

    def two(*options: str) -> Callable[[Path], list[str]]:
        def make(folder: Path) -> list[str]:
            for name in ("a.mp4", "b.mp4"):
                (folder / name).write_bytes(clip)
            return ["import", str(folder / "a.mp4"), str(folder / "b.mp4"), "--out", str(folder / "out"), *options]

        return make

    board = ["--cameras", "board", "--board", "7x5 40 mm 30 mm 4X4_50"]
    yield "no board in the clips", two(*board)
    yield "no flash", two("--cameras", "board", "--board", "7x5 40 mm 30 mm 4X4_50", "--synchronise", "flash")
    yield "an unknown clock", two(*board, "--synchronise", "wave")
    yield "a number of offsets", two(*board, "--offsets", "[0.1]")
    yield "an axis that is none", two(*board, "--up", "w")
    yield "both clocks", two(*board, "--offsets", "[0, 1]", "--synchronise", "flash")
    yield "neither scale nor diameter", two()


def recordings(secret: Path) -> Iterator[Case]:
    """Nerfstudio recordings with one thing changed."""

    def changed(change: Callable[[dict, Path], object]) -> Callable[[Path], list[str]]:
        def make(folder: Path) -> list[str]:
            samples.nerfstudio(folder / "in", samples.Sample(frame_count=3))
            content = json.loads((folder / "in" / "transforms.json").read_text())
            text = change(content, folder / "in")
            (folder / "in" / "transforms.json").write_text(text if isinstance(text, str) else json.dumps(content))
            return ["check", str(folder / "in")]

        return make

    def key(name: str, value: object, *, frame: bool = True) -> Case:
        def change(content: dict, _: Path) -> None:
            (content["frames"][0] if frame else content)[name] = value

        return f"{name} = {str(value)[:40]}", changed(change)

    outside = ("../../evil.png", "/etc/passwd", str(secret), "C:\\evil.png", "\\\\host\\a.png", "images/../../../a.png", "~/a.png")
    for name in (*outside, "a\0b", "", "x" * 5000, "images", ".", 3, None, ["images/0_000.png"], {"a": 1}):
        yield key("file_path", name)
    for name in ("../mask.png", "/dev/zero", "images", 7):
        yield key("mask_path", name)
    eye = np.eye(4).tolist()
    arrays = (np.zeros((4, 4)), np.diag([1.0, 1, -1, 1]), np.full((4, 4), np.nan), np.eye(4) + np.eye(4, k=-3), np.eye(2))
    for value in (None, [], "eye", eye[:2], [[1e308] * 4] * 4, [["a"] * 4] * 4, *(array.tolist() for array in arrays)):
        yield key("transform_matrix", value)
    for name, values in (
        ("fl_x", (0, -1, "f", float("nan"), [1])),
        ("w", (0, 10**12, "x")),
        ("k4", (0.1,)),
        ("time", (float("inf"), -1, "now")),
        ("view", (1.5, None, [])),
        ("camera_model", ("OPENCV_FISHEYE", 3)),
        ("is_fisheye", (True,)),
        ("distortion_params", ([1], "k")),
    ):
        for value in values:
            yield key(name, value)
    for value in (None, [], {}, 3, [3], "frames"):
        yield key("frames", value, frame=False)
    yield "json that is nested without end", changed(lambda content, _: "[" * 100_000)
    yield "json of one number", changed(lambda content, _: "9" * 6000)
    yield "no json", changed(lambda content, _: "{'frames': []}")

    def image(content: Callable[[Path], object]) -> Callable[[Path], list[str]]:
        def change(_: dict, folder: Path) -> None:
            path = folder / "images" / "0_000.png"
            path.unlink()
            content(path)

        return changed(change)

    png = cv2.imencode(".png", np.zeros((12, 16, 3), np.uint8))[1].tobytes()
    yield "a missing image", image(lambda path: None)
    yield "an empty image", image(lambda path: path.write_bytes(b""))
    yield "an image cut short", image(lambda path: path.write_bytes(png[:30]))
    yield "text as an image", image(lambda path: path.write_text("image"))
    yield "a folder as an image", image(lambda path: path.mkdir())
    yield "a link out of the folder", image(lambda path: path.symlink_to(secret))
    yield "a link to itself", image(lambda path: path.symlink_to(path.name))
    yield "an image of another shape", image(lambda path: cv2.imwrite(str(path), np.zeros((40, 10, 3), np.uint8)))
    yield (
        "a size that is a lie",
        image(lambda path: path.write_bytes(png.replace(struct.pack(">II", 16, 12), struct.pack(">II", 2**20, 2**20)))),
    )


def colmap_models() -> Iterator[Case]:
    def changed(name: str, change: Callable[[bytes], bytes]) -> Callable[[Path], list[str]]:
        def make(folder: Path) -> list[str]:
            samples.colmap(folder / "in", samples.Sample(frame_count=1))
            (path,) = (folder / "in").rglob(name)
            path.write_bytes(change(path.read_bytes()))
            return ["check", str(folder / "in")]

        return make

    for name in ("cameras.bin", "images.bin"):
        yield f"{name}, empty", changed(name, lambda data: b"")
        yield f"{name}, cut short", changed(name, lambda data: data[:-5])
        yield f"{name}, a count without end", changed(name, lambda data: struct.pack("<Q", 2**60) + data[8:])
        yield f"{name}, no entries", changed(name, lambda data: struct.pack("<Q", 0))
        yield f"{name}, text", changed(name, lambda data: b"# Camera list\n1 PINHOLE 16 12 1 1 1 1\n")
    yield "an unknown lens", changed("cameras.bin", lambda data: data[:12] + struct.pack("<i", 99) + data[16:])
    yield "a name that leaves the folder", changed("images.bin", lambda data: data[: data.index(b".png") - 2] + b"../../evil\0" + data[-8:])


def outcome(case: Case, folder: Path, capsys) -> str:
    """Run a case; return what is wrong with how it ended, or nothing."""
    label, make = case
    folder.mkdir()
    args = make(folder)
    before = {path: path.stat().st_size for path in sorted(folder.parent.rglob("*")) if path.is_file()}
    status, _, err = run(capsys, *args)
    after = {path: path.stat().st_size for path in sorted(folder.parent.rglob("*")) if path.is_file()}
    if status != 2 or err.count("\n") != 1 or "Traceback" in err or "a fault of neuido" in err:
        return f"{label}: status {status}, {err[:300]!r}"
    return "" if after == before else f"{label}: it left {sorted(set(after) ^ set(before))}"


GROUPS = ("videos", "recordings", "colmap models")


@pytest.mark.slow
@pytest.mark.parametrize("group", GROUPS)
def test_one_line_and_nothing_left(group, tmp_path, capsys, clip, monkeypatch):
    secret = tmp_path / "secret"
    secret.write_bytes(clip)
    monkeypatch.chdir(tmp_path)
    cases = {"videos": lambda: videos(clip, secret), "recordings": lambda: recordings(secret), "colmap models": colmap_models}[group]
    wrong = [fault for i, case in enumerate(cases()) if (fault := outcome(case, tmp_path / f"case{i}", capsys))]
    assert not wrong, "\n".join(wrong)
    assert os.path.getsize(secret) == len(clip)


def test_there_are_about_a_hundred(clip, tmp_path):
    count = sum(len(list(group)) for group in (videos(clip, tmp_path), recordings(tmp_path), colmap_models()))
    assert count >= 100
