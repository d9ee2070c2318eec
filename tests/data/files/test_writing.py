"""What is written is whole or not there, whoever else writes, on whatever disk; links are replaced and never followed."""

import errno
import os
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from neuido.data.files.values import file_name
from neuido.data.files.writing import (
    atomic_write,
    check_writable,
    is_as_written,
    make_real_folder,
    new_folder,
    remove,
    write_arrays,
    write_text,
)
from neuido.discrepancy import store
from neuido.errors import UserError, one_line


def test_a_writer_that_fails_leaves_what_was_there(tmp_path):
    path = tmp_path / "a.txt"
    write_text(path, "before")
    with pytest.raises(OSError), atomic_write(path) as hidden:
        hidden.write_text("half")
        raise OSError(errno.ENOSPC, "No space left on device")
    assert path.read_text() == "before" and list(tmp_path.iterdir()) == [path]


def test_a_writer_that_fails_leaves_no_folder_that_it_made(tmp_path):
    with pytest.raises(OSError), atomic_write(tmp_path / "new" / "newer" / "a.txt"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert not list(tmp_path.iterdir())


def test_digest_of_what_was_written(tmp_path):
    path = tmp_path / "a.npz"
    write_arrays(path, {"x": np.ones(9)}, digest=True)
    assert is_as_written(path) and is_as_written(path, unnoted=True)
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    assert not is_as_written(path, unnoted=True)
    write_text(tmp_path / "b.txt", "x")
    assert not is_as_written(tmp_path / "b.txt") and is_as_written(tmp_path / "b.txt", unnoted=True)


def test_a_full_disk_leaves_nothing_that_is_cut(tmp_path):
    """A limit on the size of files, in a process of its own, is a disk that is full after 20 kB."""
    code = f"""
import numpy as np, resource, signal, sys
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
from neuido.data.files.writing import atomic_write
from neuido.errors import one_line
try:
    with atomic_write({str(tmp_path / "a.npy")!r}) as hidden, hidden.open("wb") as stream:
        np.save(stream, np.ones(100_000))
except OSError as error:
    print(one_line(error))
    sys.exit(7)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 7, done.stderr
    assert "No space left" in done.stdout
    assert not list(tmp_path.iterdir())


def test_many_writers_of_one_file_publish_whole_ones(tmp_path):
    path = tmp_path / "a.npy"

    def put(i):
        with atomic_write(path) as hidden, hidden.open("wb") as stream:
            np.save(stream, np.full(50_000, i))
        return len(set(np.load(path).tolist()))

    with ThreadPoolExecutor(8) as pool:
        assert set(pool.map(put, range(40))) == {1}
    assert list(tmp_path.iterdir()) == [path]


def test_what_a_dead_process_left_goes_and_what_a_live_one_writes_stays(tmp_path):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    host = "".join(c for c in socket.gethostname() if c.isalnum())[:20]
    left, held = (tmp_path / f".a.txt.{host}-{pid}-00000000.tmp" for pid in (dead.pid, os.getpid()))
    for path in (left, held):
        path.write_text("half")
    write_text(tmp_path / "a.txt", "whole")
    assert not left.exists() and held.exists() and (tmp_path / "a.txt").read_text() == "whole"


def test_a_link_is_replaced_and_not_followed(tmp_path):
    precious = tmp_path / "precious.txt"
    precious.write_text("mine")
    out = tmp_path / "out"
    out.mkdir()
    (out / "a.txt").symlink_to(precious)
    write_text(out / "a.txt", "new")
    assert precious.read_text() == "mine" and not (out / "a.txt").is_symlink()


def test_the_work_of_a_diagnosis_is_no_link(tmp_path):
    elsewhere, out = tmp_path / "elsewhere", tmp_path / "out"
    for folder in (elsewhere, out):
        folder.mkdir()
    (elsewhere / "precious.txt").write_text("mine")
    (out / ".work").symlink_to(elsewhere)
    with pytest.raises(UserError, match=r"\.work is a link"):
        store.workplace(out, "plan", resume=True)
    store.clear(out)
    assert (elsewhere / "precious.txt").read_text() == "mine" and not (out / ".work").is_symlink()
    (out / ".work").mkdir()
    (out / ".work" / "plan").symlink_to(elsewhere)
    with pytest.raises(UserError, match="is a link"):
        store.workplace(out, "plan", resume=True)
    store.workplace(out, "other", resume=True)
    assert (elsewhere / "precious.txt").exists()


def test_removing_keeps_what_links_lead_to(tmp_path):
    (tmp_path / "kept").mkdir()
    (tmp_path / "kept" / "a").write_text("a")
    (tmp_path / "gone").mkdir()
    (tmp_path / "gone" / "link").symlink_to(tmp_path / "kept")
    remove(tmp_path / "gone")
    remove(tmp_path / "nowhere")
    assert [p.name for p in tmp_path.iterdir()] == ["kept"] and (tmp_path / "kept" / "a").exists()


def test_a_folder_appears_whole_or_not(tmp_path):
    with pytest.raises(ZeroDivisionError), new_folder(tmp_path / "a") as hidden:
        (hidden / "x").write_text("x")
        raise ZeroDivisionError
    assert not list(tmp_path.iterdir())
    with new_folder(tmp_path / "a") as hidden:
        (hidden / "x").write_text("x")
        assert not (tmp_path / "a").exists()
    with pytest.raises(UserError, match="another process"), new_folder(tmp_path / "a") as hidden:
        (hidden / "x").write_text("y")
    assert (tmp_path / "a" / "x").read_text() == "x" and len(list(tmp_path.iterdir())) == 1


def test_a_folder_that_cannot_be_written_is_refused_and_nothing_made(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="is a file"):
        check_writable(tmp_path / "file" / "out")
    with pytest.raises(UserError, match="is a file"):
        make_real_folder(tmp_path / "file", "the folder")
    check_writable(tmp_path / "a" / "b")
    assert [p.name for p in tmp_path.iterdir()] == ["file"]
    with pytest.raises(UserError, match="cannot be written"):
        check_writable(type(tmp_path)("/proc/self"))


@pytest.mark.parametrize("name", ["ball", "golf-ball-1", "Gummi 70 °C", "試驗", "a.b"])
def test_names_of_files(name):
    assert file_name(name, "name") == name


@pytest.mark.parametrize("name", ["", " ", ".", "..", "../a", "/etc/passwd", "a/b", "a\\b", "C:a", ".hidden", "a\n", "a\0b", "x" * 121,
                                  "\udcff", "a ", "é" * 61, 3, None, ["a"], "\x1b[31m"])  # fmt: skip
def test_names_that_would_be_paths_are_refused(name):
    with pytest.raises(UserError, match=r"^name"):
        file_name(name, "name")


@pytest.mark.parametrize(
    "error",
    [MemoryError(), OSError(errno.ENOSPC, "No space left on device"), OSError(errno.EROFS, "Read-only file system", "/x"),
     PermissionError(errno.EACCES, "Permission denied", "/x"), RuntimeError("DefaultCPUAllocator: can't allocate memory: 1 bytes"),
     UserError("x" * 5000), UserError("a\nb\x1b[31m")],
)  # fmt: skip
def test_errors_of_the_machine_are_one_short_line(error):
    line = one_line(error)
    assert line and len(line) <= 300 and line.isprintable()


@pytest.mark.parametrize("target", ["nowhere", "folder"])
def test_a_new_folder_does_not_take_the_place_of_a_link(tmp_path, target):
    (tmp_path / "folder").mkdir()
    (tmp_path / "out").symlink_to(tmp_path / target)
    with pytest.raises(UserError, match="is a link"), new_folder(tmp_path / "out"):
        pytest.fail("work began")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder", "out"] and not list((tmp_path / "folder").iterdir())
