"""The visual half of the demonstration, from film to picture, with a training that is too short to learn much."""

import matplotlib.image
import pytest

from neuido.commands.demo import law_from_video as demo_video


@pytest.mark.slow
def test_demo_video(tmp_path, monkeypatch):
    monkeypatch.setattr(demo_video, "RECONSTRUCTION", {**demo_video.RECONSTRUCTION, "steps": 10})
    result = demo_video.demo_video(str(tmp_path / "demo"), epochs=2, adaptation_steps=6)
    assert [scene.name for scene in result.scenes] == ["elastic-0", "elastic-4", "elastic-9"]
    assert [scene.unseen for scene in result.scenes] == [False, False, True]
    assert len(result.losses) == 2 and max(result.losses) < 1  # of four steps: the curriculum's are the first two
    assert result.encoder.is_file()
    assert result.adapted.name == "elastic-9" and result.adapted.steps == 6
    assert result.adapted.after["psnr"] > result.adapted.before["psnr"] + 0.2
    assert matplotlib.image.imread(result.adapted.picture).std() > 0.05
    for scene in result.scenes:
        assert scene.seconds > 0 and scene.video.is_file()
        assert matplotlib.image.imread(scene.picture).std() > 0.05
        assert scene.scores["psnr"] > 10 and scene.scores["floor"] > 0
