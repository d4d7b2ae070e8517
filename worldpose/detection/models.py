"""Detectors and pose estimators by their names in the settings, and digests of their weights."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

from worldpose.detection.flip_test import Mirrored
from worldpose.detection.interfaces import Detector, PoseEstimator
from worldpose.detection.settings import DetectionSettings
from worldpose.errors import InputError
from worldpose.ingest.registration import digest_of_files

LIBRARIES: Final = {
    "embedded": ("torch",),
    "transformers": ("torch", "transformers"),
    "onnx": ("onnxruntime",),
}
"""Libraries that compute each kind of net: their versions affect results."""


def load_detectors(settings: DetectionSettings) -> list[Detector]:
    """Return the detectors that the settings name.

    Raises:
        InputError: an unknown kind, missing or unexpected weights, or a library that is not
            installed.
    """
    return [_detector(name, settings) for name in settings.detector]


def load_pose(settings: DetectionSettings) -> PoseEstimator:
    """Return the pose estimator that the settings name; raises as `load_detectors`."""
    estimator = _pose(settings)
    return Mirrored(estimator) if settings.flip_test else estimator


def _pose(settings: DetectionSettings) -> PoseEstimator:
    kind, path = _parted(settings.pose)
    if kind == "embedded":
        from worldpose.detection.bundled import embedded_pose

        return embedded_pose(path, settings.device, settings.half)
    assert path is not None  # as parted
    if kind == "onnx":
        from worldpose.detection.onnx_pose import onnx_pose

        return onnx_pose(path, settings.device)
    from worldpose.detection.transformers_models import transformers_pose

    return transformers_pose(path, settings.device, settings.half)


def _detector(name: str, settings: DetectionSettings) -> Detector:
    kind, path = _parted(name)
    if kind == "embedded":
        from worldpose.detection.bundled import embedded_detector

        return embedded_detector(path, settings.device, settings.half)
    assert path is not None  # as parted
    if kind == "onnx":
        from worldpose.detection.onnx_detectors import onnx_detector

        return onnx_detector(path, settings.device)
    from worldpose.detection.transformers_models import transformers_detector

    return transformers_detector(path, settings.device, settings.half)


def weights_of(settings: DetectionSettings) -> dict[str, str | None]:
    """Return SHA-256 of the named weights, and versions of the libraries that compute them.

    The embedded weights are part of the code and have no digest.

    Raises:
        InputError: an unknown kind, or missing weights.
    """
    names = (*settings.detector, settings.pose)
    found: dict[str, str | None] = {}
    for name in names:
        kind, path = _parted(name)
        found[name] = None if path is None else digest_of_weights(path)
        for library in LIBRARIES[kind]:
            try:
                found[library] = version(library)
            except PackageNotFoundError:
                found[library] = None
    return found


def digest_of_weights(path: Path) -> str:
    """Return SHA-256 of a file, or of all files of a folder with their names.

    Raises:
        InputError: the path does not exist.
    """
    if not path.exists():
        raise InputError(
            str(path),
            expected="the weights that detection.detector or detection.pose names",
            found="nothing",
            todo="Put them there, or correct the name. Relative names begin where you are.",
        )
    return digest_of_files(path)


def _parted(name: str) -> tuple[str, Path | None]:
    """Return the kind of a model and the path of its weights; None for those that ship."""
    kind, colon, path = name.partition(":")
    if kind not in LIBRARIES or (colon and not path) or (kind != "embedded" and not path):
        raise InputError(
            f"detection: {name!r}",
            expected="embedded, embedded:FILE, transformers:FOLDER or onnx:FILE",
            found=repr(name),
            todo="Correct detection.detector or detection.pose.",
        )
    return kind, Path(path).expanduser().resolve() if path else None
