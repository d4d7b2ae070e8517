"""Calibrate one static camera from clicks on pitch markings, and say how good it is.

    worldpose simulate --scenario tiny --seed 1 --duration 1 --out match
    python examples/calibrate_camera.py match/annotations/static_calibration/cam00.json 1920 1080 \
        match/stills/cam00.png

The JSON file has `points`, a list of {"name", "xy"}, and may have `drawn`, pixels along named
markings (docs/reference/match_folder.md). The still lets painted lines refine the
camera; leave it out if there is none.
"""

import sys
from pathlib import Path

import numpy as np

import worldpose as wp


def main() -> None:
    """Calibrate the camera and print its parameters, residuals and expected error."""
    clicks, width, height, *still = sys.argv[1:]
    size = (int(width), int(height))
    clicked = wp.ClickedMarkings.model_validate_json(Path(clicks).read_bytes())
    pitch = wp.PitchTemplate.from_spec(wp.PitchSpec())  # 105 x 68 m, or the surveyed points
    picture = wp.read_still(still[0], size) if still else None
    found = wp.calibrate_camera(pitch, clicked, size, picture=picture, where=clicks)

    camera, report = found.estimate.camera, found.report
    print(f"center {camera.center.round(2)} m, focal length {camera.focal[0]:.0f} px")
    print(f"lens {camera.coefficients.round(3)}")
    for point in report.points:
        state = "" if point.inlier else f"  left out: {point.problem}"
        print(f"{np.hypot(*point.residual):8.2f} px  {point.name}{state}")
    error = report.ground_error
    print(f"expected error on the ground: median {error.median:.3f} m, 95 % {error.p95:.3f} m")
    if report.weak:
        print("weak: " + " ".join(report.reasons))


if __name__ == "__main__":
    main()
