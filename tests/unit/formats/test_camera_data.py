"""Camera data of tracking systems, FreeD packets by hand, and files of moving cameras."""

import struct

import numpy as np
import pytest
from run_records import calibration

from worldpose.errors import InputError
from worldpose.formats.archives import write_archive
from worldpose.formats.camera_data import (
    COLUMNS,
    apply_zoom_table,
    read_camera_data,
    write_camera_data,
)
from worldpose.formats.release_cameras import read_camera, write_static_camera
from worldpose.geometry.pan_tilt import rotation_of_angles

PACKET = bytes.fromhex("D107 2D0000 F10000 000000 00FA00 FE0C00 017700 001234 000001 0000 87")
"""Camera 7: pan 90, tilt -30, roll 0 degrees; 1, -2, 1.5 m; zoom 4660. 40 - B9 (the sum) = 87."""
SIZE = (1920, 1080)


def packet(**changed):
    content = bytearray(PACKET)
    for place, value in changed.items():
        content[int(place[1:])] = value
    content[-1] = (0x40 - sum(content[:-1])) % 256
    return bytes(content)


def read(tmp_path, content, name="data", **options):
    file = tmp_path / name
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_camera_data(file, 25.0, SIZE, **options)


@pytest.mark.parametrize(
    ("title", "form"),
    [
        ("time_s", "{:.2f}"),
        ("Time (ms)", "{0:.0f}0"),
        ("timestamp", "2024-05-01 10:59:{:05.2f}"),
        ("timestamp", "2024-05-01T10:59:{:05.2f}+02:00"),
        ("timecode", "10:59:{:06.3f}"),
    ],
)
def test_rows_of_a_table_are_at_their_times(tmp_path, title, form):
    rows = [form.format(n if "ms" in title else 0.01 * n) + f",{n},-10" for n in range(41)]
    data = read(tmp_path, "\n".join([f"{title},pan,tilt", *rows]))
    assert data.frame.tolist() == list(range(11))
    assert data.values[:, 0].tolist() == list(range(0, 41, 4))


def test_times_that_contradict_the_frames_are_refused(tmp_path):
    rows = [f"{n},{0.01 * n:.2f},0,-10" for n in range(9)]
    with pytest.raises(InputError, match="frames at 100 per second by their times"):
        read(tmp_path, "\n".join(["frame,time_s,pan,tilt", *rows]))
    with pytest.raises(InputError, match="State the unit in the title"):
        read(tmp_path, "time_s,pan,tilt\n0,0,-10\n40,0,-10\n80,0,-10\n")


@pytest.mark.parametrize("fps", [24.0, 25.0, 29.97, 30.0, 50.0, 59.94, 60.0])
@pytest.mark.parametrize("rows", [3, 300])
def test_times_in_hundredths_agree_with_frames_of_usual_rates(tmp_path, fps, rows):
    (tmp_path / "data").write_text(
        "\n".join(["frame,time_s,pan,tilt", *(f"{n},{n / fps:.2f},0,-10" for n in range(rows))])
    )
    assert read_camera_data(tmp_path / "data", fps, SIZE).frame.tolist() == list(range(rows))


@pytest.mark.parametrize(
    ("title", "form", "factor"),
    [
        *(("time", "00:00:{:02.0f}", 0.01), ("time", "{:.1f}", 0.04), ("time_s", "{:.1f}", 0.04)),
        *(("time", "{:.0f}", 40.0), ("t", "{:.0f}", 1.0)),
    ],
)
@pytest.mark.parametrize("has_frame", [False, True])
def test_coarse_clocks_and_counters_place_no_row(tmp_path, title, form, factor, has_frame):
    rows = [f"{n}," * has_frame + f"{form.format(factor * n)},0,-10" for n in range(50)]
    data = read(tmp_path, "\n".join(["frame," * has_frame + f"{title},pan,tilt", *rows]))
    assert data.frame.tolist() == list(range(50))
    assert f"columns left out: {title}" in data.notes


