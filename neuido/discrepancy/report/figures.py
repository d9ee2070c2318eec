"""The figures of a diagnosis' report: inline SVG, silhouettes, and a small player drawn by the page itself."""

import base64
import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np

from neuido.data.files.html_page import escaped, figure, png, style_axes, svg, table
from neuido.discrepancy.problems.silhouettes import distances
from neuido.discrepancy.report.residual import Series

INK, BEFORE, AFTER = "#333333", "#c0392b", "#1f77b4"
MOST_POINTS, MOST_FRAMES = 400, 60
MOST_TICKS = 9


def stage_curves(stages: Mapping[str, Sequence[Series]]) -> str:
    """What is missing in each stage over time, before and after, with the noise: a row a recording."""
    names = list(dict.fromkeys(s.name for rows in stages.values() for s in rows if len(s.times) > 1))
    if not names:
        return ""
    drawn = figure(len(stages), len(names), (2.7 * len(names), 2.3 * len(stages)))
    if drawn is None:
        return ""
    made, axes = drawn
    for row, (recording, series) in zip(axes, stages.items(), strict=True):
        own = {s.name: s for s in series}
        for ax, name in zip(row, names, strict=True):
            s = own.get(name)
            if s is None or len(s.times) < 1:
                ax.axis("off")
                continue
            ax.plot(s.times, s.before, ".-", color=BEFORE, lw=1)
            ax.plot(s.times, s.after, ".-", color=AFTER, lw=1)
            ax.fill_between(s.times, s.noise, color=INK, alpha=0.2, lw=0)
            ax.set_title(f"{recording}: {name} [{s.unit}]", fontsize=8)
            ax.set_ylim(bottom=0.0)
            style_axes(ax)
            ax.set_xlabel("t [s]", fontsize=7)
    return svg(made)


def error_curves(motion: Mapping[str, Mapping[str, np.ndarray]], noise: float, disc: float) -> str:
    """Root mean square distance of the points over time, before and after, with the floors."""
    drawn = figure(1, len(motion), (3.6 * len(motion), 2.6))
    if drawn is None:
        return ""
    made, axes = drawn
    for ax, (name, arrays) in zip(axes[0], motion.items(), strict=True):
        for when, colour in (("before", BEFORE), ("after", AFTER)):
            square = np.sum((arrays["measured"] - arrays[when]) ** 2, axis=-1)
            seen = np.isfinite(square).any(axis=1)
            ax.plot(arrays["t"][seen], 1e3 * np.sqrt(np.nanmean(square[seen], axis=1)), color=colour, label=when, lw=1.2)
        ax.axhline(1e3 * noise, color=INK, ls=":", lw=1, label="noise")
        ax.axhline(1e3 * np.hypot(noise, disc), color=INK, ls="--", lw=1, label="noise and discretisation")
        ax.set_title(name, fontsize=9)
        ax.set_xlabel("t [s]", fontsize=8)
        ax.set_ylabel("RMS distance [mm]", fontsize=8)
        ax.set_ylim(bottom=0.0)
        style_axes(ax)
    axes[0][0].legend(fontsize=7, frameon=False)
    return svg(made)


def residual_maps(motion: Mapping[str, Mapping[str, np.ndarray]]) -> str:
    """Mean residual distance of each point on the body, before and after, seen along z (left) and along x (right)."""
    drawn = figure(len(motion), 4, (9.0, 2.3 * len(motion)))
    if drawn is None:
        return ""
    made, axes = drawn
    for row, (name, arrays) in zip(axes, motion.items(), strict=True):
        place = np.where(np.isfinite(arrays["measured"][0]), arrays["measured"][0], arrays["before"][0])
        sizes = {}
        for when in ("before", "after"):
            square = np.sum((arrays["measured"] - arrays[when]) ** 2, axis=-1)
            count = np.isfinite(square).sum(axis=0)
            sizes[when] = 1e3 * np.sqrt(np.nansum(square, axis=0) / np.maximum(count, 1))
        top = max(float(np.quantile(sizes["before"], 0.98)), 1e-9)
        for i, (when, (a, b)) in enumerate((w, v) for w in ("before", "after") for v in ((0, 1), (2, 1))):
            ax = row[i]
            shown = ax.scatter(place[:, a], place[:, b], c=sizes[when], s=6, cmap="viridis", vmin=0.0, vmax=top, linewidths=0)
            ax.set_aspect("equal")
            ax.set_title(f"{name}, {when}, along {'zx'[i % 2]}", fontsize=8)
            ax.set_xlabel(f"{'xz'[i % 2]} [m]", fontsize=7)
            ax.set_ylabel("y [m]" if i == 0 else "", fontsize=7)
            style_axes(ax)
        bar = made.colorbar(shown, ax=list(row), shrink=0.8)
        bar.set_label("mm", fontsize=7)
        bar.ax.tick_params(labelsize=7)
    return svg(made)


