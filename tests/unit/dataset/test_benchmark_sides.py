"""Both sides of a score by data set: what is stated around a folder, who counts, short clips."""

import numpy as np
import yaml

from flows.results.dataset import count, stated_rates
from worldpose.dataset.manifest import write_frame_rates
from worldpose.formats.joints_file import JointTracks, write_joints


def write_match(folder, kind):
    """Write match.yaml of 25 frames/s with one camera of a kind."""
    content = {
        "contract": 1,
        "match_id": "m",
        "fps": 25.0,
        "cameras": [{"id": "cam", "kind": kind, "width": 1920, "height": 1080}],
        "clips": [{"id": "clip", "first_frame": 0, "frame_count": 10}],
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "match.yaml").write_text(yaml.safe_dump(content))


def standing(frames, persons=1):
    """People 8 m apart with joints 10 cm apart."""
    rng = np.random.default_rng(3)
    joints = rng.uniform(-0.5, 0.5, (1, persons, 17, 3)) + [0.0, 0.0, 1.0]
    joints = joints + 8.0 * np.arange(persons)[None, :, None, None] * [1.0, 0.0, 0.0]
    return np.repeat(joints, frames, axis=0)


def test_the_rate_is_that_of_the_match_around_unless_the_folder_states_its_own(tmp_path):
    tracks = JointTracks(np.arange(10), np.arange(1), standing(10))
    write_joints(tmp_path / "reference" / "joints.npz", tracks)
    assert stated_rates(tmp_path / "reference") == {"clip": None}
    write_match(tmp_path, "static")
    assert stated_rates(tmp_path / "reference") == {"clip": 25.0}
    assert count([tmp_path / "reference"]).clips["clip"].seconds == 0.4
    assert stated_rates(tmp_path / "reference", 5.0) == {"clip": 5.0}
    write_frame_rates(tmp_path / "reference", {"clip": 50.0})
    assert stated_rates(tmp_path / "reference") == {"clip": 50.0}
