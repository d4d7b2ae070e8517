"""Records of which a test states what it is about."""

from collections.abc import Mapping
from datetime import UTC, datetime
from types import SimpleNamespace

from data_contracts.cameras import CameraCalibration
from data_contracts.match import CameraSpec, ClipSpec, MatchSpec
from data_contracts.review import Correction, ReviewRequest
from data_contracts.run import RunRecord
from data_contracts.usability import Usability

AT = datetime(2025, 1, 2, 3, 4, 5, tzinfo=UTC)


def run_record(**stated):
    """Return the record of a complete run without units, but for what is stated."""
    plain = {
        **{"run_id": "0001", "match_id": "m", "parent": None, "state": "complete", "seconds": 1.0},
        **{name: {} for name in ("results", "settings", "overrides", "versions", "figures")},
        **dict.fromkeys(("executed", "reused", "failed", "blocked"), ()),
        **dict.fromkeys(("started_at", "finished_at"), AT),
        "usability": Usability(verdict="usable"),
    }
    return RunRecord(**(plain | stated))


def match_spec(cameras, clips=None, size=(1920, 1080), **stated):
    """Return a match of cameras and clips by name, each with what it has beside plain values."""
    cameras = cameras if isinstance(cameras, dict) else {name: {} for name in cameras}
    plain = {"width": size[0], "height": size[1]}
    return MatchSpec(
        cameras=tuple(CameraSpec(**{"id": name, **plain, **own}) for name, own in cameras.items()),
        clips=tuple(
            ClipSpec(id=name, **own)
            for name, own in (clips or {"clip": {"frame_count": 1}}).items()
        ),
        **{"match_id": "m", "fps": 25.0, **stated},
    )


def calibration(name, **stated):
    """Return a camera that looks along y with z up, but for what is stated."""
    plain = {
        **{"id": name, "image_size": (1920, 1080), "focal_px": (1500.0, 1500.0)},
        **{"principal_point_px": (960.0, 540.0), "distortion": (0.0,) * 5},
        "rotation": ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
        "translation": (0.0, 10.0, 50.0),
    }
    return CameraCalibration(**(plain | stated))


def correction(edit, name="c1", **stated):
    """Return a correction by Ada, but for what is stated."""
    plain = {"id": name, "match_id": "m", "who": "Ada", "made_at": AT, "based_on": {}}
    return Correction(**(plain | {"edit": edit} | stated))


def review_request(name, **stated):
    """Return a question about tracking, but for what is stated."""
    plain = {
        **{"id": name, "match_id": "m", "run_id": "0001", "gate": "tracking", "created_at": AT},
        **{"keys": {}, "contents": {}, "reasons": (), "figures": {}},
    }
    return ReviewRequest(**(plain | stated))


class StubRun(Mapping):
    """Results by name, as an opened run has them."""

    def __init__(self, results, store, **stated):
        self.results, self.store = results, store
        about = {"run_id": "0001", "match_id": "m", "state": "complete"}
        about["results"] = dict.fromkeys(results, "0" * 32)
        about |= {"left_out": {}, "body_folder": None, "usability": Usability(verdict="usable")}
        self.record = SimpleNamespace(**(about | stated))

    def manifest(self, name):
        return SimpleNamespace(recipe=SimpleNamespace(sources={}))

    def __getitem__(self, name):
        return self.results[name]

    def __iter__(self):
        return iter(self.results)

    def __len__(self):
        return len(self.results)