def test_a_principal_point_has_the_pixels_of_the_video(tmp_path):
    text = "frame,pan,tilt,cx,cy\n0,0,-10,965,540\n"
    assert read(tmp_path, text).values[0, 10:].tolist() == [965.0, 540.0]
    with pytest.raises(InputError, match="the middle of about 3841 x 2161 px"):
        read(tmp_path, text.replace("cx,cy", "cx_px,cy_px").replace("965,540", "1920,1080"))
    with pytest.raises(InputError, match=r"found 0\.3, 539\.5"):
        read(tmp_path, "pan,tilt,cx_px\n0,-10,0.3\n")
    shift = read(tmp_path, text.replace("965,540", "0.3,-0.2"))
    assert np.isnan(shift.values[0, 10:]).all()
    assert "columns left out: cx, cy" in shift.notes


def test_a_packet_is_read_as_computed_by_hand(tmp_path):
    data = read(tmp_path, PACKET + packet(b2=0xA6, b3=0, b4=0), first=10)
    assert data.frame.tolist() == [10, 11]
    expected = [90.0, -30.0, 0.0, 1.0, -2.0, 1.5, np.nan, np.nan, np.nan, 4660.0, np.nan, np.nan]
    np.testing.assert_array_equal(data.values[0], expected)
    assert data.values[1, 0] == -180.0
    assert any("no focal length" in note for note in data.notes)
    mixed = read(tmp_path, PACKET + packet(b1=8, b2=0) + PACKET, number=8)
    np.testing.assert_array_equal(mixed.values[:, 0], [0.0])


def pcap(packets, times):
    """A capture in big-endian order with nanoseconds; UDP's 42 bytes before each packet."""
    content = bytes.fromhex("a1b23c4d 0002 0004 00000000 00000000 0000ffff 00000001")
    for data, time in zip(packets, times, strict=True):
        frame = bytes(42) + data
        head = struct.pack(">4I", int(time), round(time % 1 * 1e9), len(frame), len(frame))
        content += head + frame
    return content


def pcapng(packets, times):
    """The same in little-endian blocks, with times of 2^-10 s."""

    def block(kind, body):
        body += bytes(-len(body) % 4)
        size = struct.pack("<I", 12 + len(body))
        return struct.pack("<I", kind) + size + body + size

    content = block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1))
    content += block(1, bytes.fromhex("01000000 00000000 0300 0400 61626300 0900 0100 8a000000"))
    for data, time in zip(packets, times, strict=True):
        high, low = divmod(round(time * 1024), 2**32)
        size = 42 + len(data)
        content += block(6, struct.pack("<5I", 0, high, low, size, size) + bytes(42) + data)
    return content


@pytest.mark.parametrize("write", [pcap, pcapng])
def test_a_capture_gives_packets_at_the_frames_of_their_times(tmp_path, write):
    # Frames of 40 ms: the second packet is nearer to frame 1 than the third, frame 2 is lost.
    packets = [packet(b2=n, b3=0, b4=0) for n in range(4)]
    times = [1.7e9, 1.7e9 + 0.039, 1.7e9 + 0.055, 1.7e9 + 0.122]
    data = read(tmp_path, write([*packets, b"other"], [*times, 1.7e9 + 0.2]))
    assert data.frame.tolist() == [0, 1, 3]
    np.testing.assert_array_equal(data.values[:, 0], [0.0, 2.0, 6.0])
    two = write([PACKET, packet(b1=8, b2=0), packet(b1=8, b2=2)], [0.0, 0.01, 0.05])
    assert read(tmp_path, two, number=8).values[:, 0].tolist() == [0.0, 4.0]
    with pytest.raises(InputError, match="1 of camera 7, 2 of camera 8"):
        read(tmp_path, two)
    for content, said in ((write([b"x"], [0.0]), "none in 1 frames"), (two[:50], "whole capture")):
        with pytest.raises(InputError, match=said):
            read(tmp_path, content)


def test_titles_may_have_other_spellings_and_radians(tmp_path):
    data = read(tmp_path, "Pan_rad;tilt;PosX;Pos Y [cm];fov_vertical\n0,5;1;2;300;40\n")
    focal = 540.0 / np.tan(np.radians(20.0))
    np.testing.assert_allclose(data.values[0, [0, 3, 4, 6]], [np.degrees(0.5), 2.0, 3.0, focal])


