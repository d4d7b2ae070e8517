import os

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from data_contracts.keypoints import KeypointDetections
from data_contracts.match import CameraSpec, ClipSpec, MatchSpec, PlayerSpec
from data_contracts.pitch import PitchSpec
from worldpose.errors import InputError
from worldpose.formats.keypoint_files import read_observations
from worldpose.ingest.match_folder import read_match
from worldpose.ingest.writing import write_match, write_offsets


@pytest.fixture
def one():
    return MatchSpec(
        match_id="one",
        fps=25.0,
        cameras=(CameraSpec(id="cam1", width=1920, height=1080),),
        clips=(ClipSpec(id="clip", frame_count=3),),
    )


def files(folder):
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_a_written_match_is_read_as_it_was(tmp_path, one, make_people, make_camera):
    people = make_people()
    write_match(
        tmp_path / "m",
        one,
        calibrations={"cam1": make_camera()},
        observations={"cam1": people},
        pitch=PitchSpec(length=104.2),
    )
    match = read_match(tmp_path / "m")
    assert match.spec == one
    assert match.pitch == PitchSpec(length=104.2)
    back = read_observations(match.detections["cam1"])
    assert {name: array.tobytes() for name, array in back.arrays().items()} == {
        name: array.tobytes() for name, array in people.arrays().items()
    }
    assert sorted(files(tmp_path / "m")) == [
        "calibration.toml",
        "detections/cam1.npz",
        "match.yaml",
        "pitch.json",
    ]


def test_match_yaml_reads_from_the_match_to_its_clips(tmp_path, one, make_people):
    write_match(tmp_path / "m", one, calibrations={}, observations={"cam1": make_people()})
    content = yaml.safe_load((tmp_path / "m" / "match.yaml").read_text())
    assert list(content) == ["contract", "match_id", "fps", "cameras", "clips"]
    assert list(content["cameras"][0])[:4] == ["id", "kind", "width", "height"]


def test_the_same_match_is_the_same_bytes(tmp_path, one, make_people, make_camera):
    for name in ("a", "b"):
        write_match(
            tmp_path / name,
            one,
            calibrations={"cam1": make_camera()},
            observations={"cam1": make_people()},
        )
    assert files(tmp_path / "a") == files(tmp_path / "b")


def test_references_go_into_the_match_before_it_appears(tmp_path, one, make_people):
    def write_truth(folder):
        assert not (tmp_path / "m").exists()
        (folder / "reference").mkdir()
        (folder / "reference" / "joints.npz").write_bytes(b"truth")

    write_match(
        tmp_path / "m",
        one,
        calibrations={},
        observations={"cam1": make_people()},
        further=write_truth,
    )
    assert (tmp_path / "m" / "reference" / "joints.npz").read_bytes() == b"truth"


def test_an_empty_folder_is_filled(tmp_path, one, make_people):
    (tmp_path / "m").mkdir()
    write_match(tmp_path / "m", one, calibrations={}, observations={"cam1": make_people()})
    assert (tmp_path / "m" / "match.yaml").exists()


def test_parents_are_made_and_the_folder_has_the_usual_rights(tmp_path, one, make_people):
    folder = tmp_path / "a" / "b" / "m"
    write_match(folder, one, calibrations={}, observations={"cam1": make_people()})
    (tmp_path / "usual").mkdir()
    assert folder.stat().st_mode == (tmp_path / "usual").stat().st_mode


def test_a_place_below_a_file_is_refused(tmp_path, one, make_people):
    (tmp_path / "file").write_bytes(b"precious")
    with pytest.raises(InputError, match="a place where a folder can be made"):
        write_match(
            tmp_path / "file" / "m", one, calibrations={}, observations={"cam1": make_people()}
        )


@pytest.mark.parametrize("kind", ["folder", "file", "link"])
def test_what_is_there_is_left_as_it_was(tmp_path, one, make_people, kind):
    target = tmp_path / "m"
    if kind == "folder":
        target.mkdir()
        (target / "mine").write_bytes(b"precious")
    elif kind == "file":
        target.write_bytes(b"precious")
    else:
        (tmp_path / "elsewhere").mkdir()
        target.symlink_to(tmp_path / "elsewhere")
    before = sorted(tmp_path.rglob("*")), files(tmp_path)
    with pytest.raises(InputError, match="left as it was"):
        write_match(target, one, calibrations={}, observations={"cam1": make_people()})
    assert (sorted(tmp_path.rglob("*")), files(tmp_path)) == before


def test_a_folder_filled_meanwhile_is_left_as_it_was(tmp_path, one, make_people):
    def interfere(folder):
        (tmp_path / "m").mkdir()
        (tmp_path / "m" / "mine").write_bytes(b"precious")

    with pytest.raises(InputError, match="left as it was"):
        write_match(
            tmp_path / "m",
            one,
            calibrations={},
            observations={"cam1": make_people()},
            further=interfere,
        )
    assert files(tmp_path) == {"m/mine": b"precious"}


def test_a_failure_on_the_way_leaves_nothing(tmp_path, one, make_people):
    def fail(folder):
        raise RuntimeError("disk full")

    with pytest.raises(RuntimeError, match="disk full"):
        write_match(
            tmp_path / "m",
            one,
            calibrations={},
            observations={"cam1": make_people()},
            further=fail,
        )
    assert list(tmp_path.iterdir()) == []


