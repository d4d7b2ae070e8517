"""A match in the inbox is taken in once, when complete; what can be none is refused and said so."""

import contextlib
import hashlib
import os
import shutil
import socket
from multiprocessing import get_context
from pathlib import Path
from types import SimpleNamespace

import pytest

from flows.overview import Overview
from flows.registering import find_match, open_for_review, open_match, open_stored
from flows.service import deployed, watching
from flows.service.alerts import Alert, AlertDispatcher
from flows.service.inbox import (
    MOST_FILES,
    RefusalError,
    entries,
    fingerprint_of,
    missing_of,
    take_in,
    watch_once,
)
from flows.service.layout import StateFolder
from flows.service.plan import ServePlan
from flows.service.recovery import Liveness, recover
from worldpose.errors import InputError
from worldpose.simulation.matches import MatchOptions, simulate_match
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.store.store import Store


class Desk:
    """A project, its inbox, and the runs that were begun."""

    def __init__(self, folder):
        self.inbox = folder / "inbox"
        self.store = Store.create(folder / "project")
        self.state = StateFolder(folder / "project" / "operations")
        self.begun = []

    def look(self, quiet=0.0):
        return len(watch_once(self.state, self.inbox, quiet))

    def take_in(self, quiet=0.0):
        return take_in(self.store, self.state, self.inbox, quiet, self.begin)

    def begin(self, match, arrival):
        self.begun.append((match.match_id, arrival.priority))
        return f"run-{len(self.begun)}"

    def known(self):
        return {name: (each.state, each.reason) for name, each in self.state.arrivals().items()}


@pytest.fixture
def desk(drop, tmp_path):
    return Desk(tmp_path)


@pytest.fixture
def clock(monkeypatch):
    """The machine's clock that only goes forward, as a test sets it [s]."""
    clock = SimpleNamespace(now=1000.0)
    read = SimpleNamespace(monotonic=lambda: clock.now)
    monkeypatch.setattr("flows.service.inbox.time", read)
    return clock


