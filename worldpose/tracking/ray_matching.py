"""Rays of detections: affinity to people by distance, matching on it, and quick 3D joints."""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import linear_sum_assignment

from data_contracts.arrays import ClipArray, Flags, Floats, Integers
from data_contracts.keypoints import KeypointDetections
from worldpose.compiled import compile_kernel
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera

Point = tuple[float, float, float]


def require_clip(
    where: str,
    cameras: Camera,
    detections: KeypointDetections[ClipArray],
    *,
    tracked: bool = False,
    least: int = 0,
) -> None:
    """Require arrays of one clip and of its cameras, of which there are at least so many.

    InputError if the shapes do not match; those of `detection_index` count if people are tracked.
    """
    keypoints, confidence = detections.keypoints.shape, detections.confidence.shape
    index, views = detections.detection_index.shape, cameras.batch_shape
    fits = len(confidence) == 4 and keypoints == (*confidence, 2) and views == confidence[1:2]
    if tracked:
        fits = fits and len(index) == 3 and index[:2] == confidence[:2]
    if not fits or views[0] < least:
        raise InputError(
            where,
            expected="keypoints (frames, cameras, detections, joints, 2), confidence without the "
            f"last, cameras (cameras,){f' of {least} or more' if least else ''}"
            f"{', detection_index (frames, cameras, persons)' if tracked else ''}",
            found=f"{keypoints}, {confidence}, {views}{f', {index}' if tracked else ''}",
            todo="Give arrays of the same clip and cameras.",
        )
    require_layout(where, detections, coco=not tracked)


def require_layout(
    where: str, detections: KeypointDetections[ClipArray], *, coco: bool = True
) -> None:
    """Require a frame number per row or none, and the points of COCO-17; InputError otherwise."""
    keypoints, confidence = detections.keypoints.shape, detections.confidence.shape
    frame = np.asarray(detections.frame)
    if coco and (confidence[-1] != 17 or keypoints != (*confidence, 2)):
        expected = "COCO-17, keypoints (..., 17, 2) and confidence (..., 17)"
        todo = "Select these points in this order; read_observations converts files of other sets."
        raise InputError(where, expected, f"{keypoints} and {confidence}", todo)
    if len(frame) and (frame.shape != confidence[:1] or frame.dtype.kind not in "iu"):
        expected = f"{confidence[0]} whole numbers, one for each row, or none"
        todo = "Give each row the number of its frame, not a time."
        raise InputError(f"{where}: frame", expected, f"{frame.shape} {frame.dtype}", todo)


@compile_kernel
def ray_affinity(
    joints: Floats,
    centers: Floats,
    directions: Floats,
    weights: Floats,
    gates: Floats,
    min_joints: int,
) -> Floats:
    """Return minus the mean distance of each person's joints to each detection's rays.

        A(P, p) = -(1 / J) sum_j dist(P_j, ray of p_j)   over the J joints known on both sides

    Args:
        joints: (persons, joints, 3) [m], world; NaN where unknown.
        centers: (cameras, 3) [m], world, origins of the rays.
        directions: (cameras, detections, joints, 3) unit rays, world.
        weights: (cameras, detections, joints), 0 or less where not seen; only the sign counts.
        gates: (cameras, persons) [m], distances beyond which no affinity is computed.
        min_joints: least number of joints known on both sides.

    Returns:
        (cameras, persons, detections) [-m]; minus infinity with too few joints in common or
        beyond the gate.

    Note:
        Computation of a pair stops as soon as its joints so far put the mean beyond the gate.
    """
    cameras, detections, joint_count, _ = directions.shape
    persons = joints.shape[0]
    affinity = np.full((cameras, persons, detections), -np.inf)
    for c in range(cameras):
        cx, cy, cz = centers[c]
        for detection in range(detections):
            seen = 0
            for joint in range(joint_count):
                if weights[c, detection, joint] > 0.0:
                    seen += 1
            if seen < min_joints:
                continue
            for person in range(persons):
                total, count = 0.0, 0
                too_far = gates[c, person] * seen
                for joint in range(joint_count):
                    if not weights[c, detection, joint] > 0.0:
                        continue
                    if math.isnan(joints[person, joint, 0]):
                        continue
                    x, y = joints[person, joint, 0] - cx, joints[person, joint, 1] - cy
                    z = joints[person, joint, 2] - cz
                    u, v = directions[c, detection, joint, 0], directions[c, detection, joint, 1]
                    n = directions[c, detection, joint, 2]
                    along = max(0.0, x * u + y * v + z * n)
                    x, y, z = x - along * u, y - along * v, z - along * n
                    total += math.sqrt(x * x + y * y + z * z)
                    count += 1
                    if total > too_far:
                        break
                if count >= min_joints and total <= gates[c, person] * count:
                    affinity[c, person, detection] = -total / count
    return affinity


