"""The command `locate-cameras` finds cameras without a pitch, and writes them on request."""

from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from command_line import succeed
from typer.testing import CliRunner

from data_contracts.cameras import LensCalibration
from flows.cli.app import app
from flows.cli.locate import _lens
from worldpose.errors import InputError, UsageError
from worldpose.formats.calibration_forms import read_calibration
from worldpose.formats.lens_files import write_lens_toml
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import align


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """A match without a pitch and calibration, with lenses; and the true cameras."""
    folder = tmp_path_factory.mktemp("lab") / "lab"
    options = ("--seed", "1", "--duration", "6", "--cameras", "4", "--calibrated")
    succeed(
        "simulate", "--scenario", "tiny", "--out", folder, *options, "--no-stills", "--no-video"
    )
    file = folder / "match.yaml"
    content = yaml.safe_load(file.read_text()) | {"match_id": "lab", "pitch": "none"}
    content["cameras"] = [each for each in content["cameras"] if each["kind"] == "static"]
    content["clips"] = [
        {key: value for key, value in clip.items() if not key.startswith("broadcast")}
        for clip in content["clips"]
    ]
    file.write_text(yaml.safe_dump(content))
    known = {each["id"] for each in content["cameras"]}
    for place in (folder / "detections").iterdir():
        if place.stem not in known:
            place.unlink()
    for name in ("annotations", "reference", "estimates", "broadcast"):
        for place in (folder / name).rglob("*") if (folder / name).is_dir() else ():
            if place.is_file():
                place.unlink()
    truth = read_calibration(folder / "calibration.toml")
    (folder / "calibration.toml").unlink()
    (folder / "pitch.json").unlink()
    lenses = {
        name: LensCalibration(
            id=name,
            image_size=one.image_size,
            focal_px=float(np.mean(one.focal_px)),
            principal_point_px=one.principal_point_px,
            distortion=one.distortion,
            focal_std_px=3.0,
            principal_point_std_px=3.0,
            distortion_std=0.005,
        )
        for name, one in truth.items()
    }
    write_lens_toml(folder / "lenses.toml", lenses)
    return folder, truth


def test_cameras_are_found_and_written_in_place_of_lenses(server, lab, tmp_path):
    folder, truth = lab
    options = ("--project", tmp_path / "p", "--stature", "1.83")
    found = succeed("locate-cameras", folder, *options, "--json").json
    assert found["written"] == [] and found["people"] >= 1
    assert set(found["cameras"]) == set(truth)
    shown = succeed("locate-cameras", folder, *options, "--apply").out
    assert "cameras by the people" in shown and "calibration.toml" in shown
    written = read_calibration(folder / "calibration.toml")
    assert not (folder / "lenses.toml").exists() and (folder / "lenses.toml.before").exists()
    places = np.array([Camera.from_calibration(written[name]).center for name in truth])
    right = np.array([Camera.from_calibration(truth[name]).center for name in truth])
    motion = align(places, right, with_scale=True)
    far = np.linalg.norm(right - right.mean(axis=0), axis=1).mean()
    off = np.linalg.norm(motion.apply(places) - right, axis=1)
    assert off.max() < 0.03 * far
    stated = np.array([found["cameras"][name]["position_std_m"] for name in truth])
    assert (off < 4.0 * stated + 0.05).all()
    refused = CliRunner().invoke(
        app, ["locate-cameras", str(folder), *map(str, options), "--apply"]
    )
    assert isinstance(refused.exception, InputError)
    assert "calibration.toml: expected no calibration there yet" in str(refused.exception)


def test_unequal_focal_lengths_widen_the_lens_or_are_refused(tmp_path):
    def lens(fx, fy):
        given = SimpleNamespace(
            image_size=(1440, 1080),
            focal_px=(fx, fy),
            principal_point_px=(719.5, 539.5),
            distortion=(0.0,) * 5,
            lens_model="brown",
        )
        folder = SimpleNamespace(folder=tmp_path, lenses={}, calibrations={"a": given})
        return _lens(SimpleNamespace(folder=folder), "a")

    assert lens(1000.0, 1010.0).focal_std_px == 5.0
    with pytest.raises(InputError, match=r"calibration.toml: a.matrix: .*1050 and 1400"):
        lens(1050.0, 1400.0)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ((), "--stature: expected either --stature or --distance"),
        (("--stature", "1.8", "--distance", "cam00", "cam01", "3"), "found both"),
        (("--distance", "cam00", "cam09", "3"), "--distance cam00 cam09 3: expected two of the"),
        (("--stature", "1.8", "--clip", "b"), "--clip b: expected one of"),
    ],
)
def test_wrong_options_are_told_before_anything_is_computed(lab, tmp_path, options, told):
    folder, _ = lab
    command = ["locate-cameras", str(folder), "--project", str(tmp_path / "p"), *options]
    result = CliRunner().invoke(app, command)
    assert isinstance(result.exception, UsageError)
    assert told in str(result.exception)
