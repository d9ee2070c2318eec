"""The plots of a diagnosis as traces and layouts of Plotly; colours are names such as "@before", which the page replaces."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from neuido.discrepancy.report.reader_units import Units, axis_of, rounded
from neuido.discrepancy.report.wording import title

Arrays = Mapping[str, np.ndarray]
Plot = dict[str, Any]
MOST_ROWS = 400
"""Largest number of points of a curve; longer ones are thinned out evenly."""
MOST_BARS = 16
"""Largest number of effects in the ranking."""
LOG_FROM = 10.0
"""Ratio of error to noise above which the axis is logarithmic, so that the floor remains visible."""


def safe(name: Any) -> str:
    """Return a name with HTML characters escaped, because Plotly's labels interpret some HTML."""
    return str(name).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def numbers(values: Iterable[float], digits: int = 5) -> list[float | None]:
    """Return numbers for JSON with some significant digits; those that are not finite become None, a gap in a curve."""
    return [
        float(f"{v:.{digits}g}") if math.isfinite(v) else None
        for v in np.array([math.nan if v is None else v for v in values], dtype=float)
    ]


def line(name: str, x: Iterable[float], y: Iterable[float], role: str, *, width: float = 2, dash: str = "solid", **more: Any) -> Plot:
    """Return a trace that draws a curve in the colour of a role, such as `before`."""
    shape = {"color": f"@{role}", "width": width, "dash": dash}
    return {"type": "scatter", "mode": "lines", "name": safe(name), "x": numbers(x), "y": numbers(y), "line": shape, **more}


def dots(name: str, x: Iterable[float], y: Iterable[float], role: str, *, symbol: str = "circle", size: int = 5, **more: Any) -> Plot:
    """Return a trace that draws points in the colour of a role, such as `measured`."""
    marker = {"color": f"@{role}", "size": size, "symbol": symbol}
    return {"type": "scatter", "mode": "markers", "name": safe(name), "x": numbers(x), "y": numbers(y), "marker": marker, **more}


