"""Camera data in a match folder: what is written, told and refused."""

import pytest

from worldpose.errors import InputError, UsageError
from worldpose.ingest.camera_data import import_camera_data, read_given_camera
from worldpose.ingest.match_folder import read_match


@pytest.fixture
def folder(tmp_path):
    match = tmp_path / "m"
    (match / "broadcast").mkdir(parents=True)
    for clip in ("goal", "shot"):
        (match / "broadcast" / f"{clip}.mp4").write_bytes(b"not opened here")
    (match / "match.yaml").write_text(
        "contract: 1\nmatch_id: m\nfps: 25\n"
        "cameras: [{id: main, width: 1920, height: 1080, kind: broadcast}]\n"
        "clips:\n"
        "  - {id: goal, first_frame: 0, frame_count: 3, broadcast: main,"
        " broadcast_offset_frames: 10}\n"
        "  - {id: shot, first_frame: 9, frame_count: 3, broadcast: main}\n"
    )
    return match


def test_camera_data_are_written_for_the_frames_of_the_video(folder, tmp_path):
    table = tmp_path / "viz.csv"
    table.write_text("pan,tilt,fov,x_mm,y,z\n1,-9,90,500,-70,15\n2,-9,90,500,-70,15\n")
    target, data = import_camera_data(table, folder, "goal", first=11)
    assert data.frame.tolist() == [11, 12]
    assert "1 of 3 images of goal have no camera data" in data.notes
    assert target == folder / "estimates" / "goal.csv"
    match = read_match(folder)
    assert match.camera_data == {"goal": target}
    assert match.calibrated_views == ("goal",)
    again = read_given_camera(match, "goal", target)
    assert again.frame.tolist() == [11, 12]
    assert again.values[0, :7].tolist() == [1, -9, pytest.approx(float("nan"), nan_ok=True)] + [
        *(0.5, -70, 15, 960)
    ]
    with pytest.raises(UsageError, match="Remove it first"):
        import_camera_data(table, folder, "goal")


@pytest.mark.parametrize(
    ("view", "words"), [("goal", "frames 10 to 12 .*--first-frame"), (None, "Name one"), ("x", "x")]
)
def test_data_of_other_frames_or_clips_are_refused(folder, tmp_path, view, words):
    table = tmp_path / "viz.csv"
    table.write_text("pan,tilt\n1,-9\n2,-9\n")
    with pytest.raises(InputError, match=words):
        import_camera_data(table, folder, view)
    assert not (folder / "estimates").exists()
