import pytest

from neuido.data.trajectories.options import make_trajectories

TINY = {
    "instances": 3,
    "held_out": 2,
    "particles_per_side": 4,
    "steps": 30,
    "velocity": (1.0, -30.0, -2.0),
    "device": "cpu",
    "progress": False,
}
"""Fast enough downwards to meet the floor within the few steps."""


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """Nine training trajectories and six held-out ones of 30 steps of 64 particles."""
    path = tmp_path_factory.mktemp("trajectories")
    make_trajectories(str(path), **TINY)
    return path
