"""The result of a diagnosis, read from its folder (`neuido-diagnosis/2`, or the older `/1`)."""

import json
import math
import os
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from neuido.data.files.html_page import plain
from neuido.data.files.parsing import read_arrays
from neuido.data.files.writing import copy_file
from neuido.discrepancy.report import diagnosis_format
from neuido.discrepancy.report.reader_units import Units, axis_of
from neuido.discrepancy.report.wording import LEADING, MORE, MORE_LEFT, Words, more, most_over, named, scored_by, words_of
from neuido.errors import UserError

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.figure import Figure

BEFORE, AFTER, INK = "#c0392b", "#1f77b4", "#333333"
MOST_PANELS = 4


class Quantity(NamedTuple):
    """A fitted value with its interval and unit."""

    value: float | list[float]
    interval: tuple[Any, Any]
    """90 % interval."""
    unit: str


@dataclass(frozen=True)
class Effect:
    """An effect that the declared model lacks.

    `value`, `interval` and `unit` are those of its leading parameter, whose name is `parameter`.
    """

    name: str
    alternatives: tuple[str, ...]
    """Other effects that the data cannot tell apart from it."""
    parameters: dict[str, Quantity]
    p_value: float
    """Probability that any candidate lowers the error as much by chance."""
    where: str
    """Stage of the motion in which the effect shows."""
    body: str = ""
    """Name of the body, in a track folder with several bodies."""

    @property
    def parameter(self) -> str:
        """Name of the leading parameter."""
        return next((name for name in LEADING if name in self.parameters), next(iter(self.parameters)))

    @property
    def value(self) -> float | list[float]:
        """Value of the leading parameter."""
        return self.parameters[self.parameter].value

    @property
    def interval(self) -> tuple[Any, Any]:
        """90 % interval of the leading parameter."""
        return self.parameters[self.parameter].interval

    @property
    def unit(self) -> str:
        """Unit of the leading parameter."""
        return self.parameters[self.parameter].unit

    def __str__(self) -> str:
        """Return the name, and the leading parameter with its interval and unit."""
        return f"{self.name}: {self.parameter} = {_figure(self.parameters[self.parameter])}"


class ErrorChange(NamedTuple):
    """Error of the prediction before and after the effects were added."""

    before: float
    after: float
    unit: str
    floor: float
    """Error that noise and discretisation alone leave."""
    held_out: bool
    """Whether the error is that of held-out recordings; otherwise that of the fitted ones."""


