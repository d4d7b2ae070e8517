import pytest

from data_contracts.evaluation import CameraErrors, CameraEvaluation, Evaluation
from worldpose.reports.run_report import CAMERA_MEANINGS, MEANINGS, SHARES, score_rows


def test_every_score_has_a_meaning():
    assert set(MEANINGS) == set(Evaluation.model_fields)
    assert set(CAMERA_MEANINGS) == set(CameraErrors.model_fields)


def test_rows_have_name_label_value_and_meaning():
    scores = Evaluation(
        g_mpjpe_mm=80.04,
        cameras=CameraEvaluation(broadcast=CameraErrors(ground_error_p95_m=0.25, coverage=0.5)),
    )
    assert score_rows(scores) == [
        ("g_mpjpe_mm", "G-MPJPE", "80.04 mm", MEANINGS["g_mpjpe_mm"][2]),
        (
            "cameras.broadcast.ground_error_p95_m",
            "Broadcast cameras: ground error, 95 %",
            "0.25 m",
            CAMERA_MEANINGS["ground_error_p95_m"][2],
        ),
        (
            "cameras.broadcast.coverage",
            "Broadcast cameras: frames",
            "50 %",
            CAMERA_MEANINGS["coverage"][2],
        ),
    ]
    assert score_rows(Evaluation()) == []


@pytest.mark.parametrize("name", sorted(SHARES))
def test_shares_are_shown_in_per_cent(name):
    (row,) = score_rows(Evaluation(**{name: 0.125}))
    assert row[2] == "12.5 %"
