import numpy as np
import pytest
import yaml

from worldpose.errors import InputError
from worldpose.formats.keypoint_files import write_keypoint_arrays
from worldpose.ingest.footage import UnitFrames, read_unit, unit_frames
from worldpose.ingest.match_folder import read_match


def test_units_lie_on_the_matchs_clock(spec):
    # Clips span 5 to 8 and 9 to 11; cam2 runs 10 frames ahead; goal's own video starts at 0.
    clips = ((5, 3), (9, 2))
    assert unit_frames(spec, "cam1") == UnitFrames(first=5, count=6, offset=0, ranges=clips)
    assert unit_frames(spec, "cam2") == UnitFrames(first=5, count=6, offset=10, ranges=clips)
    assert unit_frames(spec, "goal") == UnitFrames(first=5, count=3, offset=-5, ranges=((5, 3),))


def test_clips_that_touch_or_overlap_are_one_range(spec):
    clip = spec.clips[0].model_copy(update={"broadcast": None})
    places = {"c": (40, 5), "a": (0, 10), "b": (4, 3), "d": (10, 2), "e": (43, 9)}
    clips = tuple(
        clip.model_copy(update={"id": name, "first_frame": first, "frame_count": count})
        for name, (first, count) in places.items()
    )
    frames = unit_frames(spec.model_copy(update={"clips": clips}), "cam1")
    assert frames.ranges == ((0, 12), (40, 12))
    assert (frames.first, frames.count) == (0, 52)


def test_a_static_camera_covers_all_clips_in_match_frames(match_folder, make_people):
    people, calibration = read_unit(read_match(match_folder), "cam1")
    np.testing.assert_array_equal(people.frame, [5, 6, 7, 9, 10])
    there = [0, 1, 2, 4, 5]  # nothing is kept of frame 8, which no clip has
    np.testing.assert_array_equal(people.keypoints, make_people(5, 6, seed=1).keypoints[there])
    assert calibration is not None
    assert calibration.id == "cam1"


def test_an_offset_is_taken_off_the_cameras_own_frames(match_folder, make_people):
    # Camera frame = match frame + 10: its frames 15 to 20 are the match's 5 to 10.
    people, _ = read_unit(read_match(match_folder), "cam2")
    np.testing.assert_array_equal(people.frame, [5, 6, 7, 9, 10])
    there = [0, 1, 2, 4, 5]
    np.testing.assert_array_equal(people.keypoints, make_people(15, 6, seed=2).keypoints[there])


def test_a_broadcast_camera_covers_its_clip(match_folder, make_people):
    # Clip goal starts at match frame 5; its video starts at frame 0.
    people, calibration = read_unit(read_match(match_folder), "goal")
    np.testing.assert_array_equal(people.frame, [5, 6, 7])
    np.testing.assert_array_equal(people.keypoints, make_people(0, 3, seed=3).keypoints)
    assert calibration is None


def test_a_broken_broadcast_offset_is_taken_to_the_nearest_frame(match_folder, make_people):
    path = match_folder / "match.yaml"
    content = yaml.safe_load(path.read_text())
    content["clips"][0]["broadcast_offset_frames"] = 0.6
    path.write_text(yaml.safe_dump(content))
    people, _ = read_unit(read_match(match_folder), "goal")
    np.testing.assert_array_equal(people.keypoints[0], make_people(0, 3, seed=3).keypoints[1])
    assert np.all(np.isnan(people.keypoints[2]))


def test_a_wrong_offset_is_noticed(match_folder, make_people):
    write_keypoint_arrays(match_folder / "detections" / "cam2.npz", make_people(5, 6))
    with pytest.raises(InputError, match="people in frames 15 to 17, 19 to 20"):
        read_unit(read_match(match_folder), "cam2")


@pytest.mark.parametrize("unit_id", ["cam9", "main", "corner"])
def test_a_unit_without_detections_is_refused(match_folder, unit_id):
    with pytest.raises(InputError, match="those of cam1, cam2, goal"):
        read_unit(read_match(match_folder), unit_id)
