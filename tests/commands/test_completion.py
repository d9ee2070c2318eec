"""Completion in a shell knows every command and every option."""

import re
import shutil
import subprocess
import sys

import pytest

from neuido.commands import main as cli
from neuido.commands.cli.functions import options_of
from neuido.commands.cli.signatures import TRAINER, classes, signature
from neuido.commands.completion import SHELLS, completion
from tests.command import run

pytest.importorskip("shtab")


@pytest.fixture(scope="module")
def scripts():
    return {shell: completion(shell, cli.LIGHT) for shell in SHELLS}


@pytest.mark.parametrize("shell", SHELLS)
def test_every_command_and_option_is_completed(scripts, shell):
    from importlib import import_module

    text = scripts[shell]
    for name, (module, function, _) in cli.LIGHT.items():
        assert re.search(rf"\b{name}\b", text)
        for option in options_of(getattr(import_module(module), function)):
            assert option in text
    for name in cli.HEAVY:
        assert re.search(rf"\b{name}\b", text)
    for option in signature(TRAINER).options:
        assert f"trainer.{option}" in text
    for key, prefix in (("model", "model"), ("method", "model.method"), ("data", "data")):
        for name, path in classes(key).items():
            assert name in text
            assert all(f"{prefix}.{option}" in text for option in signature(path).options)


def completed(script: str, *words: str) -> list[str]:
    """What bash offers for the last word."""
    line = " ".join(f"'{word}'" for word in words)
    code = f"{script}\nCOMP_WORDS=({line})\nCOMP_CWORD={len(words) - 1}\n_shtab_neuido\nprintf '%s\\n' \"${{COMPREPLY[@]}}\""
    answer = subprocess.run(["bash"], input=code, capture_output=True, text=True, check=True)
    return answer.stdout.split()


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
def test_bash_offers_what_there_is(scripts):
    bash = scripts["bash"]
    assert completed(bash, "neuido", "tra") == ["trajectories"]
    assert completed(bash, "neuido", "fit", "--trainer.max_ep") == ["--trainer.max_epochs"]
    assert completed(bash, "neuido", "fit", "--model", "Ad") == ["AdaptModule"]
    assert completed(bash, "neuido", "fit", "--model.stop_on", "") == ["none", "loss", "view"]
    assert "--minutes" in completed(bash, "neuido", "diagnose", "--")


def test_the_command_prints_it(capsys):
    status, out, err = run(capsys, "--print_completion", "bash")
    assert (status, err) == (0, "") and "_shtab_neuido" in out


@pytest.mark.parametrize(("words", "told"), [("zhs", "did you mean 'zsh'?"), ("", "choose from bash, zsh, fish, tcsh")])
def test_a_shell_that_is_not_known(capsys, words, told):
    status, out, err = run(capsys, f"--print_completion={words}")
    assert (status, out) == (2, "") and told in err and err.count("\n") == 1


def test_without_the_extra_it_is_named(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "shtab", None)
    status, _, err = run(capsys, "--print_completion", "bash")
    assert status == 2 and "pip install 'neuido[completion]'" in err