def predictions(c: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the keys of the predictions that are drawn, with their labels: before and after, or one without an effect."""
    return [("before", "before"), ("after", "after")] if c["effects"] else [("before", "predicted")]


def plot(heading: str, x: str, y: str, traces: Sequence[Plot], **layout: Any) -> Plot:
    """Return a plot of traces with a title, two labelled axes and a legend."""
    axes = {name: {"title": {"text": safe(label)}} | layout.pop(name, {}) for name, label in (("xaxis", x), ("yaxis", y))}
    return {"data": list(traces), "layout": {"title": {"text": safe(heading)}, "showlegend": True} | axes | layout}


def thinned(count: int, most: int) -> np.ndarray:
    """Return the indices of at most `most` evenly spaced rows of `count`."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def distance_over_time(arrays: Arrays, when: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the times [s] at which any point was seen, and the root mean square distance between measured and predicted points [m].

    `when` is the prediction, `before` or `after`.
    """
    square = np.sum((arrays["measured"] - arrays[when]) ** 2, axis=-1)
    seen = np.isfinite(square).any(axis=1)
    return arrays["t"][seen], np.sqrt(np.nanmean(square[seen], axis=1))


def error_over_time(name: str, arrays: Arrays, c: Mapping[str, Any], units: Units, most: int = MOST_ROWS) -> Plot:
    """Return the plot of a recording's root mean square distance over time, before and after, with the floors."""
    factor, unit = units.scaled("m")
    times, traces = arrays["t"], []
    for when, called in predictions(c):
        seen, distance = distance_over_time(arrays, when)
        rows = thinned(len(distance), most)
        traces.append(line(called, seen[rows], factor * distance[rows], when))
    ends = [float(times[0]), float(times[-1])]
    noise, grid = (c["error"].get(key) or 0.0 for key in ("noise_floor", "discretisation_floor"))
    traces.append(line("noise", ends, [factor * noise] * 2, "muted", width=1, dash="dot"))
    if grid > 0:
        traces.append(line("noise and discretisation", ends, [factor * math.hypot(noise, grid)] * 2, "muted", width=1, dash="dash"))
    top = max((v for trace in traces for v in trace["y"] if v), default=0.0)
    wide = noise > 0 and top > LOG_FROM * factor * noise
    scale = {"type": "log"} if wide else {"rangemode": "tozero"}
    label = f"RMS distance [{unit}]"
    return plot(heading(name, c), "time [s]", label, traces, yaxis=scale)


def heading(name: str, c: Mapping[str, Any]) -> str:
    """Return the name of a recording with its role in brackets."""
    role = c["recordings"].get(name, {}).get("role")
    return f"{name} ({role.replace('_', ' ')})" if role else name


def data_plots(name: str, arrays: Arrays, c: Mapping[str, Any], units: Units, most: int = MOST_ROWS) -> list[Plot]:
    """Return two plots of a track or material test over time, stretch or shear: the data with the predictions, and the residual."""
    told = c["recordings"].get(name, {})
    factor, unit = units.scaled(c["error"]["unit"])
    quantity = told.get("quantity", "measured")
    axis, label = axis_of(arrays, told, units)
    groups = list(dict.fromkeys(arrays["groups"].tolist()))
    channels = told.get("channels") or ([""] if len(groups) == 1 else [f"channel {g}" for g in groups])
    curves: list[Plot] = []
    left: list[Plot] = []
    for i, (group, channel) in enumerate(zip(groups, channels)):
        own = np.flatnonzero(arrays["groups"] == group)
        own = own[thinned(len(own), most)]
        x, after = axis[own], f", {channel}" if channel else ""
        look = ("solid", "dash", "dot")[i % 3]
        scattered = _is_scattered(x)
        curves.append(
            dots(f"measured{after}", x, factor * arrays["measured"][own], "measured", symbol=("circle", "square", "diamond")[i % 3])
        )
        for when, called in predictions(c):
            made = factor * arrays[when][own]
            residual = factor * (arrays["measured"][own] - arrays[when][own])
            if scattered:
                symbol = ("circle-open", "square-open", "diamond-open")[i % 3]
                curves.append(dots(f"{called}{after}", x, made, when, symbol=symbol))
                left.append(dots(f"{called}{after}", x, residual, when, symbol=symbol))
            else:
                curves.append(line(f"{called}{after}", x, made, when, dash=look))
                left.append(line(f"{called}{after}", x, residual, when, dash=look, width=1.5))
    noise = c["error"].get("noise_floor") or 0.0
    if noise > 0:
        ends = [float(np.nanmin(axis)), float(np.nanmax(axis))]
        left += [
            line("± noise", ends, [sign * factor * noise] * 2, "muted", width=1, dash="dot", showlegend=sign > 0, legendgroup="noise")
            for sign in (1, -1)
        ]
    top = heading(name, c)
    return [plot(top, label, f"{quantity} [{unit}]", curves), plot(f"{top}: what is left", label, f"measured − predicted [{unit}]", left)]


def _is_scattered(x: np.ndarray) -> bool:
    """Return whether successive values lie so far apart that a line through them would mean nothing."""
    if len(x) < 3 or not np.ptp(x) > 0:
        return False
    return float(np.median(np.abs(np.diff(x)))) > 0.2 * float(np.ptp(x))


ARROW = 0.08
"""Length of the arrow of the largest residual relative to the extent of the specimen."""


def specimen_plots(name: str, arrays: Arrays, c: Mapping[str, Any], units: Units) -> list[Plot]:
    """Return plots of a plane specimen: the residual of its nodes at the last load step on the mesh, and the forces over the load steps.

    Args:
        name: Name of the recording.
        arrays: Its arrays, of `PlaneProblem.pictured`.
        c: Part of diagnosis.json.
        units: Units of the page.
    """
    factor, unit = units.scaled("m")
    nodes, t = arrays["nodes"], arrays["triangles"]
    edges = np.unique(np.sort(np.concatenate([t[:, [0, 1]], t[:, [1, 2]], t[:, [2, 0]]], axis=0), axis=1), axis=0)
    left = {when: factor * (arrays["moved_measured"] - arrays[f"moved_{when}"])[-1] for when, _ in predictions(c)}
    top = max(float(np.nanmax(np.linalg.norm(r, axis=1), initial=0.0)) for r in left.values())
    out = []
    for when, called in predictions(c):
        place = factor * (nodes + arrays[f"moved_{when}"][-1])
        if not np.isfinite(place).all():
            continue
        size = np.linalg.norm(left[when], axis=1)
        tips = place + ARROW * factor * float(np.ptp(nodes, axis=0).max()) / max(top, 1e-300) * left[when]
        data = []
        for label, ends, role in (("mesh", [place[edges[:, 0]], place[edges[:, 1]]], "faint"), ("residual", [place, tips], when)):
            gap = np.full_like(ends[0], np.nan)
            data.append(line(label, *np.stack([*ends, gap], 1).reshape(-1, 2).T, role, width=0.5 if label == "mesh" else 1.2))
        marker = {"color": numbers(size, 3), "colorscale": "Viridis", "cmin": 0.0, "cmax": top, "size": 5, "showscale": True}
        spots = dots(
            f"residual [{unit}]", *place.T, when, showlegend=False, hovertemplate="%{marker.color:.3g} " + unit + "<extra></extra>"
        )
        data.append(spots | {"marker": marker | {"colorbar": {"title": {"text": f"residual [{unit}]"}}}})
        square = {"yaxis": {"scaleanchor": "x"}}
        out.append(plot(f"{heading(name, c)}: {called}, last load step", f"x [{unit}]", f"y [{unit}]", data, **square))
    return out + force_plots(name, arrays, c)


def force_plots(name: str, arrays: Mapping[str, np.ndarray], c: Mapping[str, Any]) -> list[Plot]:
    """Return a plot of the measured and predicted forces of a recording over time, or over the load steps; empty without forces."""
    if "force_measured" not in arrays:
        return []
    timed = "force_times" in arrays
    steps = arrays["force_times"] if timed else np.arange(1, len(arrays["force_measured"]) + 1)
    curves: list[Plot] = []
    for i, part in enumerate(c["recordings"].get(name, {}).get("parts", [])):
        if np.isfinite(arrays["force_measured"][:, i]).any():
            curves.append(dots(f"{part}, measured", steps, arrays["force_measured"][:, i], "measured", size=7))
            look = ("solid", "dash", "dot", "dashdot")[i % 4]
            curves += [line(f"{part}, {called}", steps, arrays[f"force_{when}"][:, i], when, dash=look) for when, called in predictions(c)]
    return [plot(f"{heading(name, c)}: forces", "time [s]" if timed else "load step", "force [N]", curves)] if curves else []


def stage_plots(c: Mapping[str, Any]) -> list[Plot]:
    """Return a plot of the missing quantity over time for each stage of each recording, before, after and by noise alone."""
    out = []
    for recording, rows in c["stages"].items():
        for s in rows:
            if len(s["times"]) < 2:
                continue
            unit = s["unit"].replace("^2", "²")
            traces = [
                line("noise", s["times"], s["noise"], "muted", width=0, fill="tozeroy", fillcolor="@shade"),
                *(line(called, s["times"], s[when], when, mode="lines+markers") for when, called in predictions(c)),
            ]
            label = f"{STAGE_QUANTITIES.get(s['stage'], 'missing')} [{unit}]"
            out.append(plot(f"{recording}: {s['stage']}", "time [s]", label, traces, yaxis={"rangemode": "tozero"}))
    return out


STAGE_QUANTITIES = {
    "flight": "missing acceleration",
    "contact": "missing impulse",
    "rotation": "missing angular acceleration",
    "internal modes": "missing acceleration of strain",
    "power": "missing power",
    "rest": "missing distance",
}


def ranking(models: Sequence[Mapping[str, Any]], chance: float | None) -> Plot | None:
    """Return a bar chart of the error ratios of the effects that were tried, the named ones in the colour of `after`.

    `chance` is the error ratio that chance exceeds in 5 % of the draws. None where fewer than two effects were tried.
    """
    rows = [m for m in models if m.get("error_ratio")][:MOST_BARS]
    if len(rows) < 2:  # nothing to compare
        return None
    kept, other = ([m for m in rows if (m["verdict"] in ("named", "class")) == named] for named in (True, False))
    labels = [safe(label_of(m)) for m in rows]
    data = []
    for name, own, role in (("named, or not told from it", kept, "after"), ("other effects", other, "faint")):
        if own:
            y = [safe(label_of(m)) for m in own]
            text = [rounded(m["error_ratio"]) for m in own]
            data.append(
                {
                    "type": "bar",
                    "orientation": "h",
                    "name": name,
                    "y": y,
                    "x": numbers(m["error_ratio"] for m in own),
                    "text": text,
                    "marker": {"color": f"@{role}"},
                    "hovertemplate": "%{y}: %{x:.3g}<extra></extra>",
                }
            )
    if chance:
        data.append(
            {
                "type": "scatter",
                "mode": "lines",
                "name": "95 % of what chance brings",
                "x": numbers([chance] * len(labels)),
                "y": labels,
                "line": {"color": "@before", "dash": "dash", "width": 1},
            }
        )
    label = "error without the effect over error with it"
    axes = {
        "xaxis": {"type": "log"},
        "yaxis": {"categoryorder": "array", "categoryarray": labels[::-1]},
    }
    return plot("Effects that were tried", label, "effect", data, **axes, height=150 + 26 * len(labels), bargap=0.25, barmode="overlay")


def label_of(m: Mapping[str, Any]) -> str:
    """Return the title of an effect that was tried, with its form where it has several."""
    return f"{title(m['name'])}, {m['form']}" if m.get("form") else title(m["name"])
