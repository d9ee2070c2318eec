"""A used folder is continued, refused or held by another process; what is refused stays as it was."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from neuido.data.files.output_folder import check_unused, claimed_folder, held_folder
from neuido.data.files.writing import made_folder, new_folder
from neuido.errors import UserError

PLAN = {"format": "test/1", "setup": {"steps": 3, "velocity": (1.0, 2.0)}}
HELD = "films of another set-up"
WAIT = """
import sys
from pathlib import Path
from neuido.data.files.output_folder import claimed_folder
from neuido.data.files.writing import new_folder
folder = Path(sys.argv[1])
with (new_folder(folder) if sys.argv[2] == "new" else claimed_folder(folder, {"a": 1}, "other things")):
    print("held", flush=True)
    sys.stdin.read()
"""


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_the_same_set_up_goes_on_and_another_is_refused(tmp_path):
    folder = tmp_path / "a" / "b"
    for _ in range(2):
        with claimed_folder(folder, PLAN, HELD, compared="setup") as made:
            (made / "film.npz").write_bytes(b"frames")
            assert (folder / ".lock-out").is_file()
    before = contents(folder)
    assert set(before) == {"plan.json", "film.npz"}  # no lock stays
    other = {**PLAN, "setup": {**PLAN["setup"], "steps": 4}}
    with pytest.raises(UserError, match=r"films of another set-up \(steps is 3 there and 4 here\): give another --out"):
        with claimed_folder(folder, other, HELD, compared="setup", option="--out"):
            pytest.fail("a folder of another set-up was used")
    assert contents(folder) == before
    (folder / "plan.json").write_text(json.dumps({"setup": {"velocity": [1, 2], "steps": 3}, "format": "test/1"}))  # the order counts not
    with claimed_folder(folder, PLAN, HELD):
        pass


def test_work_that_is_refused_before_it_writes_leaves_nothing(tmp_path):
    folder = tmp_path / "made"
    for write in (False, True, False):
        with pytest.raises(UserError, match="refused"), claimed_folder(folder, PLAN, HELD):
            if write:
                (folder / "result.txt").write_text("there")
            raise UserError("refused")
        assert folder.exists() == (folder / "result.txt").exists() == (folder / "plan.json").exists()
    assert folder.exists()


def test_other_files_are_in_use_and_hidden_ones_are_not(tmp_path):
    (tmp_path / ".cache").write_text("")
    with claimed_folder(tmp_path / "new", PLAN, HELD), claimed_folder(tmp_path / "second", PLAN, HELD):
        pass
    check_unused(tmp_path / "absent")
    used = tmp_path / "used"
    used.mkdir()
    (used / ".lock-out").touch()
    check_unused(used)
    (used / "thesis.tex").write_text("mine")
    for refuse in (lambda: check_unused(used), lambda: claimed_folder(used, PLAN, HELD).__enter__()):
        with pytest.raises(UserError, match=r"in use.*thesis\.tex.*give another out"):
            refuse()
    assert contents(used) == {".lock-out": b"", "thesis.tex": b"mine"}
    with claimed_folder(used, PLAN, HELD, keeps=("thesis.tex",)):
        pass
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="is a file"), claimed_folder(tmp_path / "file" / "out", PLAN, HELD):
        pass


@pytest.mark.parametrize("kind", ["claimed", "new"])
def test_a_second_process_is_told_who_writes(tmp_path, kind):
    folder = tmp_path / "out"
    other = subprocess.Popen([sys.executable, "-c", WAIT, str(folder), kind], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert other.stdout.readline() == "held\n"
    words = rf"{folder} is .* by process {other.pid} on {socket.gethostname()}"
    with pytest.raises(UserError, match=words) as error:
        with new_folder(folder) if kind == "new" else claimed_folder(folder, {"a": 1}, HELD):
            pytest.fail("two processes write one folder")
    assert "\n" not in str(error.value) and (kind == "new" or " since 20" in str(error.value))
    other.kill()
    other.wait()
    other.stdin.close()
    other.stdout.close()
    with new_folder(folder) if kind == "new" else claimed_folder(folder, {"a": 1}, HELD):  # that of a dead process is taken over
        pass
    assert not list(tmp_path.glob(".out*"))


def test_shards_write_side_by_side_but_not_twice_the_same(tmp_path):
    with held_folder(tmp_path, shard=0, shards=4), held_folder(tmp_path, shard=1, shards=4), held_folder(tmp_path, shard=3, shards=8):
        for shard, shards in ((0, 4), (0, 1), (4, 8), (0, 2), (3, 4)):
            with pytest.raises(UserError, match=f"held by process {os.getpid()}"), held_folder(tmp_path, shard=shard, shards=shards):
                pass
    with made_folder(tmp_path / "new"), held_folder(tmp_path / "new"):
        pass
    assert not list(tmp_path.iterdir())  # nothing is in either, neither locks


def test_a_new_folder_takes_the_place_of_one_with_hidden_files(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / ".lock-out").write_text("old")
    with new_folder(tmp_path / "a") as hidden:
        (hidden / "x").write_text("whole")
    assert contents(tmp_path / "a") == {".lock-out": b"old", "x": b"whole"}


def test_a_new_folder_that_fails_leaves_nothing(tmp_path):
    with pytest.raises(ZeroDivisionError), new_folder(tmp_path / "a" / "b" / "c") as hidden:
        (hidden / "x").write_text("half")
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []
