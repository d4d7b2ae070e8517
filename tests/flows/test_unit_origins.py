"""The result of every unit says where it comes from."""

from datetime import UTC, datetime

from data_contracts.review import Correction, DeletedDetection, MovedPoint
from flows.review.verdicts import unit_origins

MADE_FROM = {
    "static_calibration/a": (),
    "static_calibration/b": (),
    "tracking/one": ("static_calibration/a", "static_calibration/b"),
    "tracking/two": ("static_calibration/a", "static_calibration/b"),
    "body_fitting/one": ("tracking/one",),
    "body_fitting/two": ("tracking/two",),
}


def moved(camera, frame=None):
    return Correction(
        id=f"{camera}.{frame}",
        match_id="m",
        edit=MovedPoint(camera=camera, marking="corner_left_near", frame=frame, xy=(1.0, 1.0)),
        who="Ada",
        made_at=datetime(2026, 1, 2, tzinfo=UTC),
        based_on={},
    )


def test_a_correction_marks_what_it_corrects_alone():
    origins = unit_origins(MADE_FROM, [moved("a")], ())
    assert origins == dict.fromkeys(MADE_FROM, "automatic") | {"static_calibration/a": "corrected"}


def test_a_correction_of_a_detection_marks_whatever_found_it():
    edit = DeletedDetection(camera="a", frame=3, detection=0)
    out = moved("a").model_copy(update={"edit": edit})
    given = dict.fromkeys(("ingest/a", "ingest/ab", "detection/ab.one"), ())
    assert unit_origins(given, [out], ())["ingest/a"] == "corrected"
    found = {**given, "detection/a.one": ()}
    origins = unit_origins(found, [out], ())
    assert [unit for unit in found if origins[unit] == "corrected"] == ["detection/a.one"]


def test_a_refusal_reaches_all_that_is_made_from_it():
    origins = unit_origins(MADE_FROM, [], ["tracking/one"])
    refused = {unit for unit, origin in origins.items() if origin == "rejected"}
    assert refused == {"tracking/one", "body_fitting/one"}
    everything = unit_origins(MADE_FROM, [moved("a")], ["static_calibration/a"])
    assert {u for u, o in everything.items() if o == "automatic"} == {"static_calibration/b"}