def content(folder):
    return {
        path.relative_to(folder): (path.read_bytes(), path.stat().st_mtime_ns)
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_a_complete_match_is_taken_once_and_stays_where_it_is(desk, drop):
    folder = drop()
    before = content(folder)
    assert desk.look() == 0, "seen for the first time, it may still be arriving"
    assert desk.look() == 1
    (taken,) = desk.take_in()
    assert (taken.state, taken.flow_run) == ("taken", "run-1")
    assert taken.match_id == "tiny-0-0.2s-3cameras-2players"
    assert desk.store.matches() == (taken.match_id,)
    assert desk.begun == [(taken.match_id, "normal")]
    assert (desk.look(), desk.take_in(), len(desk.begun)) == (0, [], 1)
    (folder / "notes.txt").write_text("later")  # people may continue to work in it
    assert (desk.look(), desk.look(), desk.take_in()) == (0, 0, [])
    (folder / "notes.txt").unlink()
    assert content(folder) == before


def test_an_id_is_never_another_match_that_its_folder_holds_now(desk, drop):
    folder = drop()
    desk.look(), desk.look()
    (taken,) = desk.take_in()
    before = content(Path(desk.store.url))
    text = (folder / "match.yaml").read_text()
    (folder / "match.yaml").write_text(text.replace(taken.match_id, "other"))
    shutil.copy(folder / "detections" / "cam01.npz", folder / "detections" / "cam00.npz")
    for opening in (open_match, open_for_review):
        with pytest.raises(InputError, match=f"expected {taken.match_id}, .* found other"):
            opening(desk.store, taken.match_id)
    assert open_stored(desk.store, taken.match_id).match_id == taken.match_id
    assert content(Path(desk.store.url)) == before
    assert find_match(desk.store, str(folder)).match_id == "other"


@pytest.mark.parametrize("is_mount_point", [False, True])
def test_a_project_whose_disk_is_away_is_not_made_anew(desk, drop, tmp_path, is_mount_point):
    drop()
    project = Path(desk.store.url).rename(tmp_path / "away").with_name("project")
    if is_mount_point:
        project.mkdir()
    plan = ServePlan(project=desk.store.url, inbox=desk.inbox, state=desk.state.folder, prefect="")
    dispatcher = AlertDispatcher(plan.state_folder, ())
    dispatcher.hold([Alert("watch_stalled", "watch_stalled", "late")], source="steps")
    hold = watching._hold_alerts(plan, Overview(desk.store), dispatcher, Liveness(plan))
    for step in (
        hold,
        lambda: Liveness(plan).look(0.0, 0.0),
        lambda: deployed.ingest.fn(plan.model_dump(mode="json")),
        lambda: watching.watch(plan),
        lambda: watching._look_at_inbox(plan),
        lambda: recover(plan),
    ):
        with pytest.raises((InputError, FileNotFoundError)):
            step()
        assert project.exists() == is_mount_point
        assert not [*project.rglob("*")]


def test_a_growing_match_waits_until_nothing_has_changed(desk, drop, clock):
    folder = drop()
    file = folder / "detections" / "cam01.npz"
    whole = file.read_bytes()
    for size in (10, 100, len(whole)):
        clock.now += 10.0
        file.write_bytes(whole[:size])
        assert (desk.look(), desk.known()["small"][0]) == (0, "arriving")
    # It was whole at 1030 s: the ten seconds count from then, regardless of earlier waiting.
    clock.now = 1039.9
    assert (desk.look(quiet=10.0), desk.take_in(quiet=10.0)) == (0, [])
    clock.now = 1040.0
    assert (desk.look(quiet=3600.0), desk.look(quiet=10.0)) == (0, 1)
    clock.now = 3.0  # the clock restarts at a reboot: it waits the settle time again
    assert desk.look(quiet=10.0) == 0
    clock.now = 13.0
    assert [each.state for each in desk.take_in(quiet=10.0)] == ["taken"]


def test_a_cut_off_match_is_refused_and_taken_when_mended(desk, drop):
    folder = drop()
    file = folder / "detections" / "cam01.npz"
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    desk.look()
    (refused,) = desk.take_in()
    assert refused.state == "refused"
    assert "cam01.npz" in refused.reason
    assert (desk.look(), desk.look(), desk.store.matches()) == (0, 0, ())
    file.write_bytes(whole)
    assert (desk.look(), desk.look()) == (0, 1)
    assert [each.state for each in desk.take_in()] == ["taken"]


def test_a_list_of_sums_holds_a_stalled_copy_back(desk, drop):
    folder = drop()
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    lines = [
        f"{hashlib.sha256(file.read_bytes()).hexdigest()}  ./{file.relative_to(folder)}"
        for file in files
    ]
    (folder / "SHA256SUMS").write_text("\n".join(lines) + "\n")
    description = folder / "match.yaml"
    description.rename(folder / "match.yml")
    desk.look()
    desk.take_in()
    assert desk.known()["small"] == ("incomplete", "match.yaml is not there")
    (folder / "match.yml").rename(description)
    late = folder / "annotations" / "static_calibration" / "cam02.json"
    clicks = late.read_bytes()
    late.unlink()  # without the list, a match of which a camera is yet to be clicked
    desk.look()
    (incomplete,) = desk.take_in()
    assert incomplete.state == "incomplete"
    assert "cam02.json of SHA256SUMS is not there" in incomplete.reason
    late.write_bytes(clicks + b" ")
    desk.look()
    assert "is not as SHA256SUMS says" in desk.take_in()[0].reason
    late.write_bytes(clicks)
    desk.look()
    assert [each.state for each in desk.take_in()] == ["taken"]


@pytest.mark.parametrize("line", ["../x", "/etc/passwd", "a/../../x"])
def test_a_list_of_sums_names_nothing_outside(drop, line):
    folder = drop()
    (folder / "SHA256SUMS").write_text(f"{'0' * 64}  {line}\n")
    with pytest.raises(RefusalError, match="inside the match folder"):
        missing_of(folder)
    (folder / "SHA256SUMS").write_text("not a sum\n")
    with pytest.raises(RefusalError, match="line 1"):
        missing_of(folder)


def test_a_second_copy_is_refused_with_the_name_of_the_first(desk, drop):
    drop("first")
    drop("second")
    desk.look()
    desk.take_in()
    known = desk.known()
    assert (known["first"][0], known["second"][0]) == ("taken", "refused")
    assert "tiny-0-0.2s-3cameras-2players, registered from" in known["second"][1]
    assert len(desk.begun) == 1
    # One that moves to another queue is known; it asks for its run, which is that of before.
    (desk.inbox / "urgent").mkdir()
    shutil.move(desk.inbox / "first", desk.inbox / "urgent" / "first")
    shutil.rmtree(desk.inbox / "second")
    desk.look()
    desk.take_in()
    assert desk.known()["urgent/first"][0] == "taken"
    assert set(desk.begun) == {
        ("tiny-0-0.2s-3cameras-2players", "normal"),
        ("tiny-0-0.2s-3cameras-2players", "urgent"),
    }


def take_in_and_die(folder, poisoned):
    from flows.service import inbox

    register = inbox.register

    def register_or_die(store, match, **options):
        if match.name == poisoned:
            os._exit(137)
        return register(store, match, **options)

    inbox.register = register_or_die
    Desk(folder).take_in()


def die(desk, poisoned="aaa"):
    process = get_context("fork").Process(
        target=take_in_and_die, args=(desk.inbox.parent, poisoned)
    )
    process.start()
    process.join(120)
    return process.exitcode


def test_a_match_that_ends_the_process_stops_no_other_and_is_refused(desk, drop):
    drop("aaa")
    folder = drop("bbb")
    text = (folder / "match.yaml").read_text()
    (folder / "match.yaml").write_text(text.replace("tiny-0-0.2s", "other"))
    pitch = folder / "pitch.json"
    pitch.write_text(pitch.read_text() + " ")
    desk.look()
    first = watch_once(desk.state, desk.inbox, 0.0)
    assert (die(desk), desk.known()["aaa"]) == (137, ("arriving", "being taken in"))
    assert desk.store.matches() == (), "it was the first"
    again = watch_once(desk.state, desk.inbox, 0.0)
    assert len(again) == 2
    assert again != first, "asked for once more, it is another run"
    assert "died 1 time" in desk.known()["aaa"][1]
    assert die(desk) == 137
    assert desk.store.matches() == ("other-3cameras-2players",), "others come first"
    decided = desk.take_in()
    assert [(each.name, each.state) for each in decided] == [("aaa", "refused")]
    assert "died 2 times" in decided[0].reason
    assert "out of memory?" in decided[0].reason
    assert (desk.look(), desk.take_in()) == (0, [])
    os.link(desk.inbox / "aaa" / "match.yaml", desk.inbox / ".linked")  # as a draft of it does
    assert (desk.look(), desk.take_in()) == (0, [])
    (desk.inbox / "aaa" / "notes.txt").write_text("smaller now")
    desk.look()
    assert [each.state for each in desk.take_in()] == ["taken"]


def test_priorities_are_folders_unless_these_are_matches(desk, drop):
    drop("background")  # holds a match.yaml
    drop("urgent/b")
    drop("a")
    (desk.inbox / ".partial").mkdir()
    found = [(each.name, each.priority) for each in entries(desk.inbox)]
    assert found == [("urgent/b", "urgent"), ("a", "normal"), ("background", "normal")]


def test_unclicked_cameras_are_said_and_no_run_is_begun(desk, drop):
    folder = drop()
    (folder / "annotations" / "static_calibration" / "cam02.json").unlink()
    desk.look()
    (taken,) = desk.take_in()
    assert (taken.state, taken.flow_run) == ("taken", None)
    assert "cam02" in taken.reason
    assert (desk.store.matches(), desk.begun) == ((taken.match_id,), [])


def link_to_itself(folder):
    outside = shutil.move(folder, folder.parent.parent / "outside")
    folder.symlink_to(outside)


def bind_socket(folder):
    with contextlib.chdir(folder):  # a socket's path has to be short
        socket.socket(socket.AF_UNIX).bind("s")


def become_file(folder):
    shutil.rmtree(folder)
    folder.write_bytes(b"PK\x03\x04")


def name_pitch_outside(folder):
    text = (folder / "match.yaml").read_text()
    (folder / "match.yaml").write_text(f"pitch: ../../../etc/passwd\n{text}")


def describe(text):
    return lambda folder: (folder / "match.yaml").write_text(text)


EVIL_ID = "match_id: ../../evil\nfps: 25\ncameras: []\nclips: []"
HOSTILE = {
    "a link to a match": (link_to_itself, "it is a link"),
    "a link": (lambda at: (at / "reference/x").symlink_to("/etc/passwd"), "reference/x is a link"),
    "a link to a folder": (lambda at: (at / "videos").symlink_to("/"), "videos is a link"),
    "a pipe": (lambda at: os.mkfifo(at / "calibration.toml"), "neither a file nor a folder"),
    "a socket": (bind_socket, "neither a file nor a folder"),
    "a name with a line break": (lambda at: (at / "a\nb").touch(), "characters"),
    "a name that is no text": (lambda at: (at / os.fsdecode(b"\xff\xfe")).touch(), "characters"),
    "a file": (become_file, "it is a file"),
    "a path out of it": (name_pitch_outside, "without .."),
    "an id that is a path": (describe(EVIL_ID), "match_id"),
    "code in it": (describe("!!python/object/apply:os.system ['touch /tmp/evil']"), "match.yaml"),
    "deep nesting": (describe("[" * 100_000), "match.yaml"),
}


def test_hostile_arrivals_are_refused_and_harm_no_other(desk, drop):
    for kind, (spoil, _) in HOSTILE.items():
        spoil(drop(kind))
    drop("good")
    desk.look()
    desk.take_in()
    known = desk.known()
    for kind, (_, reason) in HOSTILE.items():
        assert known[kind][0] == "refused", (kind, known[kind])
        assert reason in known[kind][1], kind
    assert known["good"][0] == "taken"
    assert desk.store.matches() == ("tiny-0-0.2s-3cameras-2players",)


def test_a_hostile_name_in_the_inbox_never_becomes_a_path(desk, drop):
    folder = drop("good")
    odd = os.fsdecode(b"\xff..\n") + "München" + "x" * 200
    folder.rename(folder.with_name(odd))
    desk.look()
    ((name, (state, _)),) = desk.known().items()
    assert (state, name) == ("refused", r"\udcff..\nMünchen" + "x" * 200)
    (file,) = (desk.state.folder / "arrivals").iterdir()
    assert len(file.name) == len("0123456789abcdef.json")


def test_what_is_taken_out_of_the_inbox_is_forgotten_unless_it_was_taken_in(desk, drop):
    drop("good")
    desk.look()
    desk.take_in()
    shutil.rmtree(drop("half") / "detections")
    desk.look()
    desk.take_in()
    assert set(desk.known()) == {"good", "half"}
    shutil.rmtree(desk.inbox / "half")
    shutil.rmtree(desk.inbox / "good")
    desk.look()
    assert set(desk.known()) == {"good"}


def test_another_match_in_a_folder_of_a_known_name_is_taken_in(desk, drop):
    folder, away = drop(), desk.inbox.with_name("away")
    desk.look()
    desk.take_in()
    folder.rename(away)
    desk.look()
    away.rename(folder)  # the disk of the inbox was away
    assert (desk.look(), desk.look(), desk.take_in()) == (0, 0, [])
    folder.rename(away)
    options = MatchOptions(duration=0.2, cameras=3, players=2, stills=False, video=False)
    simulate_match(SCENARIOS["tiny"], 1, folder, options)
    assert (desk.look(), desk.look()) == (0, 1)
    (taken,) = desk.take_in()
    assert (taken.state, len(desk.begun), len(desk.store.matches())) == ("taken", 2, 2)


def take_in_and_count(folder, queue, kill):
    desk = Desk(folder)
    if kill:

        def begin(match, arrival):
            os._exit(9)  # registered, and not reported yet

        take_in(desk.store, desk.state, desk.inbox, 0.0, begin)
    queue.put(len(desk.take_in()))


def test_two_at_once_and_one_killed_between_take_a_match_in_once(desk, drop, tmp_path):
    drop()
    desk.look()
    processes = get_context("fork")
    queue = processes.Queue()
    killed = processes.Process(target=take_in_and_count, args=[tmp_path, queue, True])
    killed.start()
    killed.join()
    assert killed.exitcode == 9
    both = [
        processes.Process(target=take_in_and_count, args=[tmp_path, queue, False]) for _ in "ab"
    ]
    for each in both:
        each.start()
    assert sorted(queue.get(timeout=60) for _ in both) == [0, 1]
    for each in both:
        each.join()
    assert desk.store.matches() == ("tiny-0-0.2s-3cameras-2players",)


def test_more_files_than_any_match_has_are_refused(drop, monkeypatch):
    folder = drop()
    fingerprint_of(folder)
    assert MOST_FILES > 1_000_000
    monkeypatch.setattr("flows.service.inbox.MOST_FILES", 3)
    with pytest.raises(RefusalError, match="more than 3 files"):
        fingerprint_of(folder)


def test_an_arrival_whose_disk_failed_once_is_taken_in_later(desk, drop, monkeypatch):
    drop("aaa")
    desk.look()

    def fail(*_, **__):
        raise OSError(5, "Input/output error", "match.yaml")

    with monkeypatch.context() as broken:
        broken.setattr("flows.service.inbox.register", fail)
        desk.take_in()
    assert desk.known()["aaa"] == ("incomplete", "match.yaml: Input/output error")
    desk.look()
    desk.take_in()
    assert desk.known()["aaa"][0] == "taken"