def test_a_match_that_could_not_be_read_is_not_written(tmp_path, one):
    with pytest.raises(InputError, match="missing camera cam1"):
        write_match(tmp_path / "m", one, calibrations={}, observations={})
    assert list(tmp_path.iterdir()) == []


def test_people_that_could_not_be_read_are_not_written(tmp_path, one, make_people):
    people = make_people()
    people.confidence[1, 1, 5] = np.nan
    with pytest.raises(InputError, match="finite exactly where confidence is"):
        write_match(tmp_path / "m", one, calibrations={}, observations={"cam1": people})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["cam9", "../cam1"])
def test_data_of_unknown_cameras_are_refused(tmp_path, one, make_people, make_camera, name):
    people = {"cam1": make_people()}
    with pytest.raises(InputError, match="data of its cameras and clips: cam1, clip"):
        write_match(
            tmp_path / "m", one, calibrations={}, observations={**people, name: people["cam1"]}
        )
    with pytest.raises(InputError, match="data of its cameras and clips: cam1, clip"):
        write_match(tmp_path / "m", one, calibrations={name: make_camera()}, observations=people)


def test_a_pitch_goes_where_match_yaml_says_and_nowhere_else(tmp_path, one, make_people):
    def write(pitch):
        spec = one.model_copy(update={"pitch": pitch})
        write_match(
            tmp_path / "m",
            spec,
            calibrations={},
            observations={"cam1": make_people()},
            pitch=PitchSpec(width=64.0),
        )

    with pytest.raises(InputError, match="inside the match folder"):
        write("../pitch.json")
    with pytest.raises(InputError, match="a pitch is given"):
        write("none")
    assert list(tmp_path.iterdir()) == []
    write("survey/pitch.json")
    assert read_match(tmp_path / "m").pitch == PitchSpec(width=64.0)


def test_everything_is_synced_before_the_folder_appears(tmp_path, one, make_people, monkeypatch):
    synced = []
    fsync = os.fsync

    def watch(descriptor):
        synced.append((os.fstat(descriptor).st_ino, (tmp_path / "m").exists()))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", watch)
    write_match(tmp_path / "m", one, calibrations={}, observations={"cam1": make_people()})
    before = {inode for inode, there in synced if not there}
    content = [tmp_path / "m", *(tmp_path / "m").rglob("*")]
    assert {path.stat().st_ino for path in content} <= before
    assert synced[-1] == (tmp_path.stat().st_ino, True)


NAMES = st.from_regex(r"\A[A-Za-z0-9][A-Za-z0-9._-]{0,8}\Z")
TEXT = st.text(st.characters(exclude_categories=["Cs", "Cc"]), max_size=8)


@settings(max_examples=60)
@given(
    match_id=NAMES,
    cameras=st.lists(NAMES, min_size=1, max_size=3, unique=True),
    fps=st.floats(1, 1e3),
    offset=st.integers(-(10**6), 10**6),
    frames=st.integers(1, 200_000),
    person=TEXT,
)
def test_any_match_yaml_comes_back(
    tmp_path_factory, match_id, cameras, fps, offset, frames, person
):
    spec = MatchSpec(
        match_id=match_id,
        fps=fps,
        cameras=tuple(
            CameraSpec(id=name, width=10, height=10, offset_frames=offset) for name in cameras
        ),
        clips=(ClipSpec(id="the-clip-of-it", first_frame=offset, frame_count=frames),),
        roster=(PlayerSpec(id="p", name=person),),
    )
    folder = tmp_path_factory.mktemp("any") / "m"
    nobody = _nobody()
    write_match(folder, spec, calibrations={}, observations=dict.fromkeys(cameras, nobody))
    assert read_match(folder).spec == spec


def _nobody():
    empty = np.empty
    return KeypointDetections(
        frame=empty(0, np.int64),
        keypoints=empty((0, 0, 17, 2), np.float32),
        confidence=empty((0, 0, 17), np.float32),
        boxes=empty((0, 0, 4), np.float32),
        score=empty((0, 0), np.float32),
    )


def test_clock_offsets_are_written_into_match_yaml_and_all_else_stays(tmp_path):
    file = tmp_path / "match.yaml"
    file.write_text(
        "match_id: m  # the final\n"
        "fps: 25\n"
        "cameras:\n"
        "  - {id: a, width: 64, height: 48, offset_frames: 3}   # late\n"
        "  - {id: b, width: 64, height: 48}\n"
        "  - id: c\n"
        "    width: 64   # small\n"
        "    height: 48\n"
        "  - {id: d, width: 64, height: 48, offset_frames: 1}\n"
        "clips:\n"
        "  - {id: clip, frame_count: 3}\n"
    )
    write_offsets(tmp_path, {"a": -12, "b": 2, "c": 7})
    assert file.read_text() == (
        "match_id: m  # the final\n"
        "fps: 25\n"
        "cameras:\n"
        "  - {id: a, width: 64, height: 48, offset_frames: -12}   # late\n"
        "  - {id: b, offset_frames: 2, width: 64, height: 48}\n"
        "  - id: c\n"
        "    offset_frames: 7\n"
        "    width: 64   # small\n"
        "    height: 48\n"
        "  - {id: d, width: 64, height: 48, offset_frames: 1}\n"
        "clips:\n"
        "  - {id: clip, frame_count: 3}\n"
    )
    with pytest.raises(InputError, match=r"match.yaml: expected the cameras z, found others"):
        write_offsets(tmp_path, {"z": 1})
    assert "offset_frames: 7" in file.read_text()
