"""Prints what a lens that was calibrated before gains for a camera of few clicks.

    python benchmarks/lens_prior.py [--seeds 10]

Simulated wide cameras (k1 -0.3, k2 0.12, tangential terms, principal point 29 px off), clicks of 1
px; the lens is known to 0.5 % of its focal length, 3 px, and 0.1 % of the corner's distance. Errors
on the pitch with and without it: median and 95 % of 200 places, medians over the seeds.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "unit" / "static_calibration"))

from clicking_people import (
    PITCH,
    SIZE,
    click,
    ground_errors,
    lens_of,
    on_the_pitch,
    wide_camera,
)

from worldpose.static_calibration.calibration import calibrate_camera


def main() -> None:
    """Print one line per number of clicks."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    seeds = parser.parse_args().seeds
    print("clicks   with the lens: median, 95 % [m]   without")
    for count in (5, 6, 9):
        errors = np.empty((seeds, 2, 2))
        for seed in range(seeds):
            camera, rng = wide_camera(seed)
            clicked = click(camera, rng, count=count).clicked
            lens, places = lens_of(camera, rng), on_the_pitch(rng, 200)
            for row, given in enumerate((lens, None)):
                found = calibrate_camera(PITCH, clicked, SIZE, lens=given)
                off = ground_errors(found.estimate.camera, camera, places)
                errors[seed, row] = np.quantile(off, [0.5, 0.95])
        (median, most), (other, farthest) = np.median(errors, axis=0)
        print(f"{count:6d}   {median:.2f}, {most:.2f}   {other:.2f}, {farthest:.2f}", flush=True)


if __name__ == "__main__":
    main()