@compile_kernel
def distance(x: float, y: float, z: float, center: Floats, direction: Floats) -> float:
    """Return the distance [m] of a point to a ray; NaN where either is missing.

    For a point behind the camera, the distance to the camera counts.
    """
    x, y, z = x - center[0], y - center[1], z - center[2]
    along = max(0.0, x * direction[0] + y * direction[1] + z * direction[2])
    x -= along * direction[0]
    y -= along * direction[1]
    z -= along * direction[2]
    return math.sqrt(x * x + y * y + z * z)


@compile_kernel
def rays_apart(
    baseline: Floats, rays: Floats, others: Floats, most: float
) -> tuple[float, float, int]:
    """Return sums of distances [m] and of sines of two detections' rays, and their joints' number.

    The baseline (3,) is from the first camera to the second [m]; unit rays are (joints, 3), NaN
    where not seen. Beyond a sum of distances of `most` [m] the rest does not count.
    """
    x, y, z = baseline
    total, sines, count = 0.0, 0.0, 0
    for joint in range(len(rays)):
        px, py, pz = rays[joint]
        qx, qy, qz = others[joint]
        nx, ny, nz = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
        sine = math.sqrt(nx * nx + ny * ny + nz * nz)
        if sine > 0.0:  # also False for NaN
            total += abs(x * nx + y * ny + z * nz) / sine
            sines += sine
            count += 1
            if total > most:
                break
    return total, sines, count


@compile_kernel
def view_distances(centers: Floats, directions: Floats, index: Integers) -> Floats:
    """Return mean distances (persons, cameras, cameras) [m] of rays of two detections of a person.

    They are infinite without a common joint. Centers are (cameras, 3) [m], unit rays (cameras,
    detections, joints, 3), world, NaN where not seen, indices of detections (cameras, persons), or
    -1.
    """
    cameras, persons = index.shape
    joint_count = directions.shape[2]
    apart = np.full((persons, cameras, cameras), np.inf)
    views, rays = np.empty(cameras, np.int64), np.empty((cameras, 3, joint_count))
    away, known = np.empty(joint_count), np.empty(joint_count)
    for person in range(persons):
        count = 0
        for c in range(cameras):
            if index[c, person] >= 0:
                rays[count] = directions[c, index[c, person]].T
                views[count] = c
                count += 1
        for first in range(count):
            a, p = views[first], rays[first]
            for second in range(first + 1, count):
                b, q = views[second], rays[second]
                x, y = centers[b, 0] - centers[a, 0], centers[b, 1] - centers[a, 1]
                z = centers[b, 2] - centers[a, 2]
                # Vector instructions take several joints; sums in order give the same bits.
                for joint in range(joint_count):
                    nx = p[1, joint] * q[2, joint] - p[2, joint] * q[1, joint]
                    ny = p[2, joint] * q[0, joint] - p[0, joint] * q[2, joint]
                    nz = p[0, joint] * q[1, joint] - p[1, joint] * q[0, joint]
                    sine = math.sqrt(nx * nx + ny * ny + nz * nz)
                    seen = sine > 0.0  # also False for NaN
                    known[joint] = 1.0 if seen else 0.0
                    away[joint] = abs(x * nx + y * ny + z * nz) / sine if seen else 0.0
                total, shared = 0.0, 0.0
                for joint in range(joint_count):
                    total, shared = total + away[joint], shared + known[joint]
                if shared > 0.0:
                    apart[person, a, b] = apart[person, b, a] = total / shared
    return apart


