"""What made material tests and tracks share: the size of an effect, the rows of the key, and the files of a folder."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from neuido.data.files.writing import write_text
from neuido.data.measured.material_test import read_material_tests
from neuido.data.undeclared.random_effects import Drawn, rms, rounded_to_4, scale_to_separation

Sizes = Mapping[str, tuple[Mapping[str, float], str, float, float]]
"""For each effect: initial values, names of the parameters to scale, and the smallest and largest scale factor."""
PAIR = 0.2
"""Share of pairs among the cases with an effect."""


def drawn_effect(kind: str, sizes: Sizes, target: float, noise: float, separation: Callable[[Mapping[str, float]], float]) -> Drawn | None:
    """Return an effect that moves the data by about `target` times the noise; None for `none`."""
    if kind == "none":
        return None
    values, names, smallest, largest = sizes[kind]
    drawn = Drawn(
        kind, {f"{kind}.{k}": float(v) for k, v in values.items()}, tuple(f"{kind}.{k}" for k in names.split()), smallest, largest
    )
    found = scale_to_separation(drawn, target, lambda one: separation(one.values), 16.0 * noise)
    return found.rounded()


def drawn_effects(kind: str, sizes: Sizes, target: float, noise: float, separation: Callable[[Mapping[str, float]], float]) -> list[Drawn]:
    """Return the effects of a kind, two for "first+second", each of which alone moves the data by about `target` times the noise."""
    found = [drawn_effect(one, sizes, target, noise, separation) for one in kind.split("+")]
    return [one for one in found if one is not None]


def values_of(drawn: Sequence[Drawn]) -> dict[str, float]:
    """Return the parameters of all effects."""
    return {name: value for one in drawn for name, value in one.values.items()}


def outside_entry(drawn: Drawn, meaning: str, units: Mapping[str, str], near: tuple[str, ...]) -> dict[str, Any]:
    """Describe an effect that the library cannot express for the list `undeclared` of the key of a case."""
    values = {key.partition(".")[2]: value for key, value in drawn.values.items()}
    return {"kind": drawn.kind, "diagnosis_names": [], "parameters": values, "sizes": [name.partition(".")[2] for name in drawn.sizes],
            "units": dict(units), "meaning": meaning, "outside_library": True, "near": list(near)}  # fmt: skip


def key_rows(true: list[np.ndarray], plain: list[np.ndarray], noise: float, roles: list[str], names: list[str], unit: str) -> list[dict]:
    """Return what the key says of each recording: how far the effect moves it."""
    rows = []
    for x, y, role, name in zip(true, plain, roles, names):
        separation = rms(x - y)
        rows.append(
            {
                "name": name,
                "role": role,
                f"separation_rms_{unit}": rounded_to_4(separation),
                "separation_over_noise": rounded_to_4(separation / noise),
            }
        )
    return rows


def write_tests(name: str, model: Mapping[str, Any], tests: Sequence[tuple], folder: Path) -> None:
    """Write a folder of material tests: (title, mode, role, columns, rows), and further keys of the test where there are any."""
    entries = []
    for title, mode, role, columns, rows, *more in tests:
        write_csv(folder / f"{title}.csv", tuple(columns.values()), rows)
        entries.append({"name": title, "file": f"{title}.csv", "mode": mode, "columns": dict(columns), "role": role} | dict(*more))
    content = {"format": "neuido-material-test/1", "name": name, "model": dict(model), "tests": entries}
    write_text(folder / "test.yaml", yaml.safe_dump(content, sort_keys=False, default_flow_style=None))
    read_material_tests(folder)


def write_csv(path: Path, titles: tuple[str, ...], rows: np.ndarray) -> None:
    """Write a CSV file."""
    lines = (titles, *([f"{value:.7g}" for value in row] for row in rows))
    write_text(path, "".join(f"{','.join(line)}\r\n" for line in lines))
