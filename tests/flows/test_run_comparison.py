"""Runs are compared, named and pinned; their units say where they come from."""

import json

import numpy as np
import pytest
from camera_builders import plain_camera
from command_line import TINY, invoke
from run_records import correction, match_spec, run_record

from data_contracts.match import Registration, SourceFile
from data_contracts.review import DeletedDetection, MovedPoint
from flows.results import comparison
from flows.results.comparison import BodiesOfBoth, SubjectChange, compare_runs, pair_people
from flows.review.verdicts import unit_origins
from flows.web.results import _name_as_after
from worldpose.errors import InputError
from worldpose.geometry.rigid import Rigid
from worldpose.store.store import Store


def record(figures):
    return run_record(figures=figures)


@pytest.fixture
def compared(monkeypatch):
    """Marks of all subjects by name, with people of B named as given."""

    def compare(before, after, names=None):
        monkeypatch.setattr(comparison, "paired_people", lambda *_: names or {})
        changes = compare_runs(None, record(before), record(after))
        return {f"{change.kind} {change.name}": change for change in changes}

    return compare


@pytest.mark.parametrize(
    ("before", "after", "mark"),
    [
        (0.100, 0.0985, "better"),  # 1.5 %, 1.5 mm
        (0.100, 0.1015, "worse"),
        (0.100, 0.0992, "unchanged"),  # 0.8 %
        (0.010, 0.0095, "unchanged"),  # 5 %, but half a millimetre of at least one
        (0.200, 0.20201, "worse"),  # 1.005 % of what it was, though less of what it is
        (0.010, 0.01101, "worse"),  # 10 %, and a hundredth more than a millimetre
    ],
)
def test_a_figure_must_change_by_a_part_and_by_what_matters(compared, before, after, mark):
    name = "expected_ground_error_median_m"
    found = compared(*({"static_calibration/cam01": {name: x}} for x in (before, after)))
    assert found["camera cam01"].mark == mark
    assert found["camera cam01"].figures[0].mark == mark


def test_better_and_worse_together_are_mixed(compared):
    one = {"residual_m.person1": 0.020, "reprojection_px.person1": 2.0, "jerk_m_s3.person1": 9.0}
    other = {"residual_m.person1": 0.018, "reprojection_px.person1": 2.2, "jerk_m_s3.person1": 1.0}
    found = compared({"body_fitting/clip": one}, {"body_fitting/clip": other})
    (person,) = found.values()
    assert (person.kind, person.name, person.mark) == ("player", "clip: person 1", "mixed")
    # Less jerk may be too much smoothing: it is not judged.
    assert len(person.figures) == 2


def test_people_are_compared_by_who_they_are(compared):
    before = {"body_fitting/clip": {"residual_m.person0": 0.010, "residual_m.person1": 0.030}}
    after = {"body_fitting/clip": {"residual_m.person0": 0.030, "residual_m.person7": 0.010}}
    names = {("clip", "person0"): "person1", ("clip", "person7"): "person0"}
    found = compared(before, after, names)
    assert [change.mark for change in found.values()] == ["unchanged", "unchanged"]
    names = {("clip", "person7"): "person7 of B"}
    found = compared(before, after, names)
    assert {name: change.mark for name, change in found.items()} == {
        "player clip: person 0": "worse",
        "player clip: person 1": "only in A",
        "player clip: person 7 of B": "only in B",
    }


def test_who_stands_where_somebody_stood_is_that_person():
    before = np.zeros((4, 2, 3, 3))
    before[:, 1, :, 0] = 5.0
    after = before[:, ::-1] + 0.1
    assert pair_people(before, after) == {0: 1, 1: 0}
    # Frames in which one is missing say nothing of them.
    after[0, 0] = np.nan
    assert pair_people(before, after) == {0: 1, 1: 0}
    # Beyond 1 m, or with another one nearer, it is another person.
    assert pair_people(before, after + 2.0) == {}
    assert pair_people(before, np.repeat(before[:, :1], 2, axis=1)) == {0: 0}
    assert pair_people(before[:, :0], after) == {}


def test_the_picture_in_which_somebody_moved_most_is_found():
    # Two metres in front of 1000 px: 2 cm are 10 px. The second person moves most, in frame 11.
    camera = plain_camera(1000.0, (500.0, 500.0), Rigid(np.eye(3), np.zeros(3)), (1000, 1000))
    before = np.zeros((3, 2, 17, 3))
    before[..., 2] = 2.0
    before[:, 1, :, 0] = 0.5
    after = before[:, ::-1].copy()
    after[1, 0, :, 1] += 0.02
    after[2, 1, :, 1] += 0.01

    def worst(away):
        names = map(np.array, ([10, 11, 12], [4, 7], [0, 1]))
        bodies = BodiesOfBoth("clip", *names, before + away, after + away)
        return comparison._worst(bodies, "cam01", {"cam01": camera}, {"cam01": camera})

    (picture,) = worst(0.0)
    assert (picture.camera, picture.frame, picture.person) == ("cam01", 11, 7)
    assert picture.moved_px == pytest.approx(10.0)
    assert worst(9.0) == []  # nobody in the image, nothing to look at


