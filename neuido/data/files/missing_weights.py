"""Find the command that creates a missing file of weights."""

import os
from pathlib import Path

import yaml

from neuido.installation import configs_root


def weights_hint(path: str | os.PathLike, option: str = "init_from") -> str:
    """Return the remedy for a missing file of weights, as the end of an error message.

    It is the `neuido fit` command of the configuration whose `save_to` is this file. Without such a configuration it says where weights
    come from.

    Args:
        path: The missing file.
        option: The option that gave the path; `law` asks for a file of a law.
    """
    if option == "law":
        return "`neuido predict` writes law.safetensors for each scene"
    root = configs_root()
    for config in sorted(root.rglob("*.yaml"), key=lambda file: (len(file.parts), file.name)):
        content = yaml.safe_load(config.read_text())
        if not isinstance(content, dict) or not isinstance(content.get("model"), dict):
            continue
        target = content["model"].get("init_args", {}).get("save_to")
        if target is not None and Path(target) == Path(path):
            name = config.relative_to(root).as_posix()
            return f"create them with `neuido fit --config configs/{name}`, or give 'pretrained' for the weights that come with neuido"
    return "give a file that a training wrote (`save_to`), or 'pretrained' for the weights that come with neuido"
