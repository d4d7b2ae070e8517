"""The command `synchronize` proposes clock offsets, draws them, and writes them on request."""

import shutil

import pytest
import yaml
from command_line import succeed
from typer.testing import CliRunner

from flows.cli.app import app
from worldpose.errors import UsageError
from worldpose.store.store import Store


@pytest.fixture(scope="module")
def shifted(tiny, tmp_path_factory):
    """The match `tiny` with a wrong clock offset of one camera."""
    folder = tmp_path_factory.mktemp("shifted") / "tiny"
    shutil.copytree(tiny, folder)
    file = folder / "match.yaml"
    content = yaml.safe_load(file.read_text())
    content["cameras"][2]["offset_frames"] = 5
    file.write_text(yaml.safe_dump(content))
    return folder


def test_an_offset_is_found_drawn_and_written(server, shifted, tmp_path):
    options = ("--project", tmp_path / "p", "--json")
    plot = tmp_path / "clocks.svg"
    found = succeed("synchronize", shifted, "--plot", plot, *options).json
    rows = {row["camera"]: row for row in found["cameras"]}
    assert {name: row["proposed"] for name, row in rows.items()} == dict.fromkeys(rows, 0)
    assert rows["cam02"]["stated"] == 5
    assert abs(rows["cam02"]["found"]) < 0.2
    assert found["applied"] == {}
    assert "<svg" in plot.read_text()
    applied = succeed("synchronize", shifted, "--apply", *options).json["applied"]
    assert applied == {"cam02": 0}
    cameras = yaml.safe_load((shifted / "match.yaml").read_text())["cameras"]
    assert [camera.get("offset_frames", 0) for camera in cameras] == [0] * len(cameras)
    assert "match.yaml needs no change" in succeed("synchronize", shifted, *options[:2]).out


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--clip", "second"), "--clip second: expected one of clip, found 'second'"),
        (("--plot", "clocks.doc"), "clocks.doc: expected a file name that ends with .svg, .pdf"),
    ],
)
def test_wrong_options_are_told_before_anything_is_computed(shifted, tmp_path, options, told):
    Store.create(tmp_path / "p")
    command = ["synchronize", str(shifted), "--project", str(tmp_path / "p"), *options]
    result = CliRunner().invoke(app, command)
    assert isinstance(result.exception, UsageError)
    assert told in str(result.exception)
