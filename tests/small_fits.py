"""What tests of trainings by the command line share: a folder with small trajectories and the configuration of a fit."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml

from neuido.commands.main import main


def write_fit(folder: Path, configuration: Mapping[str, Any]) -> Path:
    """Make `trajectories` and `fit.yaml` in a folder, and return it."""
    with pytest.raises(SystemExit) as stop:
        main(["trajectories", "--out", str(folder / "trajectories"), "--instances=1", "--held_out=0",
              "--setup.particles_per_side=3", "--setup.steps=40", "--device=cpu", "--progress=false"])  # fmt: skip
    assert stop.value.code == 0
    (folder / "fit.yaml").write_text(yaml.safe_dump(dict(configuration)))
    return folder
