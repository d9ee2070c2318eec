"""The player of a notebook, which begins anew at its end."""

import numpy as np
import pytest

from neuido.viewer import notebook
from neuido.viewer.content import Content, Motion

pytest.importorskip("viser", reason="viser is not installed: pip install neuido[viewer]")


def test_no_frame_stays_when_the_player_begins_anew(monkeypatch):
    """The page repeats what was recorded: points under one name are replaced, and none of the last frame are left beside the first."""
    names, ended = [], notebook.close_server

    def close(server):
        names.extend(server.scene._handle_from_node_name)
        ended(server)

    monkeypatch.setattr(notebook, "close_server", close)
    x = np.random.default_rng(0).random((4, 30, 3)).astype(np.float32)
    times = np.linspace(0.0, 1.0, 4)
    notebook.player(Content("ball", [Motion("ball", times, x)], times=times))
    assert [name for name in names if "particles" in name] == ["/motion/0/particles"]
