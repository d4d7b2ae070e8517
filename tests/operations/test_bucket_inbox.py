"""An inbox in object storage: what is whole is copied once, and nothing leads out of the folder."""

import uuid
from datetime import UTC, datetime
from pathlib import Path
from unittest.mock import Mock

import pytest

from data_contracts.operations import Arrival
from flows.service.bucket import BucketInbox
from flows.service.layout import StateFolder
from worldpose.errors import UsageError
from worldpose.store.blobs import Entry
from worldpose.store.objects import ObjectBlobs

QUIET = 10.0


@pytest.fixture
def arriving(bucket, tmp_path):
    """A prefix of a bucket, and a function that puts an object there."""
    prefix = uuid.uuid4().hex
    objects = ObjectBlobs.at(f"{bucket}/{prefix}")

    def put(path, content=b"x"):
        objects.put(path, content)

    (tmp_path / "inbox").mkdir()
    return f"{bucket}/{prefix}", put, objects.delete


def watched(arriving, tmp_path):
    return BucketInbox(arriving[0], tmp_path / "inbox", StateFolder(tmp_path / "operations"))


def files_of(folder):
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def test_a_match_is_copied_once_when_it_is_whole_and_quiet(arriving, tmp_path, small_match):
    _, put, _ = arriving
    inbox = watched(arriving, tmp_path)
    for path in sorted(small_match.rglob("*.npz")):
        put(f"urgent/small/{path.relative_to(small_match).as_posix()}", path.read_bytes())
    assert inbox.fetch(0.0, QUIET) == inbox.fetch(20.0, QUIET) == []
    for path in small_match.rglob("*"):
        if path.is_file():
            put(f"urgent/small/{path.relative_to(small_match).as_posix()}", path.read_bytes())
    assert inbox.fetch(30.0, QUIET) == []
    put("urgent/small/match.yaml", (small_match / "match.yaml").read_bytes() + b"\n# later\n")
    assert inbox.fetch(40.0, QUIET) == [], "it was still changing"
    assert inbox.fetch(50.0, QUIET) == ["urgent/small"]
    copied = tmp_path / "inbox" / "urgent" / "small"
    assert files_of(copied) == files_of(small_match)
    assert copied.joinpath("match.yaml").read_text().endswith("# later\n")
    # Once, also after a restart.
    assert inbox.fetch(60.0, QUIET) == []
    again = watched(arriving, tmp_path)
    assert again.fetch(0.0, QUIET) == again.fetch(20.0, QUIET) == []


def test_what_was_mended_in_the_bucket_takes_the_place_of_its_copy(arriving, tmp_path, monkeypatch):
    _, put, remove = arriving
    inbox = watched(arriving, tmp_path)
    put("m/match.yaml", b"contract: 0")
    put("m/old.npz")
    inbox.fetch(0.0, QUIET)
    assert inbox.fetch(10.0, QUIET) == ["m"]
    put("m/match.yaml", b"contract: 1\n")
    remove("m/old.npz")  # the wrong file
    inbox.fetch(20.0, QUIET)
    with monkeypatch.context() as killed, pytest.raises(KeyboardInterrupt):
        killed.setattr(Path, "rename", Mock(side_effect=KeyboardInterrupt))
        inbox.fetch(30.0, QUIET)
    inbox = watched(arriving, tmp_path)
    inbox.fetch(40.0, QUIET)
    assert inbox.fetch(50.0, QUIET) == ["m"]
    assert (tmp_path / "inbox" / "m" / "match.yaml").read_bytes() == b"contract: 1\n"
    assert files_of(tmp_path / "inbox" / "m") == {"match.yaml"}
    aside = tmp_path / "inbox" / ".removed"
    assert files_of(aside) == {"bucket/m/match.yaml", "bucket/m/old.npz"}
    put("m/match.yaml", b"contract: 20\n")
    inbox.fetch(60.0, QUIET)
    assert inbox.fetch(70.0, QUIET) == ["m"]
    assert files_of(aside) == {"bucket/m/match.yaml"}  # the last copy before: disks are finite
    assert (aside / "bucket" / "m" / "match.yaml").read_bytes() == b"contract: 1\n"


