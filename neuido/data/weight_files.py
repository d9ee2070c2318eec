"""Safetensors files: written where all numbers are finite; read as not trusted, and compared with a module before memory is taken."""

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from neuido.data.files.parsing import naming, one_line, parser_errors
from neuido.data.files.writing import atomic_write
from neuido.errors import UserError


def write_safetensors(path: str | os.PathLike, tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None = None) -> None:
    """Write tensors to a safetensors file atomically; an earlier file stays where they are refused.

    Raises:
        UserError: A tensor holds a NaN or an infinity.
    """
    for name, tensor in tensors.items():
        if not _is_finite(tensor):
            raise UserError(f"{path} is not written: {name} holds a NaN or an infinity")
    with atomic_write(path) as hidden:
        save_file(dict(tensors), hidden, metadata=None if metadata is None else dict(metadata))


def read_safetensors(path: str | os.PathLike) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Return the tensors and the metadata of a safetensors file.

    Raises:
        UserError: The file is missing, damaged, or no safetensors file.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{path} is missing" if not path.exists() else f"{path} is no file")
    try:
        with safe_open(path, framework="pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}, dict(file.metadata() or {})
    except Exception as error:  # SafetensorError, and torch's own of a type or a size that it does not know
        raise UserError(f"{path} is not a safetensors file: {one_line(error)}") from error


def parse_metadata(metadata: Mapping[str, str], key: str, path: str | os.PathLike) -> dict[str, Any]:
    """Return the mapping that an entry of the metadata holds as JSON.

    Raises:
        UserError: There is no such entry, or no mapping in it.
    """
    if key not in metadata:
        raise UserError(f"{path} is no whole weights file: its metadata lack {key!r}")
    with parser_errors(path, f"whole weights file ({key})"):
        content = json.loads(metadata[key])
    if not isinstance(content, dict):
        raise UserError(f"{path} is no whole weights file: {key} must be a mapping of keys to values")
    return content


AnyModule = TypeVar("AnyModule", bound=nn.Module)


def build(make: Callable[..., AnyModule], config: Mapping[str, Any], tensors: Mapping[str, Tensor], path: str | os.PathLike) -> AnyModule:
    """Return a module that holds the tensors of a file. Their shapes are compared first, so that no size in the file takes memory.

    Args:
        make: The module's class.
        config: Its arguments, from the file.
        tensors: Of the file, by the names of the module's state.
        path: The file, for errors.

    Raises:
        UserError: Arguments that the class does not take, tensors that do not fit, or one that is not finite.
    """
    with naming(path, "does not hold the arguments of a module"):
        with torch.device("meta"):
            shapes = {name: t.shape for name, t in make(**config).state_dict().items()}
        check_shapes(shapes, tensors, path)
        module = make(**config)
        module.load_state_dict(dict(tensors))
    return module


def check_shapes(shapes: Mapping[str, torch.Size], tensors: Mapping[str, Tensor], path: str | os.PathLike) -> None:
    """Compare the tensors of a file with the shapes that a module has, and refuse numbers that are not finite.

    Raises:
        UserError: A tensor is missing, unknown, of another shape, or holds a NaN or an infinity.
    """
    words = f"{path} does not hold the tensors that its configuration names"
    if unlike := sorted(set(shapes) ^ set(tensors)):
        raise UserError(f"{words}: {unlike[0]} is {'missing' if unlike[0] in shapes else 'not known'}")
    for name, shape in shapes.items():
        if tensors[name].shape != shape:
            raise UserError(f"{words}: {name} is {tuple(tensors[name].shape)}, not {tuple(shape)}")
        if not _is_finite(tensors[name]):
            raise UserError(f"{path}: {name} holds a NaN or an infinity")


def _is_finite(tensor: Tensor) -> bool:
    return not tensor.is_floating_point() or bool(torch.isfinite(tensor).all())