@compile_kernel
def drop_inconsistent_views(apart: Floats, index: Integers, departure: Floats, gain: float) -> None:
    """Remove people's views whose rays are lastingly apart from those of the others.

    The departure of view c is the running mean of the mean distance to the other views S,

        r_c <- r_c + gain (mean_{j in S, j != c} apart_cj - r_c);

    the worst view is left out of S as long as its departure exceeds 1. So the views that agree
    decide; of the last two, the one that departed more before is left out.

    Args:
        apart: (persons, cameras, cameras) distance of rays over its limit [1]; infinite = unknown.
        index: (cameras, persons) detections; -1 = not seen. Written.
        departure: (persons, cameras) [1]. Written.
        gain: of the running mean [1].
    """
    cameras = len(index)
    for person in range(len(apart)):
        matched, mean = index[:, person] >= 0, departure[person].copy()
        while True:
            worst = -1
            for c in range(cameras):
                if not matched[c]:
                    continue
                total, count = 0.0, 0
                for other in range(cameras):
                    away = apart[person, c, other]
                    if other != c and index[other, person] >= 0 and away < math.inf:
                        total, count = total + away, count + 1
                if count:
                    mean[c] = departure[person, c] + gain * (total / count - departure[person, c])
                    if index[c, person] >= 0 and mean[c] > (1.0 if worst < 0 else mean[worst]):
                        worst = c
            if worst < 0:
                break
            index[worst, person] = -1
        departure[person] = mean


@compile_kernel
def match_greedily(affinity: Floats) -> Integers:
    """Return each person's detection in every camera, best pairs first.

    Args:
        affinity: (cameras, persons, detections); minus infinity = no match.

    Returns:
        (cameras, persons) index of the detection, each used once; -1 = none. Of equal pairs the
        first person's, then the first detection's wins.
    """
    cameras, persons, detections = affinity.shape
    index = np.full((cameras, persons), -1)
    for c in range(cameras):
        flat = -affinity[c].copy().ravel()
        candidates = np.flatnonzero(flat < np.inf)
        taken = np.zeros(detections, np.bool_)
        for place in candidates[np.argsort(flat[candidates], kind="mergesort")]:
            person, detection = place // detections, place % detections
            if index[c, person] < 0 and not taken[detection]:
                index[c, person] = detection
                taken[detection] = True
    return index


@compile_kernel
def nearest_detections(affinity: Floats, unmatched: float) -> tuple[Integers, Flags]:
    """Return each person's best detection (cameras, persons), and the cameras where two share one.

    The affinity is (cameras, persons, detections), minus infinity = no match, and `unmatched` that
    of a person without detection.
    """
    cameras, persons, detections = affinity.shape
    index, shared = np.full((cameras, persons), -1), np.zeros(cameras, np.bool_)
    for c in range(cameras):
        taken = np.zeros(detections, np.bool_)
        for person in range(persons):
            best = unmatched
            for detection in range(detections):
                if affinity[c, person, detection] > best:
                    best = affinity[c, person, detection]
                    index[c, person] = detection
            if index[c, person] >= 0:
                shared[c] |= taken[index[c, person]]
                taken[index[c, person]] = True
    return index, shared


def match_optimally(affinity: Floats, unmatched: float) -> Integers:
    """Return each person's detection in every camera, with the largest sum of affinities.

    Args:
        affinity: (cameras, persons, detections); minus infinity = no match.
        unmatched: affinity of a person without detection.

    Returns:
        (cameras, persons) index of the detection, each used once; -1 = none (Hungarian method, if
        the best detections of two people are the same).
    """
    index, shared = nearest_detections(affinity, unmatched)
    for c in np.flatnonzero(shared):
        gains = affinity[c]
        possible = gains > unmatched
        persons, detections = np.flatnonzero(possible.any(1)), np.flatnonzero(possible.any(0))
        part = np.maximum(gains[np.ix_(persons, detections)], unmatched)
        row, column = linear_sum_assignment(part, maximize=True)
        good = part[row, column] > unmatched
        index[c] = -1
        index[c, persons[row[good]]] = detections[column[good]]
    return index


