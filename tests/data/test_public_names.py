"""The public names of `neuido.data` are there, and none of them is imported before it is used."""

import subprocess
import sys

import pytest

import neuido.data


@pytest.mark.parametrize("name", neuido.data.__all__)
def test_name_is_there_and_documented(name):
    assert getattr(neuido.data, name).__doc__


def test_no_other_name():
    with pytest.raises(AttributeError, match=r"No neuido\.data attribute nothing"):
        _ = neuido.data.nothing
    assert set(neuido.data.__all__) <= set(dir(neuido.data))


def test_import_is_light():
    code = "import sys, neuido.data, neuido.data.undeclared; print('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "False"
