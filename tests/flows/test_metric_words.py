"""Metrics and reasons of gates read as words, alike in terminals, alerts and pages."""

import re
from pathlib import Path

import pytest

from data_contracts.usability import UsableLimits
from flows import usability
from flows.gates import GATES
from flows.review.metric_words import UNITS, all_reasons, in_short, metric_words, reason_words
from worldpose.camera_consistency import consistency
from worldpose.camera_consistency.diagnosis import Fault

PAGES = Path(__file__).parents[2] / "infra" / "review_pages" / "src" / "words.js"


@pytest.mark.parametrize(
    ("reason", "words"),
    [
        (
            "offset_rms_m is 0.05, at most 0.03 passes",
            "distance of bodies from the seen joints: 5 cm",
        ),
        (
            "held_out_certain_excess_m is 0.03 (knee, ankle), at most 0.01 passes",
            "bodies are worse than joints by: 3 cm (knee, ankle), limit 1 cm",
        ),
        ("weak is 1, at most 0 passes", "the camera is uncertain: more clicks are needed"),
        ("residual_px could not be computed", "residual could not be computed"),
        ("Ada rejected it: the_click is 1", "Ada rejected it: the_click is 1"),
        ("camera a is 3, at most wrong", "camera a is 3, at most wrong"),
    ],
)
def test_reasons_of_gates_are_words(reason, words):
    assert reason_words(reason).startswith(words)


def test_every_metric_of_a_gate_is_put_into_words():
    names = [name for gate in GATES.values() for name in gate.limits]
    assert len(names) > 10
    for name in names:
        for reason in (f"{name} is 1, at most 0.5 passes", f"{name} could not be computed"):
            said = reason_words(reason)
            assert said != reason or "_" not in name
            assert "_" not in said


def test_metrics_have_their_unit_behind_the_value():
    figures = {"offset_rms_m": 0.0512345, "m": 2.0, "undecided": 0.0, "offset_rms_m.knee": 1.0}
    assert (
        in_short(figures) == "distance of bodies from the seen joints 0.05123 m, m 2, "
        "places where two tracks may be one person 0"
    )
    assert metric_words("expected_error_median_px") == ("expected error of the drawn pitch", "px")
    assert all_reasons(["a_m is 2, at most 1 passes", "b"]) == "a: 2 m, limit 1 m; b"


JARGON = re.compile(
    r"detection|epipolar|\bray|\bposes?\b|\bnets?\b|keypoint|translation|orientation"
)


@pytest.mark.parametrize("stage", ["tracking", "camera_consistency", "broadcast_tracking"])
def test_reasons_of_tracking_are_in_operators_words(stage):
    said = [rule.says for rule in usability._RULES if rule.stage == stage]
    if (gate := GATES.get(stage)) is not None:
        said += [gate.question, gate.to_correct]
        said += [metric_words(name)[0] for name in gate.limits]
    lacks = {"lacks_people": True, "figures": {f"{stage}/clip": {"unmatched_share": 0.9}}}
    said += usability.judge_run(usability.RunOutcome(**lacks), UsableLimits()).reservations
    kinds = ("clock", "frame_rate", "flipped", "mirrored", "focal", "swapped", "duplicate", "pose")
    for kind in kinds if stage == "camera_consistency" else ():
        fault = Fault(0, kind, value=3.0, other=1, share_now=0.1, share_corrected=0.9)
        said.append(consistency._reason(fault, ("a", "b"), 0, 1.0, 25.0))
    assert said and not [text for text in said if JARGON.search(text)]


def test_the_pages_know_the_same_units():
    (listed,) = re.findall(r"const UNITS = \{(.*?)\};", PAGES.read_text())
    assert dict(re.findall(r'(\w+): "([^"]+)"', listed)) == UNITS
