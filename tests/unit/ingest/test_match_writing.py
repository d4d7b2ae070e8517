import pytest

from data_contracts.match import CameraSpec, ClipSpec, MatchSpec
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
    (tmp_path / "usual").mkdir()
    assert (tmp_path / "m").stat().st_mode == (tmp_path / "usual").stat().st_mode
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


def test_a_failure_on_the_way_leaves_nothing(tmp_path, one, make_people):
    def fail(folder):
        raise RuntimeError("disk full")

    with pytest.raises(RuntimeError, match="disk full"):
        write_match(
            tmp_path / "m", one, calibrations={}, observations={"cam1": make_people()}, further=fail
        )
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