def data_curves(motion: Mapping[str, Mapping[str, np.ndarray]], unit: str) -> str:
    """Measured data and predictions before and after of a track or a material test, and what each leaves."""
    drawn = figure(2, len(motion), (3.3 * len(motion), 4.2))
    if drawn is None:
        return ""
    made, axes = drawn
    for column, (name, arrays) in enumerate(motion.items()):
        for g in np.unique(arrays["groups"]):
            own = arrays["groups"] == g
            t = arrays["times"][own]
            axes[0, column].plot(t, arrays["measured"][own], ".", color=INK, ms=3)
            for when, colour in (("before", BEFORE), ("after", AFTER)):
                axes[0, column].plot(t, arrays[when][own], color=colour, lw=1)
                axes[1, column].plot(t, arrays["measured"][own] - arrays[when][own], color=colour, lw=1)
        axes[0, column].set_title(name, fontsize=8)
        axes[1, column].axhline(0.0, color=INK, lw=0.6)
        for ax in axes[:, column]:
            style_axes(ax)
    axes[0, 0].set_ylabel(f"data [{unit}]", fontsize=8)
    axes[1, 0].set_ylabel(f"residual [{unit}]", fontsize=8)
    return svg(made)


def ranking(trials: Sequence[tuple[str, float, bool]], floor: float) -> str:
    """Gains of the candidates as bars from one, those of the class in the colour of `after`, and what chance takes."""
    if not trials:
        return ""
    drawn = figure(1, 1, (6.0, 0.26 * len(trials) + 0.9))
    if drawn is None:
        return ""
    made, axes = drawn
    ax = axes[0, 0]
    names, gains, kept = zip(*reversed(trials), strict=True)
    ax.barh(range(len(names)), np.exp(gains) - 1.0, left=1.0, color=[AFTER if k else "#bbbbbb" for k in kept], height=0.7)
    ax.axvline(1.0, color=INK, lw=0.6)
    ax.set_yticks(range(len(names)), names)
    ax.axvline(np.exp(floor), color=BEFORE, lw=1, ls="--")
    ax.set_xscale("log")
    ax.minorticks_off()
    ax.set_xticks(log_ticks(*ax.get_xlim()))
    ax.xaxis.set_major_formatter("{x:g}")
    ax.set_xlabel("error before over error after (fitted or held out, the smaller); dashed: 95 % of what chance brings", fontsize=7)
    style_axes(ax)
    return svg(made)


def log_ticks(low: float, high: float) -> np.ndarray:
    """At most `MOST_TICKS` round numbers within a range that is drawn by logarithms: 1, 2, 5 and their tens, or equal steps."""
    ticks = np.outer(10.0 ** np.arange(-6, 7), (1.0, 2.0, 5.0)).ravel()
    ticks = ticks[(low <= ticks) & (ticks <= high)]
    if len(ticks) < 3:
        step = 10.0 ** math.floor(math.log10(high - low))
        step *= next(f for f in (0.2, 0.5, 1.0, 2.0) if (high - low) / (f * step) < MOST_TICKS)
        ticks = step * np.arange(math.ceil(low / step), math.floor(high / step) + 1)
    return ticks[:: math.ceil(len(ticks) / MOST_TICKS)]


def player(motion: Mapping[str, Mapping[str, np.ndarray]]) -> str:
    """A canvas with a slider: measured points, and those predicted before and after, of a few hundred points."""
    data = {}
    for name, arrays in motion.items():
        x = arrays["measured"]
        points = np.unique(np.linspace(0, x.shape[1] - 1, min(MOST_POINTS, x.shape[1])).round().astype(int))
        frames = np.unique(np.linspace(0, len(x) - 1, min(MOST_FRAMES, len(x))).round().astype(int))
        sets = [arrays[k][np.ix_(frames, points)] for k in ("measured", "before", "after")]
        low, high = np.nanmin(np.stack(sets), axis=(0, 1, 2)), np.nanmax(np.stack(sets), axis=(0, 1, 2))
        middle, size = 0.5 * (low + high), 0.5 * float(np.max(high - low)) or 1.0
        packed = []
        for s in sets:
            q = np.where(np.isfinite(s), np.clip((s - middle) / size, -1.0, 1.0) * 32000, -32768).astype("<i2")
            packed.append(base64.b64encode(q.tobytes()).decode())
        data[name] = {"n": len(points), "k": len(frames), "t": [round(float(v), 5) for v in arrays["t"][frames]], "sets": packed,
                      "first": _telling(sets[0], sets[1])}  # fmt: skip
    return PLAYER.replace("/*DATA*/", json.dumps(data).replace("<", "\\u003c")).replace("/*COLOURS*/", json.dumps([INK, BEFORE, AFTER]))


def _telling(measured: np.ndarray, before: np.ndarray) -> int:
    """The frame in which the two lie furthest apart."""
    square = np.sum((measured - before) ** 2, axis=-1)
    return int(np.argmax(np.nansum(square, axis=1) / np.maximum(np.isfinite(square).sum(axis=1), 1)))