@compile_kernel
def intersect_people(
    centers: Floats,
    directions: Floats,
    weights: Floats,
    index: Integers,
    near: Floats,
    gate: float,
    min_sine: float,
) -> Floats:
    """Return people's joints (persons, joints, 3) [m], world, from the rays of their detections.

    The point nearest to the rays, each weighted by `weights` over its squared length, under a
    Geman-McClure loss: a view that shows another person has little influence.

    Centers are (cameras, 3) [m] and unit rays (cameras, detections, joints, 3), world, NaN where
    not seen; weights (cameras, detections, joints) of the squared angle are 0 there. `index`
    (cameras, persons) is each person's detection, or -1, and `near` (persons, joints, 3) [m] are
    predicted positions, or NaN. Beyond `gate` [m] a ray is an outlier; joints are NaN with fewer
    than two inlier rays, or the sine of their angle below `min_sine`.
    """
    cameras, _, joint_count, _ = directions.shape
    persons = index.shape[1]
    joints = np.full((persons, joint_count, 3), np.nan)
    origin, ray = np.empty((cameras, 3)), np.empty((cameras, 3))
    weight = np.empty(cameras)
    for person in range(persons):
        for joint in range(joint_count):
            count = 0
            for c in range(cameras):
                detection = index[c, person]
                if detection >= 0 and weights[c, detection, joint] > 0.0:
                    for axis in range(3):
                        origin[count, axis] = centers[c, axis]
                        ray[count, axis] = directions[c, detection, joint, axis]
                    weight[count] = weights[c, detection, joint]
                    count += 1
            if count < 2:
                continue
            x, y, z = near[person, joint]
            scale = 0.5 * gate
            if math.isnan(x):
                x, y, z = _nearest_point(origin, ray, weight, count, (x, y, z), math.inf)
                scale *= 4.0
            for _ in range(5):
                u, v, w = x, y, z
                x, y, z = _nearest_point(origin, ray, weight, count, (x, y, z), scale)
                settled = scale <= 0.5 * gate
                scale = max(0.5 * gate, 0.5 * scale)
                # Length of a step that ends the iteration [m]: a tenth of the rays' accuracy.
                if settled and (x - u) ** 2 + (y - v) ** 2 + (z - w) ** 2 <= 1e-3**2:
                    break
            if _have_wide_angle(origin, ray, count, (x, y, z), gate, min_sine):
                joints[person, joint, 0] = x
                joints[person, joint, 1] = y
                joints[person, joint, 2] = z
    return joints


@compile_kernel
def _nearest_point(
    origin: Floats, ray: Floats, weight: Floats, count: int, point: Point, scale: float
) -> Point:
    """Return the point nearest to the rays, reweighted at `point`; NaN if they are parallel."""
    a = b = c = d = e = f = g0 = g1 = g2 = total = 0.0
    for k in range(count):
        w = weight[k]
        x, y, z = ray[k, 0], ray[k, 1], ray[k, 2]
        ox, oy, oz = origin[k, 0], origin[k, 1], origin[k, 2]
        if scale < math.inf:
            away = distance(point[0], point[1], point[2], origin[k], ray[k])
            length = (point[0] - ox) ** 2 + (point[1] - oy) ** 2 + (point[2] - oz) ** 2
            w *= (scale * scale / (scale * scale + away * away)) ** 2 / length
        xx, yy, zz = w * (1.0 - x * x), w * (1.0 - y * y), w * (1.0 - z * z)
        xy, xz, yz = -w * x * y, -w * x * z, -w * y * z
        a, b, c, d, e, f = a + xx, b + xy, c + xz, d + yy, e + yz, f + zz
        g0 += xx * ox + xy * oy + xz * oz
        g1 += xy * ox + yy * oy + yz * oz
        g2 += xz * ox + yz * oy + zz * oz
        total += w
    p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
    s, t, u = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * p + b * q + c * r
    # Determinant of a system with a diagonal of about 1 that counts as singular [1].
    if not determinant > 1e-9 * total**3:
        return (math.nan, math.nan, math.nan)
    return (
        (p * g0 + q * g1 + r * g2) / determinant,
        (q * g0 + s * g1 + t * g2) / determinant,
        (r * g0 + t * g1 + u * g2) / determinant,
    )


@compile_kernel
def _have_wide_angle(
    origin: Floats, ray: Floats, count: int, point: Point, gate: float, min_sine: float
) -> bool:
    """Return whether two rays that pass within the gate are `min_sine` apart."""
    x, y, z = point
    for k in range(count):
        if not distance(x, y, z, origin[k], ray[k]) <= gate:
            continue
        for other in range(k):
            cosine = ray[k, 0] * ray[other, 0] + ray[k, 1] * ray[other, 1]
            cosine += ray[k, 2] * ray[other, 2]
            apart = 1.0 - cosine * cosine >= min_sine * min_sine
            if apart and distance(x, y, z, origin[other], ray[other]) <= gate:
                return True
    return False