class Diagnosis:
    """The answer of a diagnosis, its effects, and the error before and after.

    Args:
        folder: Folder of the results.
        content: Content of its diagnosis.json, or the part of one body.
        keep: Object that must live as long as the diagnosis, for example a temporary folder.
    """

    def __init__(self, folder: Path, content: Mapping[str, Any], keep: Any = None) -> None:
        self.folder, self._content, self._keep = folder, content, keep
        self._units: Units | None = None  # set where several bodies share a page

    @classmethod
    def read(cls, folder: str | os.PathLike, *, keep: Any = None) -> "Diagnosis":
        """Read the results of an earlier diagnosis.

        Raises:
            UserError: A folder without a diagnosis.json of this format.
        """
        path = Path(folder).expanduser() / "diagnosis.json"
        if not path.is_file():
            raise UserError(f"{folder} holds no diagnosis.json: give the folder that `neuido diagnose --out` wrote")
        return cls(path.parent, diagnosis_format.read(path), keep)

    @property
    def name(self) -> str:
        """Name of what was measured."""
        return self._content["experiment"]

    @property
    def bodies(self) -> "dict[str, Diagnosis]":
        """The diagnosis of each body of a track folder; for other data one diagnosis under the name of the experiment."""
        if "bodies" not in self._content:
            return {self._content.get("body", self.name): self}
        out = {own["body"]: Diagnosis(self.folder, own, self._keep) for own in self._content["bodies"]}
        units = Units.of(self._content["bodies"])
        for own in out.values():
            own._units = units
        return out

    @property
    def answer(self) -> str:
        """`effect`, `class`, `none`, `unknown`, `insufficient` or `unfinished`; `several` where the answers of bodies differ."""
        if "answer" in self._content:
            return self._content["answer"]
        answers = {own.answer for own in self.bodies.values()}
        return answers.pop() if len(answers) == 1 else "several"

    @cached_property
    def effects(self) -> tuple[Effect, ...]:
        """Effects that were added, in the order in which they were found."""
        if "bodies" in self._content:
            return tuple(effect for own in self.bodies.values() for effect in own.effects)
        return tuple(
            Effect(
                name=e["name"],
                alternatives=tuple(name for name in e["class"] if name != e["name"]),
                parameters={key: Quantity(p["value"], tuple(p["interval90"]), p["unit"]) for key, p in e["parameters"].items()},
                p_value=e["p_value"],
                where=e["where"],
                body=self._content.get("body", ""),
            )
            for e in self._content["effects"]
        )

    @cached_property
    def error(self) -> ErrorChange:
        """Error before and after, of held-out recordings where there are any; for several bodies the root mean square."""
        if "bodies" in self._content:
            own = [body.error for body in self.bodies.values()]
            before, after, floor = (
                math.sqrt(sum(value**2 for value in column) / len(own))
                for column in zip(*((row.before, row.after, row.floor) for row in own))
            )
            return ErrorChange(before, after, own[0].unit, floor, all(row.held_out for row in own))
        e = self._content["error"]
        key = scored_by(e["after"])
        before, after = (math.nan if e[when].get(key) is None else e[when][key] for when in ("before", "after"))
        floor = math.hypot(*(e[name] or 0.0 for name in ("noise_floor", "discretisation_floor")))
        return ErrorChange(before, after, e["unit"], floor, key == "held_out")

    @property
    def why(self) -> tuple[str, ...]:
        """Reasons why the data say too little, or what is wrong with them."""
        return tuple(self._content.get("why", ()))

    @property
    def leads(self) -> tuple[str, ...]:
        """Effects that lead in a search that was cut off; they are no answer."""
        return tuple(lead["name"] for lead in self._content.get("leads", ()))

    @property
    def leaves_more(self) -> bool:
        """Whether the error with the named effects, of the whole or of one recording, is more than `MORE` times its floor."""
        return bool(self.effects) and most_over(self._content["error"]) > MORE

    @property
    def left_out(self) -> tuple[str, ...]:
        """Steps that the search has not done."""
        if "bodies" in self._content:
            return tuple(step for own in self.bodies.values() for step in own.left_out)
        return tuple(self._content.get("left_out", ()))

    @property
    def model_after(self) -> Path:
        """File of the model with the added effects, which `diagnose(..., model=...)` takes."""
        return self.folder / "model_after.yaml"

    @property
    def line(self) -> str:
        """The answer in one line; for several bodies a line each."""
        if "bodies" in self._content:
            return "\n".join(f"{body}: {own.line}" for body, own in self.bodies.items())
        error = self.error
        names = " and ".join(" or ".join(map(named, (e.name, *e.alternatives))) for e in self.effects)
        out = f"{self.answer}: {names}" if names else self.answer
        out += MORE_LEFT if self.leaves_more else ""
        out += f" (in the lead so far: {' and '.join(map(named, self.leads))})" if self.leads else ""
        out += "".join(f": {why}" for why in self.why[:1])
        scored = "held-out" if error.held_out else "fitted"
        out += f"; {scored} error {error.before:.3g} -> {error.after:.3g} {error.unit} (floor {error.floor:.2g})"
        return out + (f"; not done: {', '.join(self.left_out)}: give {more(self._content)}" if self.left_out else "")

    @property
    def words(self) -> Words:
        """The answer for one body in plain words: finding, error, certainty, effects not excluded, next experiment.

        Raises:
            UserError: There are several bodies.
        """
        if "bodies" in self._content:
            raise UserError(f"{self.name} has several bodies: take the words of one of `bodies`")
        return words_of(self._content, self._units or Units.of([self._content]))

    def summary(self) -> str:
        """Return the answer in plain words, as on the terminal and at the top of the page; for several bodies a paragraph each."""
        if "bodies" in self._content:
            return "\n\n".join(f"{body}: {own.summary()}" for body, own in self.bodies.items())
        return "\n".join(self.words.paragraphs)

    @property
    def kind(self) -> str:
        """Kind of the data: `experiment`, `material test` or `track`."""
        return self._content["kind"]

    def page(self) -> str:
        """Return the HTML page of the diagnosis, made anew from diagnosis.json and the predicted motion."""
        from neuido.discrepancy.report import page

        parts = [own._content for own in self.bodies.values()]
        return page.page(parts, [own.motion() for own in self.bodies.values()], kind=self.kind, name=self.name)

    def motion(self) -> "dict[str, dict[str, np.ndarray]]":
        """Return the stored arrays of each recording: measured, predicted before and after, and their times."""
        out = {}
        for name in self._content["recordings"] or self._content["error"]["after"]["by_recording"]:
            path = self._motion(name)
            if path is not None:
                out[name] = read_arrays(path, None, what="file of predictions")
        return out

    def plot(self) -> "Figure":
        """Return a matplotlib figure with a panel per recording: error over time, or the data with the predictions before and after."""
        from matplotlib.figure import Figure

        shown = [(name, own, arrays) for own in self.bodies.values() for name, arrays in own.motion().items() if "before" in arrays]
        shown = shown[:MOST_PANELS]
        figure = Figure(figsize=(3.6 * max(len(shown), 1), 2.8), layout="constrained")
        units = Units.of([own._content for own in self.bodies.values()])
        for i, (name, own, arrays) in enumerate(shown):
            ax = figure.add_subplot(1, len(shown), i + 1)
            if "nodes" in arrays:
                _field(ax, arrays, own._content, units)
            elif "positions" in arrays:
                _curves(ax, arrays, own.error, units)
            else:
                _data(ax, arrays, own._content, name, units)
            ax.set_title(plain(name), fontsize=9)
        if shown:
            figure.axes[0].legend(fontsize=7, frameon=False)
        figure.suptitle(textwrap.fill(self.line.splitlines()[0].replace("$", r"\$"), 52 * max(len(shown), 1)), fontsize=9)
        return figure

    def _motion(self, name: str) -> Path | None:
        path = self.folder / "predicted" / f"{name}.npz"
        return path if path.name == f"{name}.npz" and path.is_file() else None  # names with slashes are refused

    def report(self, path: str | os.PathLike | None = None) -> Path:
        """Copy the report, one self-contained HTML page, to a path, and return the path.

        Args:
            path: File, or an existing folder. None: the report stays in the folder of the results.
        """
        made = self.folder / "report.html"
        if path is None:
            return made
        target = Path(path).expanduser()
        target = target / made.name if target.is_dir() else target
        copy_file(made, target)
        return target

    def to_dict(self) -> dict[str, Any]:
        """Return a copy of the content of diagnosis.json."""
        return json.loads(json.dumps(self._content))

    def __repr__(self) -> str:
        """Return the answer, the effects, the error and the folder."""
        effects = ", ".join(str(e) for e in self.effects)
        e = self.error
        return f"Diagnosis({self.name!r}, {self.answer}: [{effects}], error {e.before:.3g} -> {e.after:.3g} {e.unit}, '{self.folder}')"