@pytest.mark.parametrize(
    ("angles", "right", "down", "ahead"),
    [
        ((0.0, 0.0, 0.0), (1, 0, 0), (0, 0, -1), (0, 1, 0)),
        ((90.0, 0.0, 0.0), (0, -1, 0), (0, 0, -1), (1, 0, 0)),  # clockwise from above
        ((0.0, 90.0, 0.0), (1, 0, 0), (0, 1, 0), (0, 0, 1)),  # upwards
        ((0.0, 0.0, 90.0), (0, 0, -1), (-1, 0, 0), (0, 1, 0)),  # clockwise from behind
    ],
)
def test_angles_turn_the_axes_of_the_camera(angles, right, down, ahead):
    rotation = rotation_of_angles(*np.array(angles)[:, None])[0]
    np.testing.assert_allclose(rotation, [right, down, ahead], atol=1e-12)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (PACKET + PACKET[:-1] + b"\x88", r"packet 2: expected .* checksum 87, found .* with 88"),
        (PACKET + PACKET[:20], r"packet 2: expected 29 bytes .* found 20 bytes"),
        (PACKET + b"\xd2" + PACKET[1:], r"packet 2: expected .* type D1"),
        (PACKET + packet(b1=8), r"1 of camera 7, 1 of camera 8.*--freed-camera"),
        (packet(b5=0x2E), r"entry 1: tilt: expected at most 90, found 92"),
        ("pan,tilt,z\n1,2,15000\n", "entry 1: z_m: expected at most 300.*state the unit"),
        ("pan,tilt,focal_px\n1,2,0\n", "entry 1: focal_px: .* at least 1, found 0"),
        ("pan,tilt\n1,2\n1,x\n", r"column tilt: entry 2: expected a number, found 'x'"),
        ("pan,x\n1,2\n", "columns pan, tilt"),
        ("pan,tilt,pan (deg)\n1,2,3\n", "every column once"),
        ("frame,pan,tilt\n3.5,1,1\n", "whole numbers"),
        ("frame,pan,tilt\n3,1,1\n3,1,1\n", "entry 2: expected frames that rise"),
        ("timecode,pan,tilt\n10:00:00:25,1,1\n", "HH:MM:SS:FF at 25"),
        ("pan,tilt,focal_mm\n1,2,50\n", "focal_mm with sensor_width_mm"),
        ("pan,tilt,fov,focal_px\n1,2,50,9\n", "Keep one"),
    ],
)
def test_what_cannot_be_right_is_refused_with_its_place(tmp_path, content, message):
    with pytest.raises(InputError, match=f"(?s){message}"):
        read(tmp_path, content)


def test_tables_have_units_time_codes_and_decimal_commas(tmp_path):
    table = (
        "TC;Pan (deg);tilt_deg;Roll;X [mm];y_cm;Pos Z;FOV;K1;K2;Iris\n"
        "09:59:59:24;1,5;-2;0;1000;200;3;90;0,1;0,2;4\n"
        "10:00:00:01;1,5;-2;;;;;90;;;4\n"
    )
    data = read(tmp_path, table.encode("utf-16"), first=7)
    assert data.frame.tolist() == [7, 9]
    np.testing.assert_allclose(
        data.values[0], [1.5, -2, 0, 1, 2, 3, 960, 0.1, 0.2, np.nan, np.nan, np.nan]
    )
    assert np.isnan(data.values[1, [2, 3, 4, 5, 7, 8]]).all()
    assert any("left out: Iris" in note for note in data.notes)
    dropped = "timecode,pan,tilt\n00:00:59;29,0,0\n00:01:00;02,0,0\n"
    file = tmp_path / "dropped.csv"
    file.write_text(dropped)
    assert read_camera_data(file, 29.97, SIZE).frame.tolist() == [0, 1]
    wide = "pan,tilt,focal_mm,sensor_width_mm,zoom\n1,2,96,9.6,5\n"
    assert read(tmp_path, wide).values[0, 6] == 19200.0


