import base64
import re
from datetime import UTC, datetime
from html.parser import HTMLParser

import pytest

from data_contracts.evaluation import Evaluation
from data_contracts.run import RunRecord, UnitFailure
from worldpose.release import CameraSummary, Picture, report_page
from worldpose.release.meanings import MEANINGS

PNG = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJg"
)


def run(**changes):
    plain = {
        "run_id": "0003",
        "match_id": "tiny-1",
        "parent": "0002",
        "state": "partial",
        "results": {"ingest/cam00": "0" * 32, "tracking/clip": "1" * 32},
        "settings": {},
        "overrides": {},
        "executed": ("tracking/clip",),
        "reused": ("ingest/cam00",),
        "failed": (
            UnitFailure(unit="triangulation/clip", error="E", message="<script>no</script>"),
        ),
        "blocked": (),
        "figures": {"tracking/clip": {"persons": 5.0, "mean_views": 5.8125}},
        "versions": {"numpy": "2.4.0"},
        "started_at": datetime(2025, 1, 2, 3, 4, 5, tzinfo=UTC),
        "finished_at": datetime(2025, 1, 2, 3, 4, 15, tzinfo=UTC),
        "seconds": 10.0,
    }
    return RunRecord(**{**plain, **changes})


class Page(HTMLParser):
    """Rows of cells, addresses and unbalanced tags of a page."""

    def __init__(self, text):
        super().__init__()
        self.rows, self.addresses, self.open = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        if tag not in ("meta", "img"):
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
        self.addresses += [value for name, value in attributes if name in ("src", "href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] in ("td", "th"):
            self.rows[-1][-1] += data


def test_units_say_what_happened_to_them():
    page = Page(report_page("A run", run(), seconds={"tracking/clip": 1.234}))
    assert ["ingest/cam00", "reused", ""] in page.rows
    assert ["tracking/clip", "computed", "1.23"] in page.rows
    assert ["triangulation/clip", "failed: <script>no</script>", ""] in page.rows
    assert page.open == []


def test_figures_are_shown_by_unit():
    rows = Page(report_page("A run", run(), seconds={})).rows
    assert ["tracking/clip", "persons", "5"] in rows
    assert ["", "mean_views", "5.812"] in rows


def test_scores_come_with_unit_and_meaning_and_shares_in_per_cent():
    scores = Evaluation(mpjpe_mm=23.456, coverage=0.5, frames=100)
    rows = Page(report_page("A run", run(), seconds={}, scores=scores)).rows
    assert ["Mean joint error", "23.46 mm", MEANINGS["mpjpe_mm"][2]] in rows
    assert ["People found", "50 %", MEANINGS["coverage"][2]] in rows
    assert ["Frames scored", "100", MEANINGS["frames"][2]] in rows
    assert not any("Correct limbs" in row for row in rows)


def test_every_score_has_a_meaning():
    assert set(MEANINGS) == set(Evaluation.model_fields)


def test_without_truth_there_is_no_table_of_scores():
    assert "Against the truth" not in report_page("A run", run(), seconds={})


def test_text_is_escaped():
    text = report_page("<b>bold</b> & more", run(), seconds={}, pictures=[Picture('"><img', PNG)])
    assert "<b>" not in text
    assert "<script>" not in text
    assert "&lt;b&gt;bold&lt;/b&gt; &amp; more" in text
    assert Page(text).open == []


def test_nothing_is_asked_from_outside():
    text = report_page("A run", run(), seconds={}, pictures=[Picture("from above", PNG)])
    page = Page(text)
    assert [address[:22] for address in page.addresses] == ["data:image/png;base64,"]
    assert base64.b64decode(page.addresses[0][22:]) == PNG
    assert not re.search(r"https?:|url\(|@import", text)
    assert "default-src 'none'" in text


@pytest.mark.parametrize("shown", [True, False])
def test_only_settings_that_were_asked_for_are_listed(shown):
    overrides = {"tracking": {"gate": 0.5}} if shown else {}
    text = report_page("A run", run(overrides=overrides), seconds={})
    assert (["tracking", "gate", "0.5"] in Page(text).rows) == shown


def test_static_cameras_are_listed_with_what_is_wrong_with_them():
    cameras = [
        CameraSummary("cam0", "given"),
        CameraSummary("cam1", "clicks", 0.0213, 0.35, 1.125, 9, ("corner_left_far",), ("few",)),
    ]
    text = report_page(
        "A run", run(), seconds={}, cameras=cameras, camera_pictures=[Picture("cam1", PNG)]
    )
    rows = Page(text).rows
    assert ["cam0", "given", "-", "-", "-", "-", "", ""] in rows
    assert ["cam1", "clicks", "0.0213", "0.35", "1.125", "9", "corner_left_far", "few"] in rows
    assert text.index("Static cameras") < text.index("<figcaption>cam1") < text.index("was run")
    assert "Static cameras" not in report_page("A run", run(), seconds={})
