"""Which camera's video lies beside the page, and what is loaded before a thread films it."""

import json
import subprocess
import sys
from types import SimpleNamespace

import pytest

from data_contracts.match import CameraSpec, ClipSpec, MatchSpec
from flows.reports.report import write_report
from worldpose.errors import UsageError

REPORT = """
import json, sys, threading
from flows.cli import main
from flows.reports import report

report._own_reference = lambda match: None  # scoring would import what the page needs
imported = []

def note_import(event, arguments):
    if event == "import" and threading.current_thread() is not threading.main_thread():
        imported.append(arguments[0].partition(".")[0])

sys.addaudithook(note_import)
try:
    main()
finally:
    print(json.dumps(sorted(set(imported))))
"""


def test_threads_of_a_report_without_truth_import_no_library_whose_modules_form_a_circle(
    tiny, tiny_run, tmp_path
):
    options = (str(tiny), "--project", str(tiny_run), "--out", str(tmp_path / "report.html"))
    command = [sys.executable, "-c", REPORT, "report", *options]
    told = subprocess.check_output(command, text=True).splitlines()[-1]
    circular = {"dask", "xarray", "zarr", "pandas", "scipy", "numba", "matplotlib"}
    assert circular.isdisjoint(json.loads(told))


@pytest.mark.parametrize("asked", ["south", "main", "nobody"])
def test_a_camera_without_a_video_of_its_own_is_refused_before_anything_is_written(tmp_path, asked):
    names = {"north": "static", "south": "static", "main": "broadcast"}
    spec = MatchSpec(
        match_id="m",
        fps=50.0,
        cameras=tuple(
            CameraSpec(id=name, kind=kind, width=1920, height=1080) for name, kind in names.items()
        ),
        clips=(ClipSpec(id="clip", frame_count=4, broadcast="main"),),
    )
    folder = SimpleNamespace(spec=spec, videos={"north": "a.mp4", "clip": "b.mp4"})
    page = tmp_path / "report.html"
    with pytest.raises(UsageError, match=rf"--camera {asked}: .*these have one: north\."):
        write_report(None, SimpleNamespace(folder=folder), page, camera=asked)
    assert not page.exists()
