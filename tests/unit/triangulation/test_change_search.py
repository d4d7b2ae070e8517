"""How far knocks of cameras are taken back, one camera at a time, while people are tracked."""

from types import SimpleNamespace

import numpy as np
import pytest

from data_contracts.triangulation import CameraChange
from worldpose.triangulation import change_search
from worldpose.triangulation.camera_changes import MeasuredChange

FIRST = 100
LOST = MeasuredChange(1, "view", 20, np.array([40.0, 0.0, 0.0, 0.0, 0.0]))
LATE = MeasuredChange(0, "clock", 30, np.array([0.0, 0.0, 0.0, 0.0, 9.0]))
KNOCK = CameraChange(
    camera="b",
    kind="view",
    frame=FIRST + 20,
    first_frame=FIRST,
    frame_count=41,
    shift_px=(40.0, 0.0),
    std=None,
)
TURNED = KNOCK.model_copy(update={"shift_px": (44.0, 1.0)})
GONE = KNOCK.model_copy(update={"shift_px": (9.0, 1.0)})
SUNK = KNOCK.model_copy(update={"frame": None, "shift_px": (80.0 / 1.5, 0.0)})
SUNK_MORE = SUNK.model_copy(update={"shift_px": (58.0, 2.0)})
SUNK_LITTLE = SUNK.model_copy(update={"shift_px": (13.0, 0.0)})
VAGUE = TURNED.model_copy(update={"std": 20.0})
ZOOMED = KNOCK.model_copy(update={"zoom": 0.2})


@pytest.mark.parametrize(
    ("refined", "kept"),
    [
        ([TURNED], (TURNED,)),
        ([GONE, SUNK_MORE], (SUNK_MORE,)),
        ([GONE, SUNK_LITTLE], ()),
        ([ZOOMED], ()),
        ([VAGUE], ()),
    ],
    ids=["knocked", "sunk", "sunk little", "by chance", "vague"],
)
def test_what_the_people_show_again_of_a_lost_view_decides(monkeypatch, refined, kept):
    opened, left = list[tuple[CameraChange, ...]](), list(refined)
    frame = np.arange(FIRST, FIRST + 41)

    def open_detections(taken_back):
        opened.append(known := tuple(taken_back))
        return SimpleNamespace(frame=frame, known=known, assign_people=lambda _: known)

    def refine_change(_cameras, people, _fps, camera, known):
        assert camera == 1
        assert people[-1] == known  # tracked with it taken back
        return left.pop(0)

    def find_lost_views(_cameras, detections, *_):
        is_sinking = any(each.frame is None for each in detections.known)
        return [LATE] if is_sinking else [LOST, LATE]  # a known knock may be found again

    monkeypatch.setattr(change_search, "refine_change", refine_change)
    monkeypatch.setattr(change_search, "find_lost_views", find_lost_views)
    monkeypatch.setattr(change_search, "_trace_clocks", lambda *arguments: arguments[-1])

    def track(detections):
        return SimpleNamespace(detection_index=None, joints=detections.known)

    found = change_search.follow_changes(("a", "b", "c"), None, 25.0, open_detections, track)
    assert not left
    assert tuple(each for each in found.changes if each.kind == "view") == kept
    assert found.detections.known == kept  # what is written is corrected by what is told
    if not kept:
        assert found.tracks.joints == ()
    if len(refined) > 1:  # tracked with the slow one taken back before it is refined
        assert opened[2] == (SUNK,)
    if kept:  # a clock is told alone
        assert [each.camera for each in found.changes if each.kind == "clock"] == ["a"]


def test_clocks_that_were_measured_while_people_were_tracked_are_told_once():
    told = KNOCK.model_copy(update={"kind": "clock", "shift_px": (0.0, 0.0), "late_frames": 6.0})
    again, other = (
        MeasuredChange(camera, "clock", 35, np.array([0.0, 0.0, 0.0, 0.0, 2.0]))
        for camera in (1, 0)
    )
    frame, names = np.arange(FIRST, FIRST + 41), ("a", "b", "c")
    stay, new = change_search.add_changes([told], [again, other, LOST], names, None, frame, 10.0)
    assert stay == [told]
    assert [(each.camera, each.kind) for each in new] == [("a", "clock"), ("b", "view")]
