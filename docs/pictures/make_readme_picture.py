"""Make the moving picture of the README from real output of neuido.

    neuido scenes --config six_small --out film --device cpu
    neuido reconstruct film/Ball --steps 200 --start 800 --gaussians 1500 --particles 1500 --device cpu
    neuido predict --config predict.yaml --model.init_from pretrained-small --data.root film --data.scenes '[Ball]'
    neuido demo --parts loop
    python docs/pictures/make_readme_picture.py film/Ball runs/predict/Ball runs/demo/loop/diagnosis

The upper half shows the film, and the same view drawn from the law that the encoder read in one pass. The lower half shows a
measured throw that no fit has seen, and its prediction by the declared model and by the model with the effect that the diagnosis named.
"""

import argparse
import io
import json
from pathlib import Path

import cv2
import numpy as np
import yaml
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image

OUT = Path(__file__).with_name("readme.webp")
BEFORE, AFTER, INK = "#c0392b", "#1f77b4", "#222222"


def true_modulus(film: Path) -> float:
    """Return the true P-wave modulus [Pa] of a filmed body, which no model reads."""
    elasticity = yaml.safe_load((film / "truth.yaml").read_text())["law"]["elasticity"]
    young, poisson = elasticity["young"], elasticity["poisson"]
    return young * (1 - poisson) / ((1 + poisson) * (1 - 2 * poisson))


def read_video(folder: Path) -> list[np.ndarray]:
    """Return the frames (H, 2 W, 3) of the video that `neuido predict` wrote: recorded beside predicted."""
    capture, out = cv2.VideoCapture(str(next(folder.glob("*.mp4")))), []
    while True:
        ok, frame = capture.read()
        if not ok:
            return out
        out.append(frame[..., ::-1])


def draw(video: list[np.ndarray], law: dict, diagnosis: Path, k: int) -> Image.Image:
    """Return frame k of the picture."""
    content = json.loads((diagnosis / "diagnosis.json").read_text())
    scored = content["error"]["after"]["by_recording"]
    with np.load(diagnosis / "predicted" / "toss.npz" if "toss" in scored else next((diagnosis / "predicted").glob("*.npz"))) as archive:
        motion = {key: archive[key] for key in ("t", "measured", "before", "after")}
    figure = Figure(figsize=(5.4, 4.9), facecolor="white")
    boxes = {
        "film": (0.02, 0.545, 0.47, 0.32),
        "drawn": (0.51, 0.545, 0.47, 0.32),
        "throw": (0.125, 0.09, 0.41, 0.31),
        "error": (0.665, 0.09, 0.295, 0.31),
    }
    panels = {name: figure.add_axes(box) for name, box in boxes.items()}
    image = video[min(k, len(video) - 1)]
    halves = np.split(image[:, : image.shape[1] // 2 * 2], 2, axis=1)
    for name, half, title in (("film", halves[0], "video in"), ("drawn", halves[1], "predicted motion out")):
        panels[name].imshow(half, interpolation="lanczos")
        panels[name].axis("off")
        panels[name].set_title(title, fontsize=10, color=INK, pad=3)
    said = f"law read in one pass: {law['modulus'] / 1e3:.0f} kPa (true: {law['true'] / 1e3:.0f} kPa)"
    figure.text(0.5, 0.945, said, ha="center", fontsize=11.5, weight="bold", color=INK)
    throw, error = panels["throw"], panels["error"]
    for when, colour in (("before", BEFORE), ("after", AFTER)):
        throw.plot(*motion[when][k, :, :2].T, "o", ms=3.2, color=colour, alpha=0.75, mew=0, label=f"model {when}")
    throw.plot(*motion["measured"][k, :, :2].T, "+", ms=4, color=INK, mew=0.8, label="measured")
    every = np.concatenate([motion[w][..., :2].reshape(-1, 2) for w in ("measured", "before", "after")])
    low, high = np.nanmin(every, 0) - 0.04, np.nanmax(every, 0) + 0.04
    throw.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    throw.set_xlabel("x [m]", fontsize=8.5, labelpad=1)
    throw.set_ylabel("height [m]", fontsize=8.5, labelpad=1)
    throw.set_title("a throw that no fit has seen", fontsize=10, color=INK, pad=3)
    rms = {w: 1e3 * np.sqrt(np.nanmean(((motion["measured"] - motion[w]) ** 2).sum(-1), axis=1)) for w in ("before", "after")}
    for when, colour in (("before", BEFORE), ("after", AFTER)):
        error.plot(motion["t"][: k + 1], rms[when][: k + 1], color=colour, label=when)
        error.plot(motion["t"][k], rms[when][k], "o", ms=4, color=colour)
    error.set(xlim=(0, motion["t"][-1]), ylim=(0, 1.05 * np.nanmax(rms["before"])))
    error.locator_params(axis="x", nbins=4)
    error.set_xlabel("time [s]", fontsize=8.5, labelpad=1)
    error.set_title("error [mm]", fontsize=10, color=INK, pad=3)
    error.legend(fontsize=9, frameon=False, loc="upper left")
    throw.legend(fontsize=8, frameon=False, loc="upper right", handletextpad=0.1, borderpad=0.1)
    for panel in (throw, error):
        panel.tick_params(labelsize=8, length=2)
        panel.spines[["top", "right"]].set_visible(False)
    effect = content["effects"][0]
    name, figures = next(iter(effect["parameters"].items()))
    said = f"missing effect found: {effect['name'].replace('_', ' ')}, {figures['value']:.2f} {figures['unit']}"
    figure.text(0.5, 0.465, said, ha="center", fontsize=11.5, weight="bold", color=INK)
    figure.add_artist(Line2D([0.03, 0.97], [0.525, 0.525], color="0.85", lw=1))
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=110)
    return Image.open(buffer).convert("RGB")


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("film", type=Path)
    parser.add_argument("law", type=Path)
    parser.add_argument("diagnosis", type=Path)
    parser.add_argument("--out", type=Path, default=OUT)
    given = parser.parse_args()
    video, law = read_video(given.law), json.loads((given.law / "law.json").read_text())
    law["true"] = true_modulus(given.film)
    count = len(video)
    frames = [draw(video, law, given.diagnosis, k) for k in range(count)]
    times = [110] * (count - 1) + [1800]
    frames[0].save(given.out, save_all=True, append_images=frames[1:], duration=times, loop=0, quality=80, method=6)
    print(f"{given.out}: {len(frames)} frames, {given.out.stat().st_size / 1024:.0f} KB")


if __name__ == "__main__":
    main()