@pytest.fixture
def command(project_copy):
    """The command line in this process, on a project with one finished run."""

    def run(*arguments):
        answer = invoke(*arguments, "--project", project_copy)
        if answer.exception is not None and not isinstance(answer.exception, SystemExit):
            raise answer.exception
        return answer

    return run


def test_a_pinned_run_has_a_name_and_stays(command, project_copy):
    store = Store.open(project_copy)
    second = store.run(TINY).model_copy(update={"run_id": store.reserve_run(TINY)})
    store.finish_run(second)
    assert command("pin", f"{TINY}/0001", "paper", "--who", "Ada").exit_code == 0
    assert "run 0001 is pinned as paper" in command("status").stdout
    assert "run 0001 is pinned as paper" in command("status", TINY).stdout
    answer = command("diff", f"{TINY}/paper", f"{TINY}/0002", "--json")
    compared = json.loads(answer.stdout)["compared"]
    assert {each["kind"] for each in compared} == {"match", "clip", "camera", "player"}
    assert {each["mark"] for each in compared} == {"unchanged"}
    with pytest.raises(InputError, match="not pinned"):
        command("gc", "--forget", f"{TINY}/0001")
    assert "removed: nothing (0 B)" in command("gc", "--keep-last", "1", "--delete").stdout
    assert command("unpin", f"{TINY}/paper").exit_code == 0
    assert "removed: 1 x run forgotten (" in command("gc", "--keep-last", "1", "--delete").stdout
    assert store.runs(TINY) == ("0002",)


@pytest.mark.parametrize("name", ["0007", "latest", "a/b", ""])
def test_a_name_that_is_none_is_refused(command, name):
    with pytest.raises(InputError, match="name of"):
        command("pin", TINY, name, "--who", "Ada")


MADE_FROM = {
    "static_calibration/a": (),
    "static_calibration/b": (),
    "tracking/one": ("static_calibration/a", "static_calibration/b"),
    "tracking/two": ("static_calibration/a", "static_calibration/b"),
    "body_fitting/one": ("tracking/one",),
    "body_fitting/two": ("tracking/two",),
}


def moved(camera):
    return correction(MovedPoint(camera=camera, marking="corner_left_near", xy=(1.0, 1.0)))


def test_a_correction_marks_what_it_corrects_alone():
    origins = unit_origins(MADE_FROM, [moved("a")], ())
    assert origins == dict.fromkeys(MADE_FROM, "automatic") | {"static_calibration/a": "corrected"}
    # Of a detection, whatever found it.
    out = correction(DeletedDetection(camera="a", frame=3, detection=0))
    given = dict.fromkeys(("ingest/a", "ingest/ab", "detection/ab.one"), ())
    for found, marked in (
        (given, "ingest/a"),
        ({**given, "detection/a.one": ()}, "detection/a.one"),
    ):
        origins = unit_origins(found, [out], ())
        assert [unit for unit in found if origins[unit] == "corrected"] == [marked]


def test_a_refusal_reaches_all_that_is_made_from_it():
    origins = unit_origins(MADE_FROM, [], ["tracking/one"])
    refused = {unit for unit, origin in origins.items() if origin == "rejected"}
    assert refused == {"tracking/one", "body_fitting/one"}
    everything = unit_origins(MADE_FROM, [moved("a")], ["static_calibration/a"])
    assert {u for u, o in everything.items() if o == "automatic"} == {"static_calibration/b"}


def test_a_folders_digest_is_of_the_names_and_contents_below_it():
    def digest(folder="videos/cam00", **contents):
        listed = [
            SourceFile(path=path, size=1, modified_ns=1, sha256=digit * 64)
            for path, digit in (
                (f"videos/{n.replace('_', '/')}.png", d) for n, d in contents.items()
            )
        ]
        about = {"spec": match_spec(["cam00"]), "folder": "m", "identity": "b" * 64}
        return Registration(**about, files=listed).digest_of(folder)

    first = {"cam00_1": "1", "cam00_2": "2", "cam01_1": "1"}
    assert digest("videos/cam00/1.png", **first) == "1" * 64
    assert digest("videos/cam0", **first) is None
    others = ({"cam00_1": "1", "cam00_3": "2"}, {"cam00_1": "1", "cam00_2": "3"}, {"cam00_1": "1"})
    assert len({digest(**each) for each in (first, *others)}) == 4
    assert digest("videos/cam01", cam01_1="1", cam01_2="2") == digest(**first)


def test_the_page_of_a_run_names_its_people_by_the_ids_of_that_run():
    paired = {("person1", "person3"): "person5", ("person1", "person5"): "person5 of B"}
    rows = (
        ("player", "person1: person 5", "worse", "person1: person 3"),
        ("player", "person1: person 5 of B", "only in B", "person1: person 5"),
        ("player", "person1: person 3", "only in A", "person1: person 3 of run 0002"),
        ("player", "person1: person 1", "better", "person1: person 1"),
        ("camera", "person1: person 3", "only in A", "person1: person 3"),
    )
    named = _name_as_after([SubjectChange(*row[:3], ()) for row in rows], paired, "0002")
    assert [each.name for each in named] == [name for *_, name in rows]
