"""The digest of a folder of images, on which a result depends."""

from data_contracts.match import CameraSpec, ClipSpec, MatchSpec, Registration, SourceFile


def test_a_folders_digest_is_of_the_names_and_contents_below_it():
    def files(**contents):
        paths = {name.replace("_", "/") + ".png": digit * 64 for name, digit in contents.items()}
        listed = [
            SourceFile(path=path, size=1, modified_ns=1, sha256=digest)
            for path, digest in paths.items()
        ]
        camera = CameraSpec(id="cam00", width=1920, height=1080)
        clip = ClipSpec(id="clip", first_frame=0, frame_count=2)
        spec = MatchSpec(match_id="m", fps=50, cameras=[camera], clips=[clip])
        return Registration(spec=spec, folder="m", identity="b" * 64, files=listed)

    first = files(videos_cam00_1="1", videos_cam00_2="2", videos_cam01_1="1")
    assert first.digest_of("videos/cam00/1.png") == "1" * 64
    assert first.digest_of("videos/cam0") is None
    assert first.digest_of("videos/cam00") != first.digest_of("videos/cam01")
    for other in (
        files(videos_cam00_1="1", videos_cam00_3="2"),
        files(videos_cam00_1="1", videos_cam00_2="3"),
        files(videos_cam00_1="1"),
    ):
        assert other.digest_of("videos/cam00") != first.digest_of("videos/cam00")
    moved = files(videos_cam01_1="1", videos_cam01_2="2")
    assert moved.digest_of("videos/cam01") == first.digest_of("videos/cam00")