def test_a_match_taken_in_loses_nothing_by_the_bucket(arriving, tmp_path, caplog):
    _, put, remove = arriving
    inbox, state = watched(arriving, tmp_path), StateFolder(tmp_path / "operations")
    put("m/match.yaml", b"match_id: a")
    put("m/cam01.mp4", b"whole")
    inbox.fetch(0.0, QUIET)
    assert inbox.fetch(10.0, QUIET) == ["m"]
    more = {"match_id": "a", "reason": "to be clicked", "changed_at": datetime.now(UTC)}
    state.write_arrival(Arrival(name="m", state="taken", **more))
    remove("m/cam01.mp4")
    inbox.fetch(20.0, QUIET)
    assert inbox.fetch(30.0, QUIET) == inbox.fetch(31.0, QUIET) == []
    assert files_of(tmp_path / "inbox") == {"m/match.yaml", "m/cam01.mp4"}
    assert caplog.text.count("1 of its files no more, as cam01.mp4") == 1
    assert state.arrivals()["m"].reason.startswith("to be clicked; not copied again")
    put("m/cam01.mp4", b"of another match")
    put("m/match.yaml", b"match_id: b")
    inbox.fetch(40.0, QUIET)
    assert inbox.fetch(50.0, QUIET) == []
    assert "taken in as a, and match_id in the bucket is b" in state.arrivals()["m"].reason
    put("m/match.yaml", b"match_id: a # mended")
    inbox.fetch(60.0, QUIET)
    assert inbox.fetch(70.0, QUIET) == ["m"]
    assert state.arrivals()["m"].reason == "to be clicked"


def test_markers_of_folders_are_none_and_one_bad_match_stops_no_other(arriving, tmp_path, caplog):
    _, put, _ = arriving
    inbox = watched(arriving, tmp_path)
    for path in ("bad/file", "bad/file/inside", "bad/match.yaml", "m/a.mp4", "m/match.yaml"):
        put(path)
    for path in ("m/videos", "m/empty"):
        put(path, b"")
    put("m/videos/cam01.mp4")
    inbox.fetch(0.0, QUIET)
    assert inbox.fetch(10.0, QUIET) == ["m"]
    assert inbox.fetch(20.0, QUIET) == []
    copied = {"match.yaml", "a.mp4", "videos/cam01.mp4", "empty"}
    assert files_of(tmp_path / "inbox" / "m") == copied
    assert caplog.text.count("bad is not taken") == 1


def test_a_copy_that_was_changed_here_stays_until_it_is_moved_away(
    arriving, tmp_path, caplog, monkeypatch
):
    _, put, _ = arriving
    inbox, copy = watched(arriving, tmp_path), tmp_path / "inbox" / "m"
    put("m/match.yaml", b"contract: 1")
    inbox.fetch(0.0, QUIET)
    assert inbox.fetch(10.0, QUIET) == ["m"]
    (copy / "clicks.json").write_text("mine")
    put("m/notes.txt")
    inbox.fetch(20.0, QUIET)
    assert inbox.fetch(30.0, QUIET) == inbox.fetch(31.0, QUIET) == []
    assert files_of(copy) == {"match.yaml", "clicks.json"}
    assert caplog.text.count("was changed here") == 1
    copy.rename(tmp_path / "away")
    put("m/notes.txt", b"later")
    inbox.fetch(35.0, QUIET)
    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):  # killed at the end
        patched.setattr(Path, "rename", Mock(side_effect=KeyboardInterrupt))
        inbox.fetch(50.0, QUIET)
    (tmp_path / "inbox" / ".m.arriving").rename(copy)
    inbox = watched(arriving, tmp_path)
    inbox.fetch(60.0, QUIET)
    assert inbox.fetch(70.0, QUIET) == ["m"]
    assert files_of(copy) == {"match.yaml", "notes.txt"}


def test_what_somebody_put_into_the_folder_is_left_alone(arriving, tmp_path, caplog):
    _, put, _ = arriving
    (tmp_path / "inbox" / "m").mkdir()
    (tmp_path / "inbox" / "m" / "mine").touch()
    put("m/match.yaml")
    inbox = watched(arriving, tmp_path)
    inbox.fetch(0.0, QUIET)
    assert inbox.fetch(10.0, QUIET) == []
    assert files_of(tmp_path / "inbox") == {"m/mine"}
    assert "is there already" in caplog.text


@pytest.mark.parametrize("path", ["m/../../outside", "m/a\\b", "m/a\nb"])
def test_names_that_lead_elsewhere_are_not_taken(path, arriving, tmp_path, caplog, monkeypatch):
    inbox = watched(arriving, tmp_path)
    now = datetime.now(UTC)
    listed = [Entry(each, 1, now) for each in ("m/match.yaml", path)]
    # Clients tidy such names up; other programs do not.
    monkeypatch.setattr(ObjectBlobs, "all_entries", lambda objects: listed)
    inbox.fetch(0.0, QUIET)
    assert inbox.fetch(10.0, QUIET) == []
    assert files_of(tmp_path) <= {"operations/bucket.json"}
    assert "is not taken" in caplog.text


def test_an_address_that_is_none_is_refused(tmp_path):
    with pytest.raises(UsageError, match="--bucket"):
        BucketInbox("gs://bucket", tmp_path, StateFolder(tmp_path))
