"""Camera data of a tracking system in the fit of a clip: key frames, prior and comparison."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from data_contracts.arrays import Floats, Integers
from data_contracts.broadcast_calibration import KeyFrame
from data_contracts.static_calibration import ClickedMarkings, DrawnMarking
from worldpose.broadcast_calibration.moving_camera import MovingCamera
from worldpose.broadcast_calibration.priors import Prior, build_prior
from worldpose.broadcast_calibration.settings import BroadcastPrior
from worldpose.formats.camera_data import COLUMNS, CameraData
from worldpose.geometry.pan_tilt import camera_angles, rotation_of_angles
from worldpose.pitch.template import PitchTemplate


@dataclass(frozen=True, eq=False)
class GivenCamera:
    """Camera data in each frame of a clip.

    Attributes:
        values: (frames, 12) as `worldpose.formats.camera_data.COLUMNS`; NaN where not stated.
        leads: whether the key frames of the clip come from these data.
    """

    values: Floats
    leads: bool = False

    @classmethod
    def of(cls, data: CameraData, images: Integers) -> GivenCamera:
        """Return the data of a clip with images of these numbers (frames,)."""
        values = np.full((len(images), len(COLUMNS)), np.nan)
        inside = np.isin(images, data.frame)
        values[inside] = data.values[np.searchsorted(data.frame, images[inside])]
        return cls(values)

    @property
    def principal_point(self) -> Floats | None:
        """(2,) [px], the median of the stated ones; None where none is stated."""
        stated = self.values[np.isfinite(self.values[:, 10:12]).all(axis=1), 10:12]
        return np.median(stated, axis=0) if len(stated) else None

    def camera(self, image_size: ArrayLike, settings: BroadcastPrior) -> MovingCamera:
        """Return the camera, with roll 0, the median center and the usual lens if not stated."""
        size = np.asarray(image_size, dtype=np.int64)
        lens = build_prior(settings, self.values[:, 6], size).distortion
        lens[:, :2] = np.where(np.isfinite(self.values[:, 7:9]), self.values[:, 7:9], lens[:, :2])
        center = self.values[np.isfinite(self.values[:, 3:6]).all(axis=1), 3:6]
        pan, tilt, roll = self.values[:, :3].T
        middle = self.principal_point
        return MovingCamera(
            center=np.median(center, axis=0) if len(center) else np.full(3, np.nan),
            principal_point=np.asarray(
                0.5 * (size - 1.0) if middle is None else middle, np.float64
            ),
            rotation=rotation_of_angles(pan, tilt, np.nan_to_num(roll)),
            focal=self.values[:, 6],
            distortion=lens,
            image_size=size,
        )

    def add_to(self, prior: Prior, image_size: ArrayLike, settings: BroadcastPrior) -> Prior:
        """Return a prior of the clip's frames with these data.

        Their errors last for the whole clip, so that its frames count as one together.
        """
        given, lasting = self.camera(image_size, settings), np.sqrt(len(self.values))
        turned, zoomed = np.isfinite(given.rotation[:, 0, 0]), np.isfinite(given.focal)
        std = lasting * np.radians(settings.given_rotation_std_deg)
        if np.isfinite(given.center).all():
            information = np.eye(3) / settings.given_center_std_m**2
            prior = replace(prior, center=given.center, center_information=information)
        if self.principal_point is not None:
            # Stated principal points are those of a calibrated lens [px].
            prior = replace(
                prior, principal_point=self.principal_point, principal_std=np.full(2, 1.0)
            )
        return replace(
            prior,
            log_focal=np.where(zoomed, np.log(given.focal), prior.log_focal),
            log_focal_std=np.where(
                zoomed, lasting * settings.given_log_focal_std, prior.log_focal_std
            ),
            distortion=np.where(np.isfinite(given.distortion), given.distortion, prior.distortion),
            rotation=np.where(turned[:, None, None], given.rotation, np.eye(3)),
            rotation_std=np.where(turned, std, np.inf),
        )

    def propose_key_frames(
        self, pitch: PitchTemplate, image_size: ArrayLike, settings: BroadcastPrior
    ) -> list[KeyFrame]:
        """Return key frames with the markings as these data project them; frames count from 0.

        There are none without angles, place and focal length.
        """
        # Key frames, spread over the clip; pixels of a marking; least markings of a key frame.
        most, each, least = 8, 12, 2
        camera, found = self.camera(image_size, settings), []
        known = np.flatnonzero(~np.isnan(camera.rows).any(axis=1))
        for frame in known[np.linspace(0, len(known) - 1, min(len(known), 4 * most)).astype(int)]:
            drawn = []
            for name in (*pitch.lines, *pitch.arcs):
                pixels = camera.camera[frame].project(pitch.marking_points(name, 0.5))
                with np.errstate(invalid="ignore"):
                    inside = ((pixels >= 0.0) & (pixels <= camera.image_size - 1.0)).all(axis=-1)
                xy = [(u, v) for u, v in pixels[inside].tolist()]
                if len(xy) > 1:
                    some = tuple(xy[:: max(1, len(xy) // each)])
                    drawn.append(DrawnMarking(name=name, xy=some))
            if len(drawn) >= least:
                markings = ClickedMarkings(drawn=tuple(drawn))
                found.append(KeyFrame(frame=int(frame), markings=markings))
        chosen = np.linspace(0, len(found) - 1, min(len(found), most)).astype(int)
        return [found[k] for k in chosen]

    def compare(self, camera: MovingCamera) -> dict[str, Floats]:
        """Return what these data state minus a camera of the same frames, by name and unit.

        Angles differ by at most half a turn; the place by a distance.
        """
        off = self.values[:, :3] - np.stack(camera_angles(camera.camera), axis=1)
        off = (off + 180.0) % 360.0 - 180.0
        return {
            **dict(zip(("pan [deg]", "tilt [deg]", "roll [deg]"), off.T, strict=True)),
            "focal length [%]": 100.0 * (self.values[:, 6] / camera.focal - 1.0),
            "center [m]": np.linalg.norm(self.values[:, 3:6] - camera.center, axis=1),
        }

    def contradiction(self, keys: MovingCamera, frames: Integers, settings: BroadcastPrior) -> str:
        """Return how these data contradict cameras of frames, beyond three deviations."""
        limits = [settings.given_rotation_std_deg] * 3
        limits += [100.0 * settings.given_log_focal_std, settings.given_center_std_m]
        compared = GivenCamera(self.values[frames]).compare(keys).items()
        return ", ".join(
            f"{name} {np.nanmedian(off):+.2f}"
            for (name, off), limit in zip(compared, limits, strict=True)
            if np.isfinite(off).any() and abs(np.nanmedian(off)) > 3.0 * limit
        )

    def describe(self, camera: MovingCamera) -> list[str]:
        """Return sentences on how these data differ from a camera of the same frames."""
        sentences = [
            f"camera data minus this camera: {name} {np.nanmedian(off):+.3f} (median), within "
            f"{np.nanpercentile(np.abs(off - np.nanmedian(off)), 95.0):.3f} of it in 95 % of frames"
            for name, off in self.compare(camera).items()
            if np.isfinite(off).any()
        ]
        zoom, known = self.values[:, 9], np.isfinite(self.values[:, 9])
        if known.any() and np.ptp(zoom[known]) > 0.0:
            ranks = [np.argsort(np.argsort(each[known])) for each in (zoom, camera.focal)]
            agree = float(np.corrcoef(ranks[0], ranks[1])[0, 1])
            sentences.append(f"rank correlation of zoom counts and focal length: {agree:+.3f}")
        return sentences