def test_what_is_written_is_read_again_and_a_lens_table_gives_focal_lengths(tmp_path):
    data = read(tmp_path, PACKET + packet(b21=0x20) + packet(b21=0x40))
    lens = tmp_path / "lens.csv"
    lens.write_text("zoom,focal_px\n9000,1000\n4000,2000\n")
    focal = apply_zoom_table(data, lens, SIZE)
    np.testing.assert_allclose(focal.values[:2, 6], [1868.0, 1151.2])  # counts 4660 and 8244
    assert np.isnan(focal.values[2, 6])
    assert any("1 rows" in note for note in focal.notes)
    write_camera_data(tmp_path / "again.csv", focal)
    again = read_camera_data(tmp_path / "again.csv", 25.0, SIZE)
    np.testing.assert_allclose(again.values, focal.values, rtol=1e-8)
    assert [*COLUMNS[7:9]] == ["k1", "k2"]
    assert "k1" not in (tmp_path / "again.csv").read_text()
    lens.write_text("zoom,focal_px\n1,5\n2,5\n")
    with pytest.raises(InputError, match="only rises or only falls"):
        apply_zoom_table(data, lens, SIZE)


CALIBRATION = calibration(
    "north",
    **{"focal_px": (2000.0, 2010.0), "principal_point_px": (955.0, 541.0)},
    **{"distortion": (-0.1, 0.02, 0.001, -0.002, 0.003), "translation": (1.0, 5.0, 60.0)},
)


def test_what_was_written_is_read_again(tmp_path):
    write_static_camera(tmp_path / "north.npz", CALIBRATION)
    camera = read_camera(tmp_path / "north.npz", (1920, 1080))
    assert (camera.batch_shape, camera.to_calibration("north")) == ((), CALIBRATION)


def moving(rows=3):
    k = np.tile(np.eye(3), (rows, 1, 1))
    k[:, 0, 0] = k[:, 1, 1] = 2000.0 + 10.0 * np.arange(rows)
    k[:, :2, 2] = 960.0, 540.0
    return {
        "K": k,
        "k": np.zeros((rows, 5)),
        "R": np.tile(np.array(CALIBRATION.rotation), (rows, 1, 1)),
        "t": np.tile(np.array([1.0, 5.0, 60.0]), (rows, 1)),
    }


def test_a_moving_camera_has_one_row_a_frame(tmp_path):
    write_archive(tmp_path / "clip.npz", moving())
    camera = read_camera(tmp_path / "clip.npz")
    assert camera.batch_shape == (3,)
    assert camera.focal[:, 1].tolist() == [2000.0, 2010.0, 2020.0]
    assert camera.image_size[0].tolist() == [1920, 1080]


@pytest.mark.parametrize(
    ("middle", "size"), [((960.0, 600.0), (1920, 1080)), ((639.5, 359.5), (1280, 720))]
)
def test_a_principal_point_off_alike_along_both_axes_tells_the_size(tmp_path, middle, size, caplog):
    arrays = moving()
    arrays["K"][:, :2, 2] = middle
    write_archive(tmp_path / "clip.npz", arrays)
    assert read_camera(tmp_path / "clip.npz").image_size[0].tolist() == [*size]
    assert ("the middle of about 1280 x 720 px" in caplog.text) == (size == (1280, 720))


@pytest.mark.parametrize(
    ("member", "index", "value", "message"),
    [
        ("K", (1, 0, 1), 3.0, r"K\[1\]: expected \[\[fx, 0, cx\]"),
        ("K", (2, 1, 1), -5.0, r"K\[2\]: .* positive focal lengths"),
        ("K", (0, 2, 2), 2.0, r"K\[0\]"),
        ("R", (1, 0, 0), 1.1, r"R\[1\]: expected an orthonormal matrix"),
    ],
)
def test_numbers_that_are_no_camera_are_refused(tmp_path, member, index, value, message):
    arrays = moving()
    arrays[member][index] = value
    write_archive(tmp_path / "clip.npz", arrays)
    with pytest.raises(InputError, match=message):
        read_camera(tmp_path / "clip.npz")


def test_rows_must_agree_and_exist(tmp_path):
    write_archive(
        tmp_path / "clip.npz", {**moving(), "R": moving()["R"][:1], "t": np.zeros((1, 3))}
    )
    with pytest.raises(InputError, match=r"clip\.npz: R: expected shape"):
        read_camera(tmp_path / "clip.npz")
    write_archive(tmp_path / "clip.npz", moving(0))
    with pytest.raises(InputError, match="one row, or one a frame"):
        read_camera(tmp_path / "clip.npz")
