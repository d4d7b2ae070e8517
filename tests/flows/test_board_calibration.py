"""The command `calibrate` writes lenses that `import --lens` reads, or tells what is wrong."""

import json

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from flows.cli.app import app
from worldpose.errors import InputError, UsageError
from worldpose.formats.lens_files import read_lens_toml
from worldpose.video.files import write_video

SIZE = (640, 480)
FOCAL = 520.0
OPTIONS = ("--columns", "7", "--rows", "4", "--square", "0.06")


def photograph(rng):
    """An image of a tilted checkerboard with 7 x 4 inner corners, without distortion."""
    side = 40
    squares = np.indices((5, 8)).sum(axis=0) % 2 * 255
    page = np.kron(squares, np.ones((side, side))).astype(np.uint8)
    page = cv2.copyMakeBorder(page, side, side, side, side, cv2.BORDER_CONSTANT, value=255)
    height, width = page.shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float64)
    places = np.column_stack([(corners / side - [5.0, 3.5]) * 0.06, np.zeros(4)])
    turn = cv2.Rodrigues(rng.uniform(-0.6, 0.6, 3))[0]
    at = places @ turn.T + [*rng.uniform(-0.04, 0.04, 2), 0.75]
    shown = FOCAL * at[:, :2] / at[:, 2:] + [319.5, 239.5]
    way = cv2.getPerspectiveTransform((corners - 0.5).astype(np.float32), shown.astype(np.float32))
    return cv2.warpPerspective(page, way, SIZE, flags=cv2.INTER_AREA, borderValue=128)


@pytest.fixture(scope="module")
def boards(tmp_path_factory):
    """Images of camera `a`, a video of camera `b`."""
    folder, rng = tmp_path_factory.mktemp("boards"), np.random.default_rng(2)
    pictures = [photograph(rng) for _ in range(9)]
    (folder / "int_a_img").mkdir()
    for n, picture in enumerate(pictures[:8]):
        cv2.imwrite(str(folder / "int_a_img" / f"{n}.png"), picture)
    cv2.imwrite(str(folder / "int_a_img" / "9.png"), np.full(SIZE[::-1], 99, np.uint8))
    frames = [np.repeat(picture[..., None], 3, axis=2) for picture in pictures for _ in range(5)]
    write_video(folder / "b.mp4", frames, 10.0)
    return folder


def calibrate(*arguments):
    return CliRunner().invoke(app, ["calibrate", *map(str, arguments)])


def test_images_and_a_video_become_lenses(boards, tmp_path):
    out, plot = tmp_path / "lenses.toml", tmp_path / "lens.svg"
    result = calibrate(boards, *OPTIONS, "--out", out, "--plot", plot, "--json")
    assert result.exit_code == 0, result.exception
    told = json.loads(result.stdout)["cameras"]
    assert told["a"]["left_out"] == {"8": "no whole board found"}
    assert told["a"]["images"] == 8
    assert told["b"]["images"] >= 7
    lenses = read_lens_toml(out, {"a": SIZE, "b": SIZE})
    for lens in lenses.values():
        assert lens.focal_px == pytest.approx(FOCAL, abs=max(3.0, 4.0 * lens.focal_std_px))
    assert "<svg" in plot.read_text()
    refused = calibrate(boards, *OPTIONS, "--out", out)
    assert "a new file" in str(refused.exception), "people edit lenses"
    other = tmp_path / "a.toml"
    shown = calibrate(boards, *OPTIONS, "--out", other, "--camera", "a").stdout
    assert "a: 9.png is left out: no whole board found" in shown


def test_squares_in_place_of_corners_are_told(boards, tmp_path):
    out = tmp_path / "lenses.toml"
    options = ("--columns", "8", "--rows", "5", "--square", "0.06", "--camera", "a")
    result = calibrate(boards, *options, "--out", out)
    assert "a: the board has 7 x 4 inner corners; 8 x 5 is its number of squares" in result.stderr
    lens = read_lens_toml(out, {"a": SIZE})["a"]
    assert lens.focal_px == pytest.approx(FOCAL, abs=max(3.0, 4.0 * lens.focal_std_px))


@pytest.mark.parametrize(
    ("place", "options", "kind", "told"),
    [
        ("nowhere", (), InputError, "nowhere: expected a folder of images or a video for each cam"),
        (".", ("--camera", "c"), UsageError, "--camera c: expected one of b, a, found 'c'"),
        (".", ("--marker", "0.04"), UsageError, "expected --charuco together with --marker"),
        (".", ("--plot", "lens.doc"), UsageError, "lens.doc: expected a file name that ends with"),
        ("int_a_img", ("--rows", "5"), InputError, "a: board images: expected 4 images or more"),
    ],
)
def test_what_is_wrong_is_told(boards, tmp_path, place, options, kind, told):
    result = calibrate(boards / place, *OPTIONS, *options, "--out", tmp_path / "lenses.toml")
    assert isinstance(result.exception, kind), result.exception
    assert told in str(result.exception)
    assert not (tmp_path / "lenses.toml").exists()
