"""People of the second world: bones, feet, trajectories, recordings."""

import numpy as np
import pytest

from worldpose.errors import InputError
from worldpose.simulation.foreign.recordings import read_recordings


@pytest.mark.parametrize("content", ["nothing", "pickle", "names", "shape"])
def test_recordings_that_cannot_be_used_are_refused(tmp_path, content):
    folder = tmp_path / "recordings"
    if content != "nothing":
        folder.mkdir()
    if content == "pickle":
        np.savez(folder / "a.npz", xy=np.array([{}], dtype=object))
    if content == "names":
        joints = np.zeros((20, 2, 3))
        np.savez(folder / "a.npz", joints=joints, joint_names=np.array(["a", "b"]), fps=30.0)
    if content == "shape":
        np.savez(folder / "a.npz", xy=np.zeros((20, 3, 2)), time=np.arange(19.0))
    with pytest.raises(InputError):
        read_recordings(folder)
