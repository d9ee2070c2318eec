"""The weights that come with neuido are the defaults of the configurations; where others are missing, the error names what makes them."""

import re
from pathlib import Path

import pytest

import neuido
from neuido.data.files.yaml_files import read_configuration
from neuido.errors import UserError
from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.models.video.encoder import PRETRAINED, DynamicsEncoder
from neuido.models.video.video_vae import PREFIX, open_vae
from tests.command import run

ROOT = neuido.configs_root()


def weights_of(node) -> list[str]:
    """Return each encoder or VAE that a configuration reads."""
    if not isinstance(node, dict):
        return []
    own = [value for key, value in node.items() if key in ("init_from", "vae") and isinstance(value, str)]
    return own + [name for value in node.values() for name in weights_of(value)]


@pytest.mark.parametrize("path", sorted(ROOT.rglob("*.yaml")), ids=lambda p: p.stem)
def test_weights_come_with_neuido_or_a_command_makes_them(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in weights_of(read_configuration(path)):
        if name in PRETRAINED:
            assert PRETRAINED[name].is_file()
            continue
        if name.startswith(PREFIX):  # the paper's flow encoder, which nobody's training here makes
            with pytest.raises(UserError, match=r"the CogVideoX VAE needs diffusers|there is no CogVideoX VAE"):
                open_vae(name)
            continue
        with pytest.raises(UserError, match=r"create them with `neuido fit --config configs/[\w/]+\.yaml`") as error:
            DynamicsEncoder.load(name)
        maker = ROOT / re.search(r"configs/([\w/]+\.yaml)", str(error.value))[1]
        assert read_configuration(maker)["model"]["init_args"]["save_to"] == name


@pytest.mark.parametrize("read", [DynamicsEncoder.load, IntrinsicDynamicsOperator.load, open_vae])
def test_unknown_weights_are_answered_with_those_that_come_with_neuido(read, tmp_path):
    with pytest.raises(UserError, match=r"absent\.safetensors are missing: .*'pretrained'"):
        read(tmp_path / "absent.safetensors")


@pytest.mark.slow
def test_stage_two_runs_in_an_empty_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    data = ["--data", "tests.models.visual_samples.TinyScenes", "--data.folder", str(tmp_path / "scenes")]
    status, _, err = run(capsys, "fit", "--config", "stage2_small", *data, "--trainer.max_epochs", 1, "--trainer.limit_val_batches", 0)
    assert status == 0, err
    encoder = DynamicsEncoder.load(Path("runs/stage2_small/encoder.safetensors"))
    start = DynamicsEncoder.load("pretrained-small")
    change = max(
        float((a - b).detach().abs().max()) for a, b in zip(encoder.projector.parameters(), start.projector.parameters(), strict=True)
    )
    assert 0 < change < 0.1
