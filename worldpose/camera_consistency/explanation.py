"""Descriptions of inconsistent cameras for users."""

from __future__ import annotations

from collections.abc import Sequence

from data_contracts.camera_consistency import CameraFault
from worldpose.camera_consistency.diagnosis import Consistency, Fault


def faulty_cameras(found: Consistency) -> set[int]:
    """Return the indices of cameras with a known fault.

    If two cameras contradict each other, it is unknown which one is wrong.
    """
    return {fault.camera for fault in found.faults if fault.kind != "contradiction"}


def describe_faults(
    found: Consistency, cameras: Sequence[str], offset_frames: Sequence[int], fps: float
) -> tuple[CameraFault, ...]:
    """Return the faults with the cameras' names and a reason that says what to do.

    Args:
        found: result of the consistency check.
        cameras: ids in the order of the cameras.
        offset_frames: stated offset of each camera's video [frame].
        fps: frames per second of the match [1/s].
    """
    return tuple(
        CameraFault(
            camera=cameras[fault.camera],
            kind=fault.kind,
            reason=_reason(fault, cameras, offset_frames[fault.camera], fps),
            value=fault.value,
            other=None if fault.other is None else cameras[fault.other],
            share_now=fault.share_now,
            share_corrected=fault.share_corrected,
        )
        for fault in found.faults
    )


def _reason(fault: Fault, cameras: Sequence[str], offset: int, fps: float) -> str:
    """Return one sentence: the fault, the correction, and the share of detections in support."""
    other = "" if fault.other is None else cameras[fault.other]
    if fault.kind == "contradiction":
        cause = _cause(fault, fault.cause or "pose", fault.detail, other, offset, fps)
        return (
            f"it contradicts camera {other}, and two cameras cannot tell which of them is wrong. "
            f"They agree if this holds for camera {cameras[fault.camera]}: {cause}"
        )
    said = _cause(fault, fault.kind, fault.detail, other, offset, fps)
    if fault.share_corrected:
        said += (
            f". With that corrected {fault.share_corrected:.0%} of its detections agree with the "
            f"other cameras, now {fault.share_now:.0%}"
        )
    return said


def _cause(fault: Fault, kind: str, detail: str, other: str, offset: int, fps: float) -> str:
    """Return the fault and its correction in words."""
    value = fault.value or 1.0
    if kind == "clock":
        late = "later" if value < 0 else "earlier"
        return (
            f"it shows {abs(value):.0f} frames {late} than the others: set its offset_frames to "
            f"{offset + round(value)} in match.yaml"
        )
    if kind == "frame_rate":
        return (
            f"its video has about {value * fps:.3g} frames per second, not {fps:g}: convert it, or "
            "correct its frame numbers"
        )
    return {
        "flipped": "its calibration is rotated by 180 degrees about the centre spot: check whether "
        "its clicks have the names of the other end of the pitch",
        "mirrored": f"it is mirrored: {detail}. Correct its clicks, calibration or images",
        "focal": f"its focal length is {value:.3g} times that which the other cameras show: "
        "correct its calibration",
        "lens": f"its distortion is wrong: {detail}. worldpose reads k1 k2 p1 p2 k3",
        "swapped": f"its video is that of camera {other}: exchange the two files",
        "duplicate": f"its video is the same as that of camera {other}: give its own",
        "pose": f"its calibration is wrong: {detail}"
        if detail
        else "it does not see the people whom the other cameras see in its image: check its "
        "calibration, clock and video",
    }[kind]
