"""A lock holds off a second process, says who has it, and goes with its owner."""

import os
import socket
import subprocess
import sys

import pytest

from neuido.data.files.lock import LockHeld, OwnedLock

HOLD = """
import sys
from neuido.data.files.lock import OwnedLock
with OwnedLock(sys.argv[1], "the run a"):
    print("held", flush=True)
    sys.stdin.readline()
"""


def test_second_process_is_told_who_holds_it(tmp_path):
    path = tmp_path / "a.lock"
    with subprocess.Popen([sys.executable, "-c", HOLD, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "held\n"
        with pytest.raises(LockHeld, match=rf"the run a is held by process {process.pid} on {socket.gethostname()}") as error:
            OwnedLock(path, "the run a").__enter__()
        assert "\n" not in str(error.value)
        process.communicate("\n")
    assert not (tmp_path / "a.lock.owner").exists()
    with OwnedLock(path, "the run a"):
        assert f'"pid": {os.getpid()}' in (tmp_path / "a.lock.owner").read_text()


@pytest.mark.parametrize("text", ["", "{", "[1]", '{"host": 3}', '{"child": -1}'])
def test_record_that_is_damaged_holds_nothing(tmp_path, text):
    (tmp_path / "a.lock.owner").write_text(text)
    with OwnedLock(tmp_path / "a.lock", "it"):
        pass


def test_child_that_outlives_its_owner_holds_on(tmp_path):
    code = (
        HOLD.replace("as lock", "")
        .replace('"the run a"):', '"the run a") as lock:')
        .replace(
            'print("held", flush=True)',
            'import os, subprocess\n    child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=sys.stdin)\n'
            "    lock.share_with_child(child.pid)\n    print(child.pid, flush=True)\n    os._exit(0)",
        )
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path / "a")], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as owner:
        child = int(owner.stdout.readline())
        assert owner.wait() == 0
        with pytest.raises(LockHeld, match=f"process {child} on"):
            OwnedLock(tmp_path / "a", "it").__enter__()
        owner.stdin.write("\n")
        owner.stdin.flush()
        owner.stdout.read()  # ends when the child has closed it
    with OwnedLock(tmp_path / "a", "it", wait=30):
        pass