PLAYER = """<div class="player"><canvas width="760" height="460"></canvas><div>
<select></select> <input type="range" min="0" value="0" step="1" style="width:420px"> <output></output>
<button type="button">play</button>
<label><input type="checkbox" checked>measured</label><label class="b"><input type="checkbox" checked>before</label>
<label class="a"><input type="checkbox" checked>after</label> drag to turn</div></div>
<script>(() => {
const data = /*DATA*/, colours = /*COLOURS*/, box = document.currentScript.previousElementSibling;
const canvas = box.querySelector("canvas"), pen = canvas.getContext("2d");
const pick = box.querySelector("select"), slider = box.querySelector("input[type=range]");
const boxes = [...box.querySelectorAll("input[type=checkbox]")], out = box.querySelector("output"), button = box.querySelector("button");
let sets = [], now, yaw = 0.5, pitch = 0.25, timer = null;
for (const name of Object.keys(data)) pick.add(new Option(name));
const load = () => { now = data[pick.value]; slider.max = now.k - 1; slider.value = now.first;
  sets = now.sets.map(s => new Int16Array(Uint8Array.from(atob(s), c => c.charCodeAt(0)).buffer)); draw(); };
const draw = () => { const k = +slider.value, w = canvas.width, h = canvas.height, r = 0.44 * h / 32000;
  pen.clearRect(0, 0, w, h); out.textContent = now.t[k].toFixed(3) + " s";
  const a = Math.cos(yaw), b = Math.sin(yaw), c = Math.cos(pitch), d = Math.sin(pitch);
  sets.forEach((s, i) => { if (!boxes[i].checked) return; pen.fillStyle = colours[i];
    for (let n = 0; n < now.n; n++) { const o = 3 * (k * now.n + n); if (s[o] === -32768) continue;
      const x = s[o], y = s[o + 1], z = s[o + 2], p = a * x + b * z, q = -b * x + a * z;
      pen.fillRect(w / 2 + r * p - 1.2, h / 2 - r * (c * y - d * q) - 1.2, i ? 2.4 : 3.4, i ? 2.4 : 3.4); } }); };
pick.onchange = load; slider.oninput = draw; boxes.forEach(e => e.onchange = draw);
canvas.onpointermove = e => { if (e.buttons) { yaw += e.movementX / 150; pitch += e.movementY / 150; draw(); } };
button.onclick = () => { if (timer) { clearInterval(timer); timer = null; button.textContent = "play"; return; }
  button.textContent = "stop"; timer = setInterval(() => { slider.value = (+slider.value + 1) % now.k; draw(); }, 60); };
load(); })();</script>"""


OUTLINES = (192, 57, 43), (31, 119, 180)
"""Red and blue of the report, RGB."""
FRAMES = 8
"""Of a view that are shown, evenly taken."""
ENLARGED = 2


def section(drawn: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The parts of the page about silhouettes.

    Args:
        drawn: Of each recording `masks`, `drawn_before`, `drawn_after` (T, V, H, W) in 0..1, `inset` [px], `times` (T,) [s], and `scores`.
    """
    out = ["<h2>Silhouettes before and after</h2>", _table(drawn)]
    for name, own in drawn.items():
        chosen = sorted({round(i) for i in np.linspace(0, len(own["times"]) - 1, FRAMES)})
        times = ", ".join(f"{own['times'][t]:.3g}" for t in chosen)
        out.append(f'<p>{escaped(name)} at {times} s: measured (grey), <span class="b">before</span>, <span class="a">after</span>.</p>')
        rows = [np.concatenate([_overlay(own, t, v) for t in chosen], axis=1) for v in range(own["masks"].shape[1])]
        _, data = cv2.imencode(".png", cv2.cvtColor(np.concatenate(rows), cv2.COLOR_RGB2BGR))
        out.append(png(data.tobytes(), f"silhouettes of {name}"))
    return out


def _table(drawn: Mapping[str, Mapping[str, Any]]) -> str:
    rows = [
        (name, role.replace("_", " "), when, *(own["scores"][when][role][key] for key in ("iou", "outline_px", "outline_mm", "psnr")))
        for name, own in drawn.items()
        for role in own["scores"]["before"]
        for when in ("before", "after")
    ]
    return table(("recording", "frames", "", "overlap (IoU)", "outline [px]", "outline [mm]", "PSNR [dB]"), rows, digits=3)


def _overlay(own: Mapping[str, Any], t: int, v: int) -> np.ndarray:
    """One image (H, W, 3) uint8."""
    mask = own["masks"][t, v]
    size = (ENLARGED * mask.shape[1], ENLARGED * mask.shape[0])
    image = np.repeat((255 - 90 * cv2.resize(mask, size, interpolation=cv2.INTER_LINEAR))[..., None], 3, axis=2).round().astype(np.uint8)
    for when, colour in zip(("drawn_before", "drawn_after"), OUTLINES, strict=True):
        body = (distances(own[when][None, t, v])[0] + own["inset"] <= 0).astype(np.uint8)
        found, _ = cv2.findContours(cv2.resize(body, size, interpolation=cv2.INTER_NEAREST), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        image = cv2.drawContours(image, found, -1, colour, 1)
    image[:, -1] = 230
    return image