def _figure(q: Quantity) -> str:
    if isinstance(q.value, list):
        return f"({', '.join(f'{v:.3g}' for v in q.value)}) {q.unit}"
    low, high = ("infinite" if end is None else f"{end:.3g}" for end in q.interval)
    return f"{q.value:.3g}{'' if q.unit == '1' else f' {q.unit}'} (90 %: {low} to {high})"


def _field(ax: Any, arrays: Mapping[str, Any], content: Mapping[str, Any], units: Units) -> None:
    """Draw the size of the residual of a plane specimen at the last load step, with the effects where some are named.

    A triangle with a node that was not seen is left blank.
    """
    import numpy as np

    when = "after" if content["effects"] else "before"
    factor, unit = units.scaled("m")
    place = factor * (arrays["nodes"] + arrays[f"moved_{when}"][-1])
    size = factor * np.linalg.norm((arrays["moved_measured"] - arrays[f"moved_{when}"])[-1], axis=1)
    triangles = arrays["triangles"]
    unseen = np.isnan(size)[triangles].any(1)
    shown = ax.tripcolor(*place.T, np.ma.masked_invalid(size), triangles=triangles, mask=unseen, shading="gouraud")
    ax.set(aspect="equal", xlabel=f"x [{unit}]", ylabel=f"y [{unit}]")
    ax.plot([], [], label=f"residual {when}")
    ax.figure.colorbar(shown, ax=ax, label=f"residual [{unit}]")


def _curves(ax: Any, arrays: Mapping[str, Any], error: ErrorChange, units: Units) -> None:
    """Draw the root mean square distance of the points over time."""
    from neuido.discrepancy.report.plots import distance_over_time

    factor, unit = units.scaled("m")
    for when, colour in (("before", BEFORE), ("after", AFTER)):
        times, distance = distance_over_time(arrays, when)
        ax.plot(times, factor * distance, color=colour, label=when, lw=1.2)
    ax.axhline(factor * error.floor, color=INK, ls=":", lw=1, label="floor")
    ax.set(xlabel="time [s]", ylabel=f"RMS distance [{unit}]")
    ax.set_ylim(bottom=0.0)


def _data(ax: Any, arrays: Mapping[str, Any], content: Mapping[str, Any], name: str, units: Units) -> None:
    """Draw the data and the predictions of each channel over time, stretch or shear."""
    told = content["recordings"].get(name, {})
    factor, unit = units.scaled(content["error"]["unit"])
    x, label = axis_of(arrays, told, units)
    for i, group in enumerate(dict.fromkeys(arrays["groups"].tolist())):
        own = arrays["groups"] == group
        labels = ("measured", "before", "after") if i == 0 else (None, None, None)
        ax.plot(x[own], factor * arrays["measured"][own], ".", color=INK, ms=3, label=labels[0])
        ax.plot(x[own], factor * arrays["before"][own], color=BEFORE, lw=1, label=labels[1])
        ax.plot(x[own], factor * arrays["after"][own], color=AFTER, lw=1.2, label=labels[2])
    ax.set(xlabel=label, ylabel=f"{told.get('quantity', 'measured')} [{unit}]")
