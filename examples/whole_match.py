"""Reconstruct a match folder in one script: from clicks and 2D poses (or videos) to bodies.

    worldpose simulate --scenario tiny --seed 1 --duration 1 --out match
    python examples/whole_match.py match joints.npz

`worldpose run match` gives the same bodies, and adds checks, review, reruns and lineage.
"""

import sys

import numpy as np

import worldpose as wp


def main() -> None:
    """Reconstruct the match."""
    folder, out = sys.argv[1:]
    match = wp.read_match(folder)
    names, fps = [camera.id for camera in match.spec.static_cameras], match.spec.fps
    pitch = wp.PitchTemplate.from_spec(match.pitch or wp.PitchSpec())

    calibrations = []
    for name in names:
        spec = match.spec.camera(name)
        size = (spec.width, spec.height)
        still = wp.read_still(match.stills[name], size) if name in match.stills else None
        calibrations.append(wp.calibrate_camera(pitch, match.clicked[name], size, picture=still))
    cameras = wp.Camera.stack([known.estimate.camera for known in calibrations])
    covariance = np.stack([known.estimate.covariance for known in calibrations])

    seen = wp.KeypointDetections.stack([find_people(match, name) for name in names])
    extent = (pitch.length, pitch.width)
    tracks = wp.track_people(cameras, seen, fps, pitch_size=extent, camera_covariance=covariance)
    people = seen.assign_people(tracks.detection_index)
    first = wp.reconstruct_joints(cameras, people, fps, camera_covariance=covariance)

    adjusted = wp.adjust_cameras(
        wp.Clip(
            cameras=cameras,
            covariance=covariance,
            clicks=tuple(wp.Clicks.of(known, pitch) for known in calibrations),
            fps=fps,
            detections=people,
            joints=first.triangulation.joints,
            views=first.triangulation.views,
            triangulation=wp.TriangulationSettings(),
            pitch=pitch,
            on_lines=np.array([known.report.stage == "lines" for known in calibrations]),
        )
    )
    print(f"{adjusted.accepted.sum()} of {len(names)} cameras adjusted to people")
    cameras = adjusted.cameras
    joints = wp.reconstruct_joints(
        cameras, people, fps, camera_covariance=adjusted.covariance
    ).triangulation

    unswapped = wp.undo_swaps(people, joints.exchanged)
    rays = wp.find_ray_constraints(cameras, unswapped, joints.joints)
    alike = joints.shared_covariance
    evidence = wp.ClipEvidence(
        joints.joints, joints.covariance, fps, joints.common_bias, [rays], shared_covariance=alike
    )
    bodies = wp.fit_bodies(wp.find_body(), evidence, ground=pitch.height)
    tracked = wp.JointTracks(seen.frame, tracks.person, bodies.joints, bodies.covariance)
    wp.write_joints(out, tracked)
    print(f"{len(tracks.person)} people in {len(seen.frame)} frames: {out}")


def find_people(match: wp.MatchFolder, name: str) -> wp.KeypointDetections:
    """Return a camera's given 2D poses, or those that the bundled nets find in its video."""
    if name in match.detections:
        return wp.read_unit(match, name)[0]
    with wp.open_video(match.videos[name]) as video:
        return wp.detect_people(image for _, image in video.frames())


if __name__ == "__main__":
    main()
