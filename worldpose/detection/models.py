"""Detectors and pose estimators by their names in the settings, and digests of their weights."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable, Hashable
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any, Final, Literal, TypeVar

from data_contracts.checkpoint import Checkpoint
from worldpose.cache_folder import user_cache
from worldpose.detection.interfaces import Detector, PoseEstimator, ScoreMap
from worldpose.detection.settings import DetectionSettings
from worldpose.detection.views import FlipTest
from worldpose.errors import InputError, UsageError
from worldpose.formats.files import read_json
from worldpose.ingest.registration import digest_of_files
from worldpose.ingest.validation import validate_record

if TYPE_CHECKING:
    from worldpose.detection.landmark_net import LandmarkEstimator

Loaded = TypeVar("Loaded")
Task = Literal["detector", "pose"]

LIBRARIES: Final = {
    "embedded": ("torch", "onnxruntime"),
    "transformers": ("torch", "transformers"),
    "onnx": ("onnxruntime",),
}
"""Libraries that compute each kind of net: their versions affect results."""


BUNDLED_WEIGHTS: Final = (
    Path(__file__).with_name("embedded_people.safetensors"),
    Path(__file__).with_name("embedded_keypoints.safetensors"),
)
"""Shipped weights of the bundled detector and of the bundled pose estimator."""

LANDMARK_WEIGHTS: Final = Path(__file__).with_name("embedded_landmarks.safetensors")
"""Shipped weights of the net of landmarks."""

SHIPPED_SCORE_MAP: Final = ScoreMap(slope=4.0, offset=-0.42)
"""Map of stored scores of the shipped pair of nets (infra/embedded_detector/score_map.py)."""


PULLED_RECORD: Final = "model.json"
"""File of a pulled checkpoint with its `Checkpoint`, next to the folder `PULLED_FILES`."""
PULLED_FILES: Final = "files"


def model_folder() -> Path:
    """Return the folder of pulled checkpoints: WORLDPOSE_MODEL_FOLDER, or in the user's cache.

    UsageError if neither is there.
    """
    given = os.environ.get("WORLDPOSE_MODEL_FOLDER")
    if given:
        return Path(given).expanduser().resolve()
    cache = user_cache()
    if cache is None:
        raise UsageError(
            "WORLDPOSE_MODEL_FOLDER",
            expected="the folder of models, as this user has no home folder",
            found="no such variable",
            todo="Set it, for example to /data/models.",
        )
    return cache.resolve() / "worldpose" / "models"


def read_pulled(name: str, folder: Path) -> Checkpoint | None:
    """Return the record of a pulled checkpoint; None if it is not in the folder."""
    file = folder / name / PULLED_RECORD
    if not file.is_file():
        return None
    return validate_record(Checkpoint, read_json(file), str(file))


_NETS: Final[dict[Hashable, Any]] = {}
_LOADING: Final = Lock()


def _share(load: Callable[[], Loaded], name: str, path: Path | None, *how: Hashable) -> Loaded:
    """Return what was loaded last by the same name from the same files, else what `load` returns.

    Nets have no state, so all units of a process use the same ones.
    """
    files = [] if path is None else sorted(path.rglob("*")) if path.is_dir() else _net_files(path)
    stamps = [
        (each, each.stat().st_mtime_ns, each.stat().st_size) for each in files if each.exists()
    ]
    key = (name, *stamps, *how)
    with _LOADING:
        if key not in _NETS:
            if len(_NETS) == 4:  # nets of two kinds of runs
                del _NETS[next(iter(_NETS))]
            _NETS[key] = load()
        loaded: Loaded = _NETS[key]
        return loaded


def load_detectors(settings: DetectionSettings) -> list[Detector]:
    """Return the detectors that the settings name.

    InputError for an unknown kind, missing or unexpected weights, or a library that is not
    installed.
    """
    how = settings.device, settings.half, settings.person_classes
    return [
        _share(partial(_detector, kind, path, settings), kind, path, *how)
        for kind, path in (_split_name(name, "detector") for name in settings.detector)
    ]


def load_pose(settings: DetectionSettings) -> PoseEstimator:
    """Return the pose estimator that the settings name; raises as `load_detectors`."""
    kind, path = _split_name(settings.pose, "pose")
    how = settings.device, settings.half
    estimator = _share(partial(_pose, kind, path, settings), f"pose {kind}", path, *how)
    return FlipTest(estimator) if settings.flip_test else estimator


def load_score_map(settings: DetectionSettings) -> ScoreMap | None:
    """Return the map of stored scores to probabilities; None for nets whose map is not known.

    It is known for the shipped detector alone with the shipped pose estimator.
    """
    shipped = settings.detector == ("embedded",) and settings.pose == "embedded"
    return SHIPPED_SCORE_MAP if shipped else None


def _pose(kind: str, path: Path | None, settings: DetectionSettings) -> PoseEstimator:
    if kind == "embedded":
        return load_bundled_pose(path, settings.device, settings.half)
    assert path is not None  # as parted
    if kind.startswith("onnx"):  # of a catalog's entry, with any form
        from worldpose.detection.onnx_nets import load_onnx_pose

        return load_onnx_pose(path, settings.device)
    from worldpose.detection.transformers_nets import TransformersPose

    return TransformersPose(path, settings.device, settings.half)


def _detector(kind: str, path: Path | None, settings: DetectionSettings) -> Detector:
    if kind == "embedded":
        return load_bundled_detector(path, settings.device, settings.half)
    assert path is not None  # as parted
    if kind.startswith("onnx"):
        from worldpose.detection.onnx_detectors import load_onnx_detector

        form = kind.partition("-")[2] or None
        return load_onnx_detector(path, settings.device, form, settings.person_classes)
    from worldpose.detection.transformers_nets import TransformersDetector

    return TransformersDetector(path, settings.device, settings.half, settings.person_classes)


def load_bundled_detector(
    weights: Path | None = None, device: str = "cpu", half: bool = False
) -> Detector:
    """Return the bundled detector, of the shipped weights or a file of a fine-tuned version.

    On a CPU the shipped version computes in integers, a fine-tuned one in floating point. The
    device is `cpu` or `cuda`, where it may compute in half precision. InputError for another net's
    weights, or if torch is not installed.
    """
    net = _bundled_net("PeopleNet", BUNDLED_WEIGHTS[0], weights, device)
    from worldpose.detection.bundled_detector import BundledDetector

    return BundledDetector(net, device, half)


def load_bundled_pose(
    weights: Path | None = None, device: str = "cpu", half: bool = False
) -> PoseEstimator:
    """Return the bundled pose estimator; arguments and errors are those of the detector."""
    net = _bundled_net("KeypointNet", BUNDLED_WEIGHTS[1], weights, device)
    from worldpose.detection.bundled_pose import BundledPoseEstimator

    return BundledPoseEstimator(net, device, half)


def load_landmarks(settings: DetectionSettings) -> LandmarkEstimator | None:
    """Return the estimator of landmarks; None if the settings ask for none.

    On a CPU it computes in integers. InputError if torch is not installed.
    """
    if not settings.landmarks:
        return None
    net = _bundled_net("LandmarkNet", LANDMARK_WEIGHTS, None, settings.device)
    from worldpose.detection.landmark_net import LandmarkEstimator

    return LandmarkEstimator(net, settings.device, settings.half)


def _bundled_net(kind: str, shipped: Path, weights: Path | None, device: str) -> Any:  # noqa: ANN401
    """Return a net by the name of its class; the shipped one computes in integers on a CPU."""
    try:
        from worldpose.detection import bundled_nets, landmark_net
        from worldpose.detection.net_inference import QuantizedNet
    except ImportError as error:
        raise InputError(
            "bundled nets",
            expected="torch and safetensors",
            found=str(error),
            todo="Install worldpose[detectors].",
        ) from error
    if weights is None and device == "cpu":
        return QuantizedNet(shipped.with_suffix(".onnx"))
    module = landmark_net if kind == "LandmarkNet" else bundled_nets
    return bundled_nets.load_weights(weights or shipped, getattr(module, kind)())


def weights_of(settings: DetectionSettings) -> dict[str, str | None]:
    """Return SHA-256 of the named weights, and versions of the libraries that compute them.

    The embedded weights are part of the code and have no digest. InputError as of `load_detectors`.
    """
    names: list[tuple[str, Task]] = [(name, "detector") for name in settings.detector]
    names += [(settings.pose, "pose")]
    names += [("embedded", "pose")] if settings.landmarks else []
    found: dict[str, str | None] = {}
    for name, task in names:
        kind, path = _split_name(name, task)
        found[name] = None if path is None else digest_of_weights(path)
        for library in LIBRARIES[kind.partition("-")[0]]:
            found[library] = _installed_version(library)
    return found


@cache
def _installed_version(library: str) -> str | None:
    try:
        return version(library)
    except PackageNotFoundError:
        return None


def digest_of_weights(path: Path) -> str:
    """Return SHA-256 of a file, or of several files with their names; InputError if it is missing.

    Several are those of a folder, or an ONNX file and its external data.
    """
    if not path.exists():
        raise InputError(
            str(path),
            expected="the weights that detection.detector or detection.pose names",
            found="nothing",
            todo="Put the weights there, or correct the name. A relative path starts at the "
            "working directory.",
        )
    files = [path] if path.is_dir() else _net_files(path)
    if len(files) == 1:
        return digest_of_files(path)
    each = "".join(f"{digest_of_files(file)} {file.name}\n" for file in files)
    return hashlib.sha256(each.encode()).hexdigest()


def _net_files(path: Path) -> list[Path]:
    """Return a file of weights and the files that it names as its external data (ONNX).

    Each tensor outside has an entry of key `location` and, as its value, a path beside the file.
    """
    if not path.is_file():
        return [path]
    names, content = set[bytes](), b""
    with path.open("rb") as file:
        while part := file.read(1 << 24):
            content = content[-150:] + part  # longer than an entry
            # Field 1 is the key, field 2 the value; one byte holds a length below 128.
            entries = re.finditer(rb"\n\x08location\x12([\x01-\x7f])", content)
            names |= {content[at.end() : at.end() + at[1][0]] for at in entries}
    beside = (path.parent / os.fsdecode(name) for name in sorted(names) if b"\0" not in name)
    return [path, *(file for file in beside if file.is_file())]


def _split_name(name: str, task: Task) -> tuple[str, Path | None]:
    """Return the kind of a model and the path of its weights; None for those that ship."""
    kind, colon, path = name.partition(":")
    if kind == "model" and path:
        return _find_pulled(path, task)
    library, dash, _form = kind.partition("-")
    unknown = library not in LIBRARIES or (dash and (library != "onnx" or task == "pose"))
    if unknown or (colon and not path) or (kind != "embedded" and not path):
        raise InputError(
            f"detection: {name!r}",
            expected="embedded, embedded:FILE, model:NAME, transformers:FOLDER, onnx:FILE or, of a "
            "detector, onnx-FORM:FILE",
            found=repr(name),
            todo="Correct detection.detector or detection.pose.",
        )
    return kind, Path(path).expanduser().resolve() if path else None


def _find_pulled(name: str, task: Task) -> tuple[str, Path]:
    """Return kind and path of a pulled checkpoint; InputError if it is none, or of another task."""
    folder = model_folder()
    # A name is never a path.
    known = name == Path(name).name and not name.startswith(".")
    pulled = read_pulled(name, folder) if known else None
    if pulled is None:
        raise InputError(
            f"detection: 'model:{name}'",
            expected=f"a pulled checkpoint in {folder}",
            found="none of this name",
            todo=f"Pull it: worldpose models pull {name}. worldpose models list shows the names.",
        )
    if pulled.task != task:
        raise InputError(
            f"detection.{task}: 'model:{name}'",
            expected=f"a checkpoint of task {task}",
            found=pulled.task,
            todo="Name another. worldpose models list shows the setting of each.",
        )
    files = folder / name / PULLED_FILES
    return pulled.kind, files if pulled.kind == "transformers" else files / pulled.files[0].name
