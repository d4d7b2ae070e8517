import numpy as np
import pytest

from worldpose.ingest.footage import read_unit
from worldpose.ingest.match_folder import read_match
from worldpose.simulation.matches import MatchOptions, simulate_match
from worldpose.simulation.scenarios import SCENARIOS

SHORT = 0.4


def short(name, **changes):
    return SCENARIOS[name].model_copy(update={"duration": SHORT, **changes})


@pytest.mark.parametrize("name", SCENARIOS)
def test_every_scenario_makes_a_match(name, tmp_path):
    scenario = short(name)
    spec = simulate_match(
        *(scenario, 2, tmp_path / name),
        MatchOptions(duration=SHORT, cameras=4, stills=False, video=False),
    )
    read = read_match(tmp_path / name)
    assert read.spec == spec
    frames = round(SHORT * scenario.fps)
    for camera in spec.static_cameras:
        people, calibration = read_unit(read, camera.id)
        assert (calibration is not None) == (name == "hard")
        assert len(people.frame) == frames
        clicks = read.clicked[camera.id]
        assert len(clicks.points) + len(clicks.drawn) > 1
    assert len(read.spec.broadcast_views) == len(scenario.broadcast)
    for view in read.spec.broadcast_views:
        people, calibration = read_unit(read, view)
        assert calibration is None
        assert len(people.frame) == frames
        assert np.isfinite(people.score).sum(axis=1).mean() > 1.0
        camera = np.load(tmp_path / name / "reference" / "cameras" / f"{view}.npz")
        assert camera["K"].shape == camera["R"].shape == (frames, 3, 3)


def test_nothing_of_the_truth_is_where_the_factory_looks(tmp_path):
    simulate_match(short("hard"), 1, tmp_path / "m", MatchOptions(cameras=3, stills=False))
    for file in (tmp_path / "m" / "detections").iterdir():
        with np.load(file) as content:
            assert set(content) == {"frame", "keypoints", "confidence", "boxes", "score"}
    assert {camera.offset_frames for camera in read_match(tmp_path / "m").spec.cameras} == {0.0}
