"""Diagnoses that read from and write to S3, on a local server: equal to those of a folder, done once, nothing cut passes for whole."""

import uuid

import pytest

from neuido.commands.engines.many_diagnoses import diagnose_folder, diagnose_folders
from neuido.commands.engines.outcome import Share
from neuido.commands.engines.task_folder import MARK, begin, finish, finished, joined, local_copy, written
from neuido.errors import UserError
from tests.commands.test_engines import OPTIONS
from tests.discrepancy import made

moto_server = pytest.importorskip("moto.server", reason="needs moto[s3], flask and flask-cors")
s3fs = pytest.importorskip("s3fs", reason="needs s3fs")


@pytest.fixture
def bucket(monkeypatch):
    """The address of an empty bucket, which tasks in other processes reach too."""
    server = moto_server.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    for name, value in (("ENDPOINT_URL", f"http://{host}:{port}"), ("ACCESS_KEY_ID", "x"), ("SECRET_ACCESS_KEY", "x"),
                        ("DEFAULT_REGION", "us-east-1"), ("EC2_METADATA_DISABLED", "true")):  # fmt: skip
        monkeypatch.setenv(f"AWS_{name}", value)
    s3fs.S3FileSystem.clear_instance_cache()
    name = f"lab-{uuid.uuid4().hex}"  # the servers of one process share their buckets
    s3fs.S3FileSystem().mkdir(name)
    yield f"s3://{name}"
    s3fs.S3FileSystem.clear_instance_cache()
    server.stop()


def listed(place: str) -> list[str]:
    system = s3fs.S3FileSystem(skip_instance_cache=True)
    return sorted(name.removeprefix(place.removeprefix("s3://") + "/") for name in system.find(place))


def test_a_folder_goes_to_a_bucket_and_back(bucket):
    out = joined(bucket, "one")
    with written(out) as folder:
        (folder / "below").mkdir()
        (folder / "below" / "a.txt").write_text("whole")
    finish(out, "x", {"answer": "none"})
    assert listed(out) == [MARK, "below/a.txt"] and finished(out, "x") == {"answer": "none"} and finished(out, "y") is None
    with local_copy(out) as copy:
        assert (copy / "below" / "a.txt").read_text() == "whole"
    with pytest.raises(UserError, match="absent cannot be reached: FileNotFoundError"), local_copy(f"{bucket}/absent"):
        pass


def test_a_task_that_is_cut_off_leaves_no_mark_of_an_earlier_one(bucket):
    out = joined(bucket, "one")
    finish(out, "x", {"answer": "none"})
    begin(out)
    with pytest.raises(KeyboardInterrupt), written(out) as folder:
        (folder / "half.txt").write_text("half")
        raise KeyboardInterrupt
    assert finished(out, "x") is None and listed(out) == []
    begin(out)  # where there is none, nothing happens


@pytest.mark.slow
def test_folders_of_a_bucket_are_diagnosed_as_those_of_a_disk(bucket, tmp_path):
    made.track(tmp_path / "throw")
    for name in "ab":
        s3fs.S3FileSystem().put(str(tmp_path / "throw"), f"{bucket}/throws/{name}", recursive=True)
    alone = diagnose_folder(str(tmp_path / "throw"), str(tmp_path / "alone"), OPTIONS)
    asked = ([f"{bucket}/throws/a", f"{bucket}/throws/b"], f"{bucket}/answers", OPTIONS)
    kept = {"engine": "local", "address": None, "share": Share(), "progress": False}
    assert diagnose_folders(*asked, **kept) == 0
    names = listed(f"{bucket}/answers")
    assert {"diagnoses.csv", "a/diagnosis.json", "b/report.html", f"b/{MARK}"} <= set(names)
    system = s3fs.S3FileSystem(skip_instance_cache=True)
    for name in "ab":
        assert system.cat(f"{bucket}/answers/{name}/model_after.yaml") == (tmp_path / "alone" / "model_after.yaml").read_bytes()
    made_at = system.info(f"{bucket}/answers/a/report.html")["LastModified"]
    again = diagnose_folder(f"{bucket}/throws/a", f"{bucket}/answers/a", OPTIONS)  # found done, without a second upload
    assert {**again, "seconds": 0} == {**alone, "seconds": 0}
    assert s3fs.S3FileSystem(skip_instance_cache=True).info(f"{bucket}/answers/a/report.html")["LastModified"] == made_at
