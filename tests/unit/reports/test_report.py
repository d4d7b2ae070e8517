import base64
import hashlib
import re
from datetime import timedelta
from html import unescape
from html.parser import HTMLParser

from run_records import AT, run_record

from data_contracts.evaluation import CameraErrors, CameraEvaluation, Evaluation
from data_contracts.run import UnitFailure
from worldpose.reports.html_page import CaptionedImage, EmbeddedPage, LinkedFile, Section
from worldpose.reports.run_report import report_page, score_rows

PNG = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJg"
)


def run(**changes):
    plain = {
        **{"run_id": "0003", "match_id": "tiny-1", "parent": "0002", "state": "partial"},
        "results": {"ingest/cam00": "0" * 32, "tracking/clip": "1" * 32},
        "executed": ("tracking/clip",),
        "reused": ("ingest/cam00",),
        "failed": (
            UnitFailure(unit="triangulation/clip", error="E", message="<script>no</script>"),
        ),
        "figures": {"tracking/clip": {"persons": 5.0, "mean_views": 5.8125}},
        "versions": {"numpy": "2.4.0"},
        "finished_at": AT + timedelta(seconds=10.0),
        "seconds": 10.0,
    }
    return run_record(**{**plain, **changes})


class Page(HTMLParser):
    """Rows of cells, addresses and unbalanced tags of a page."""

    def __init__(self, text):
        super().__init__()
        self.rows, self.addresses, self.open = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        if tag not in ("meta", "img", "input"):
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
    asked = run(overrides={"tracking": {"gate_m": 0.5}})
    scores = Evaluation(mpjpe_mm=23.456, coverage=0.5, frames=100)
    page = Page(report_page("A run", asked, seconds={"tracking/clip": 1.234}, scores=scores))
    assert ["ingest/cam00", "reused", ""] in page.rows
    assert ["tracking/clip", "computed", "1.23"] in page.rows
    assert ["triangulation/clip", "failed: <script>no</script>", ""] in page.rows
    assert ["tracking/clip", "persons", "5"] in page.rows
    assert ["", "mean_views", "5.812"] in page.rows
    assert ["tracking", "gate_m", "0.5"] in page.rows
    distance = "mean distance between estimated and true joints in world coordinates, "
    assert ["Mean joint error", "23.46 mm", f"{distance}without alignment"] in page.rows
    assert ["People found", "50 %"] in [row[:2] for row in page.rows]
    assert not any("Correct limbs" in row for row in page.rows)
    assert page.open == []


def test_every_score_has_a_meaning():
    fields = {**Evaluation.model_fields, **CameraErrors.model_fields}
    assert all(each.title and each.description for each in fields.values())
    errors = CameraErrors(ground_error_p95_m=0.25, coverage=0.5)
    scores = Evaluation(g_mpjpe_mm=80.04, cameras=CameraEvaluation(broadcast=errors))
    assert [row[:3] for row in score_rows(scores)] == [
        ("g_mpjpe_mm", "G-MPJPE", "80.04 mm"),
        ("cameras.broadcast.ground_error_p95_m", "Broadcast cameras: ground error, 95 %", "0.25 m"),
        ("cameras.broadcast.coverage", "Broadcast cameras: frames", "50 %"),
    ]


def pictured(*pictures, heading="Seen"):
    return [Section(heading, tuple(pictures))]


def test_text_is_escaped():
    hostile = pictured(CaptionedImage('"><img', PNG), heading="<script>1</script>")
    tiles = [("<i>3</i>", "<u>")]
    text = report_page("<b>bold</b> & more", run(), seconds={}, sections=hostile, tiles=tiles)
    for tag in ("<b>bold", "<script>", "<i>", "<u>"):
        assert tag not in text
    assert "&lt;b&gt;bold&lt;/b&gt; &amp; more" in text
    assert Page(text).open == []


def test_nothing_is_asked_from_outside():
    linked = Section("Videos", (LinkedFile("goal & corner", 'a "1".mp4'),))
    sections = [Section("Nothing", ()), *pictured(CaptionedImage("from above", PNG)), linked]
    text = report_page("A run", run(), seconds={}, sections=sections)
    assert "Nothing" not in text and "Against the truth" not in text
    assert '<a href="#part1">Seen</a>' in text
    assert '<a href="a%20%221%22.mp4">goal &amp; corner</a>' in text
    page = Page(text)
    jumps = [address for address in page.addresses if address.startswith("#")]
    assert jumps == ["#part1", "#part2", "#last"]
    data, _ = [address for address in page.addresses if address not in jumps]
    assert data[:22] == "data:image/png;base64,"
    assert base64.b64decode(data[22:]) == PNG
    assert not re.search(r"https?:|url\(|@import", text)
    assert "default-src 'none'" in text
    assert "<script" not in text
    assert "script-src" not in text


def test_an_embedded_page_brings_the_one_script_that_the_page_may_run():
    script = 'const a = "&amp; <b>" && 1 < 2;'
    data = '<p title="a">&lt;</p><script data-clip="0">YQ==</script>'
    block = EmbeddedPage('3D "view"', f'{data}<script type="module">{script}</script>')
    text = report_page("A run", run(), seconds={}, sections=[Section("3D view", (block,))])
    allowed = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{allowed}'" in text
    (frame,) = re.findall(r'<iframe title="([^"]*)" srcdoc="([^"]*)"></iframe>', text)
    assert [unescape(each) for each in frame] == [block.title, block.html]
    assert Page(text).open == []
