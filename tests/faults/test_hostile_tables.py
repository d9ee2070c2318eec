"""Malformed and hostile tables: one line and status 2, nothing half-written, nothing outside the folder."""

import collections
import warnings

import pytest

from neuido.commands.main import main
from neuido.data.importers.importing import import_file
from neuido.errors import UserError
from tests.faults.hostile_tables import TENSILE, all_of_them

pytest.importorskip("pint")
HOSTILE = all_of_them()


def content(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def test_there_are_two_hundred_of_many_kinds():
    assert len(HOSTILE) >= 200 and len(collections.Counter(each.kind for each in HOSTILE)) >= 12
    assert len({(each.kind, each.name) for each in HOSTILE}) == len(HOSTILE)


@pytest.mark.slow
@pytest.mark.parametrize("each", HOSTILE, ids=[f"{each.kind}: {each.name}"[:60] for each in HOSTILE])
def test_one_line_and_nothing_written(tmp_path, monkeypatch, each):
    (tmp_path / "in").mkdir()
    monkeypatch.chdir(tmp_path)
    (tmp_path / "in" / each.file).write_bytes(each.content)
    before = content(tmp_path)
    with warnings.catch_warnings(), pytest.raises(UserError) as refused:
        warnings.simplefilter("ignore")
        import_file(tmp_path / "in" / each.file, tmp_path / "out", **each.options)
    message = str(refused.value)
    assert message.isprintable() and "\n" not in message and 10 < len(message) <= 300
    assert "Error:" not in message and ".tmp" not in message
    assert content(tmp_path) == before


@pytest.mark.parametrize("kind", dict.fromkeys(each.kind for each in HOSTILE if not each.options))
def test_the_command_ends_with_status_2(tmp_path, capsys, kind):
    each = next(each for each in HOSTILE if each.kind == kind and not each.options)
    (tmp_path / each.file).write_bytes(each.content)
    with warnings.catch_warnings(), pytest.raises(SystemExit) as stop:
        warnings.simplefilter("ignore")
        main(["import", str(tmp_path / each.file), "--out", str(tmp_path / "out")])
    said = capsys.readouterr().err.strip().splitlines()
    assert stop.value.code == 2 and len(said) == 1 and said[0].startswith("neuido: ")
    assert content(tmp_path) == [each.file]


@pytest.mark.parametrize("label", ["../../evil", "/etc/passwd", "a\\..\\..\\b", "CON", "....", "x" * 500, "$(touch evil)", "-", "ünïcödé"])
def test_names_in_a_table_never_become_paths(tmp_path, label):
    (tmp_path / "in").mkdir()
    rows = [f"{name},{row}" for name in (label, "other") for row in TENSILE[1:]]
    (tmp_path / "in" / "a.csv").write_text("\n".join([f"Specimen,{TENSILE[0]}", *rows]))
    import_file(tmp_path / "in" / "a.csv", tmp_path / "out")
    files = [name for name in content(tmp_path) if name not in ("in", "in/a.csv", "out")]
    assert len(files) == 3 and all(name.startswith("out/") and name.count("/") == 1 for name in files)


def test_what_is_there_stays(tmp_path):
    (tmp_path / "a.csv").write_text("\n".join(TENSILE))
    (tmp_path / "out").mkdir()
    (tmp_path / "file").write_text("mine")
    for out in (tmp_path / "out", tmp_path / "file", tmp_path / "file" / "out"):
        with pytest.raises((UserError, OSError)):
            import_file(tmp_path / "a.csv", out)
    for files in ([], [tmp_path / "b.csv"], [tmp_path], [tmp_path / "a.csv"] * 2):
        with pytest.raises(UserError):
            import_file(files, tmp_path / "new")
    assert content(tmp_path) == ["a.csv", "file", "out"] and (tmp_path / "file").read_text() == "mine"
