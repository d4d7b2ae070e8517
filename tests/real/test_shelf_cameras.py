"""Adjustment of Shelf's cameras where one is removed; skipped where the data is absent.

WORLDPOSE_TEST_DATA names a folder with `shelf_dev`, as `test_shelf.py` says.
"""

import numpy as np
from common import load_module, run_in_process
from real_data import GIVEN, needs
from shelf import open_keys, score, write_case

from worldpose.store.store import Store

SHELF = GIVEN / "shelf_dev"
CAMERAS = ("cam0", "cam2", "cam3", "cam4")
FRAMES = range(421, 481)

pytestmark = needs("shelf_dev")


def test_adjustment_of_four_given_cameras_harms_no_joints(tmp_path):
    # With a prior of 5 % of the distance and no gain asked for, adjustment raises the mean error
    # from 51.9 to 55.1 mm here and lowers PCP3D from 98.7 to 98.3.
    scorer, truth = load_module(SHELF / "pcp.py"), np.load(SHELF / "gt.npz")
    folder = write_case(SHELF / "import", CAMERAS, FRAMES, tmp_path)
    store = Store.create(tmp_path / "project")
    match, (keys,) = run_in_process(store, folder, "retriangulation", 1, {})
    scores = score(scorer, truth, open_keys(store, match, keys), FRAMES)
    before, after = scores["T"], scores["R"]
    assert before[0] >= 95.0
    assert after[0] >= before[0] - 0.3
    assert after[1] <= before[1] + 1.0
