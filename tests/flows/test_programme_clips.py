"""`worldpose clips`: what it proposes of a programme, and what it cuts out."""

import av
import numpy as np
from command_line import succeed, worldpose

from worldpose.video.files import VideoReader, write_video

FPS = 10.0


def lawn_and_stand():
    """A lawn with white marks, panned over for 5 s, and 3 s of a stand."""
    rng = np.random.default_rng(1)
    wide = np.empty((180, 700, 3), np.uint8)
    wide[:] = (70, 130, 50)
    for y, x in rng.integers([5, 5], [170, 690], (400, 2)):
        wide[y : y + 3, x : x + 4] = 250
    stand = rng.integers(0, 255, (22, 40, 3), dtype=np.uint8).repeat(8, axis=0).repeat(8, axis=1)
    pan = [wide[:, 6 * step : 6 * step + 320] for step in range(50)]
    return [*pan, *(np.pad(stand, ((0, 4), (0, 0), (0, 0))) for _ in range(30))]


def test_a_pan_is_proposed_and_cut_out_as_it_is(tmp_path):
    video, sheet = tmp_path / "programme.mp4", tmp_path / "sheet.png"
    write_video(video, lawn_and_stand(), FPS)
    pan, stand = succeed("clips", video, "--sheet", sheet, "--json").json["shots"]
    assert (pan["first"], pan["stop"], pan["unfit"]) == (0, 50, [])
    # 49 steps of 6 of 320 pixels.
    assert abs(pan["pan_widths"] - 49.0 * 6.0 / 320.0) < 0.02
    assert "too little grass" in stand["unfit"]
    assert sheet.stat().st_size > 1000
    out = tmp_path / "match" / "broadcast" / "goal.mp4"
    clip = succeed("clips", video, "--take", "23:48", "--out", out, "--json").json["clip"]
    assert (clip["id"], clip["frame_count"]) == ("goal", 25)
    with VideoReader(video) as one, VideoReader(out) as two:
        same = two.frame(clip["broadcast_offset_frames"])
        assert np.array_equal(one.frame(23), same)
    # Existing files are not overwritten.
    assert worldpose("clips", video, "--take", "23:48", "--out", out).code == 2


def test_a_programme_that_cannot_be_decoded_is_no_empty_table(tmp_path):
    path = tmp_path / "programme.mp4"
    write_video(path, lawn_and_stand()[:20], FPS)
    with av.open(str(path)) as video:
        places = [(packet.pos, packet.size) for packet in video.demux(video=0) if packet.size]
    content = bytearray(path.read_bytes())
    for place, size in places[10:]:
        content[place : place + size] = bytes(size)
    path.write_bytes(content)
    assert "of 20 images cannot be decoded" in succeed("clips", path).err
    for place, size in places:
        content[place : place + size] = bytes(size)
    path.write_bytes(content)
    failed = worldpose("clips", path)
    assert failed.code == 1 and "none in 20 frames" in failed.err
