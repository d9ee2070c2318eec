"""Limits that hold before memory is allocated: the largest counts of an input, and the memory that its shapes need.

`LIMITS` has the largest counts; an environment variable of the same name changes one. `MEMORY` names the one for memory, which is what the
device has free unless it is set. This module does not load torch, so that readers may use it.
"""

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING

from neuido.errors import UserError

if TYPE_CHECKING:
    import torch

LIMITS = {
    "NEUIDO_MAX_TEXT_BYTES": 1 << 26,
    "NEUIDO_MAX_YAML_BYTES": 1 << 22,
    "NEUIDO_MAX_YAML_NODES": 1_000_000,
    "NEUIDO_MAX_TABLE_CELLS": 5_000_000,
    "NEUIDO_MAX_ARRAY_ELEMENTS": 1 << 28,
    "NEUIDO_MAX_IMAGE_PIXELS": 1 << 27,
    "NEUIDO_MAX_FRAMES": 100_000,
    "NEUIDO_MAX_PARTICLES": 20_000_000,
    "NEUIDO_MAX_COLLIDERS": 256,
    "NEUIDO_MAX_BODIES": 64,
    "NEUIDO_MAX_STEPS": 10_000_000,
    "NEUIDO_MAX_TRAJECTORIES": 1_000_000,
    "NEUIDO_MAX_MESH_BYTES": 1 << 30,
    "NEUIDO_MAX_TRIANGLES": 10_000_000,
}
"""Largest number of bytes of a text file and of a YAML file, nodes of a YAML file, cells of a table, elements of an array, pixels of an
image, frames of a video, particles of a body or a PLY file, colliders and bodies of a scene, steps of a simulation, trajectories of a
folder, bytes of a mesh file, and triangles or vertices of a mesh."""

MEMORY = "NEUIDO_MAX_MEMORY_BYTES"
"""The environment variable with the largest memory that one simulation may need."""
UNCHECKED = 1 << 28
"""Memory [bytes] below which what is free is not looked up, since that takes longer than a short rollout."""


def limit(name: str) -> int:
    """Return a limit of `LIMITS`, or the environment variable of the same name if it is set.

    Raises:
        UserError: The variable is not a positive whole number.
    """
    given = _given(name)
    return LIMITS[name] if given is None else given


def check_limit(count: int, name: str, what: str) -> None:
    """Check that a size does not exceed a limit of `LIMITS`.

    Args:
        count: The size.
        name: Key of `LIMITS`.
        what: Beginning of the error message, such as "a.yaml has 12 bytes".

    Raises:
        UserError: The size exceeds the limit; the message names the environment variable that raises it.
    """
    if count > limit(name):
        raise UserError(f"{what}, more than the limit of {limit(name)}: raise it with the environment variable {name}")


def check_frames(steps: int, every: int) -> None:
    """Raise UserError unless `steps` is a positive multiple of `every` and within `NEUIDO_MAX_STEPS`."""
    check_limit(steps, "NEUIDO_MAX_STEPS", f"steps is {steps}")
    if steps < 1 or every < 1 or steps % every:
        raise UserError(f"steps is {steps} and every is {every}; steps must be a positive multiple of every")


def check_memory(needed: int, device: "torch.device | str", what: str, change: str, *, own: int = 0) -> None:
    """Check that memory which is about to be allocated is there.

    Args:
        needed: An estimate from the shapes [bytes].
        device: Where it would be allocated.
        what: Beginning of the error message, such as "a grid of 10 x 10 x 10 nodes".
        change: The options that make it less: "lower cells".
        own: What the caller holds for the same purpose and would use again or give back [bytes].

    Raises:
        UserError: It exceeds `MEMORY`, or what the device has free where that is not set.
    """
    given = _given(MEMORY)
    if given is None and needed <= UNCHECKED:
        return
    if given is not None:
        largest, there = given, f"more than the limit of {_bytes(given)}"
    else:
        free = free_memory(device)
        if free is None:
            return
        largest, there = free + own, f"{device} has {_bytes(free + own)} free"
    if needed > largest:
        raise UserError(f"{what} needs about {_bytes(needed)} of memory, {there}: {change}, or set {MEMORY}")


def free_memory(device: "torch.device | str") -> int | None:
    """Return the memory [bytes] that can be allocated on a device; None where the system does not tell."""
    if str(device).startswith("cuda"):
        import torch

        unused = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
        return torch.cuda.mem_get_info(device)[0] + unused
    try:
        found = re.search(r"^MemAvailable: +(\d+) kB", Path("/proc/meminfo").read_text(), re.MULTILINE)
        return int(found[1]) * 1024 if found else None
    except OSError:  # not Linux
        names = getattr(os, "sysconf_names", {})
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") if "SC_PHYS_PAGES" in names else None


def _given(name: str) -> int | None:
    """Return the whole number that an environment variable holds; None where it is not set."""
    given = os.environ.get(name, "").strip()
    if not given:
        return None
    if not re.fullmatch(r"[0-9]{1,18}", given) or int(given) < 1:
        raise UserError(f"the environment variable {name} must be a positive whole number, got {given!r}")
    return int(given)


def _bytes(count: float) -> str:
    """Return a number of bytes as people read it: "1.5 GB"."""
    for unit in ("bytes", "kB", "MB", "GB", "TB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} PB"
