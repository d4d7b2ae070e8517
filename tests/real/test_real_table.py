"""The table of all metrics on real data: on a made-up folder, and on a few real frames.

WORLDPOSE_TEST_DATA names a folder as benchmarks/real.py describes it.
"""

import sys
from pathlib import Path

import pytest
from real_data import GIVEN, needs

FOLDER = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def table(monkeypatch, capsys):
    """Runs the command in this process and returns its exit message and output."""
    monkeypatch.syspath_prepend(str(FOLDER))
    import real

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["real.py", *map(str, words)])
        try:
            real.main()
        except SystemExit as error:
            return str(error), ""
        return None, capsys.readouterr().out

    run.module = real
    return run


def test_bad_data_is_one_clear_error(table, tmp_path):
    assert table(tmp_path / "absent")[0].endswith("says how each is laid out.")
    (tmp_path / "mvor").mkdir()
    (tmp_path / "mvor" / "camma_mvor_2018.json").write_text("{}")
    failure, _ = table(tmp_path)
    assert failure.startswith("error: ")
    assert "openpose_kps.json: expected this part of the data, found nothing" in failure
    (tmp_path / "mvor" / "openpose_kps.json").write_text("[]")
    failure, _ = table(tmp_path)
    assert failure.startswith("error: mvor: KeyError")


@pytest.mark.slow
@needs("static_pair")
def test_a_few_frames_of_the_real_folder_give_metrics(table):
    failure, out = table(
        GIVEN, "--only", "static_pair", "--only", "panorama_people", *("--frames", 3)
    )
    assert failure is None
    assert "| static_pair | left.wrong_named | 3 |" in out
    assert "| static_pair | right.right_accused | 0 |" in out
    pairs = float(out.split("people_per_frame | ")[1].split(" ")[0])
    assert 5.0 < pairs < 12.0
