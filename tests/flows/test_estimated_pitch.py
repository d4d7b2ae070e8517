"""Pitches that files give and that runs estimate."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from command_line import succeed, worldpose

from data_contracts.pitch import PitchSpec
from flows.results.run_cameras import estimated_pitch
from worldpose.pitch.template import PitchTemplate

GIVEN = PitchSpec(crown=0.2)
SPEC = SimpleNamespace(static_cameras=[])


class StoredRun(dict):
    """A run whose results have attributes alone."""

    record = SimpleNamespace(left_out={})

    def __init__(self, **attributes):
        super().__init__(
            {
                name.replace("__", "/"): SimpleNamespace(attrs=attrs)
                for name, attrs in attributes.items()
            }
        )


def test_a_clip_is_drawn_with_the_pitch_that_its_broadcast_camera_shows():
    corner = [52.6, 34.2, -0.15]
    found = {
        "length": 105.2,
        "width": 68.4,
        "crown": 0.15,
        "points": {"corner_right_far": corner},
        "std_m": [0.1, 0.1, 0.01],
    }
    run = StoredRun(broadcast_calibration__goal={"clip_id": "goal", "pitch": found})
    drawn = PitchTemplate.from_spec(estimated_pitch(run, GIVEN, SPEC, "goal"))
    np.testing.assert_allclose(drawn.surface, [0.15, 0.0])
    np.testing.assert_allclose(drawn.positions(["corner_right_far"])[0], corner)
    # No other view shows what this clip found.
    assert estimated_pitch(run, GIVEN, SPEC) == GIVEN
    assert estimated_pitch(StoredRun(), None, SPEC, "goal") is None


def test_static_cameras_draw_the_crown_and_the_end_fall_that_they_show():
    adjusted = {"surface": [-0.01, 0.25]}
    run = StoredRun(
        bundle_adjustment__cameras=adjusted,
        broadcast_calibration__clip={"clip_id": "clip", "pitch": None},
    )
    for clip in (None, "clip"):
        drawn = PitchTemplate.from_spec(estimated_pitch(run, GIVEN, SPEC, clip))
        expected = PitchTemplate.from_spec(GIVEN).with_surface([-0.01, 0.25])
        x, y = np.meshgrid(np.linspace(-52.5, 52.5, 5), np.linspace(-34.0, 34.0, 5))
        np.testing.assert_allclose(drawn.height(x, y), expected.height(x, y), atol=1e-12)
        assert abs(drawn.height(52.5, 0.0) - drawn.height(0.0, 0.0) + 0.25) < 1e-9
    run = StoredRun(bundle_adjustment__cameras={"surface": None})
    assert estimated_pitch(run, GIVEN, SPEC) == GIVEN


NAMES = (
    *(f"corner_{side}_{end}" for side in ("left", "right") for end in ("near", "far")),
    *(f"penalty_area_{side}_near_front" for side in ("left", "right")),
    "center_mark",
)


@pytest.fixture
def survey(tmp_path):
    """A national grid's easting and northing of the standard pitch, turned by 90 degrees."""
    rows = ["name,northing,easting,height"]
    for name, (x, y, z) in zip(NAMES, PitchTemplate.standard().positions(NAMES), strict=True):
        rows.append(f"{name},{5345000.0 + x:.4f},{512000.0 - y:.4f},{517.0 + z:.4f}")
    path = tmp_path / "survey.csv"
    path.write_text("\n".join(rows) + "\n")
    return path


def test_a_survey_becomes_pitch_json(survey, tmp_path):
    match = tmp_path / "match"
    answer = succeed("import", "--pitch", survey, "--out", match, "--json").json
    pitch = json.loads((match / "pitch.json").read_text())
    assert (pitch["length"], pitch["width"]) == pytest.approx((105.0, 68.0), abs=1e-3)
    assert pitch["crown"] == pytest.approx(0.2, abs=0.005)
    # x along the touch line, y away from the main camera, whatever the grid's axes are
    assert pitch["points"]["corner_right_far"] == pytest.approx([52.5, 34.0, -0.2], abs=0.005)
    assert set(answer["offset_plan_m"]) == set(NAMES)
    assert max(answer["offset_plan_m"].values()) < 0.001
    again = worldpose("import", "--pitch", survey, "--out", match)
    assert again.code == 2
    assert "expected no pitch there yet" in again.err
