"""The command that makes a file of weights which is not there."""

import os
from pathlib import Path

import yaml

from neuido import configs_root


def weights_hint(path: str | os.PathLike, option: str = "init_from") -> str:
    """Return the words that end an error about missing weights: the command that makes the file, or where others come from.

    A configuration makes a file when its `save_to` names it.
    """
    if option == "law":
        return "`neuido predict` writes a law.safetensors for each scene"
    root = configs_root()
    for config in sorted(root.rglob("*.yaml"), key=lambda file: (len(file.parts), file.name)):
        content = yaml.safe_load(config.read_text())
        if not isinstance(content, dict) or not isinstance(content.get("model"), dict):
            continue
        target = content["model"].get("init_args", {}).get("save_to")
        if target is not None and Path(target) == Path(path):
            name = config.relative_to(root).as_posix()
            return f"`neuido fit --config configs/{name}` makes them; 'pretrained' takes those that come with neuido"
    return "give a file that a `save_to` wrote, or 'pretrained' for those that come with neuido"
