"""Lenses from images of a checkerboard or a ChArUco board."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

import numpy as np

from data_contracts.arrays import Flags, Floats, Image, Integers
from data_contracts.cameras import LensCalibration, LensName
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera, Projection
from worldpose.geometry.lens_models import LensModel
from worldpose.geometry.optimize.levenberg_marquardt import Damping, minimize

MIN_VIEWS: Final = 4
"""Minimum images with a board [1]: leaving out one must leave three, which determine a lens."""


@dataclass(frozen=True)
class Board:
    """A flat calibration board.

    Attributes:
        columns: inner corners along one side; squares for a ChArUco board [1]; rows: the other
            side.
        dictionary: ArUco dictionary of a ChArUco board, such as `DICT_4X4_50`; None = checkerboard.
        marker_m: side of its markers [m].
    """

    columns: int
    rows: int
    square_m: float
    dictionary: str | None = None
    marker_m: float | None = None

    def find(self, image: Image) -> BoardView | None:
        """Return the corners of the board in an image (height, width[, 3]); None without one."""
        import cv2  # late: it takes 0.2 s, and few commands need it

        grey = np.asarray(
            image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8
        )
        if self.dictionary is not None:
            return self._find_charuco(grey)
        flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
        size = (self.columns, self.rows)
        found, corners = cv2.findChessboardCornersSB(grey, size, flags=flags)
        if not found:
            return None
        places = np.mgrid[: self.columns, : self.rows].T.reshape(-1, 2) * self.square_m
        return BoardView(places.astype(np.float64), corners.reshape(-1, 2).astype(np.float64))

    def _find_charuco(self, grey: Image) -> BoardView | None:
        import cv2

        board, note = self._charuco(), ""
        corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(grey)
        if ids is None or len(ids) < 8:
            # OpenCV before 4.6 began boards of an even number of rows with a white square.
            board.setLegacyPattern(True)
            corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(grey)
            note = "the board has the pattern that OpenCV printed before 4.6"
        if ids is None or len(ids) < 8:
            return None
        # The detector interpolates corners between markers.
        window = (5, 5)  # half the sides
        criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-3)
        corners = cv2.cornerSubPix(grey, corners, window, (-1, -1), criteria)
        places = np.asarray(board.getChessboardCorners())[ids.ravel(), :2]
        pixels = corners.reshape(-1, 2).astype(np.float64)
        return BoardView(places.astype(np.float64), pixels, note)

    def others(self, image: Image) -> Iterator[tuple[Board, str]]:
        """Yield boards that are perhaps meant, if an image shows none, each with the difference."""
        given = f"{self.columns} x {self.rows}"
        if self.dictionary is None:
            if min(self.columns, self.rows) > 3:
                columns, rows = self.columns - 1, self.rows - 1
                said = f"the board has {columns} x {rows} inner corners; {given} is its number of "
                yield replace(self, columns=columns, rows=rows), said + "squares"
            return
        own = _count_markers(image, self.dictionary)
        first, *_ = sorted(_dictionaries(), key=lambda name: -_count_markers(image, name))
        known = self.dictionary
        if _count_markers(image, first) > max(2 * own, 3):
            known = first
            yield replace(self, dictionary=known), f"the board's markers are of {known}"
        if self.columns != self.rows:
            turned = replace(self, columns=self.rows, rows=self.columns, dictionary=known)
            said = f"the board has {self.rows} x {self.columns} squares, not {given}"
            yield turned, said + (f", and markers of {known}" if known != self.dictionary else "")

    def _charuco(self) -> Any:  # noqa: ANN401
        """Return OpenCV's board."""
        import cv2

        known = _dictionaries()
        if self.dictionary not in known:
            raise InputError(
                "board: dictionary",
                expected=f"one of OpenCV's: {', '.join(known)}",
                found=repr(self.dictionary),
                todo="Give the dictionary that the board was printed with.",
            )
        markers = _dictionary(str(self.dictionary))
        side = self.marker_m if self.marker_m is not None else 0.0
        if not 0.0 < side < self.square_m:
            raise InputError(
                "board: marker",
                expected=f"the side of a marker, smaller than a square of {self.square_m:g} m",
                found=f"{side:g} m",
                todo="Measure the black square of a marker.",
            )
        size = (self.columns, self.rows)
        return cv2.aruco.CharucoBoard(size, self.square_m, side, markers)


def _dictionaries() -> list[str]:
    """Return the names of OpenCV's dictionaries of markers, each before larger ones of its kind."""
    import cv2

    names = [name for name in dir(cv2.aruco) if name.startswith("DICT_")]
    return sorted(names, key=lambda name: int(getattr(cv2.aruco, name)))


def _dictionary(name: str) -> Any:  # noqa: ANN401
    import cv2

    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def _count_markers(image: Image, dictionary: str) -> int:
    """Return the number of different markers of a dictionary in an image."""
    import cv2

    _, ids, _ = cv2.aruco.ArucoDetector(_dictionary(dictionary)).detectMarkers(image)
    return 0 if ids is None else len(np.unique(ids))


@dataclass(frozen=True, eq=False)
class BoardView:
    """Corners of a board in one image.

    Attributes:
        places: (n, 2) on the board [m].
        pixels: (n, 2) in the image [px].
        note: a sentence about the board, for the user; empty if it is as stated.
    """

    places: Floats
    pixels: Floats
    note: str = ""

    @property
    def bend(self) -> float:
        """Mean distance of the corners from the image of a plane, in squares of the image [1]."""
        import cv2

        matrix, _ = cv2.findHomography(self.places, self.pixels)
        if matrix is None:
            return float("inf")
        flat = cv2.perspectiveTransform(self.places[None], matrix)[0]
        off = np.linalg.norm(flat - self.pixels, axis=1).mean()
        apart = np.linalg.norm(self.pixels[:, None] - self.pixels[None], axis=-1)
        np.fill_diagonal(apart, np.inf)
        return float(off / np.median(apart.min(axis=1)))


@dataclass(frozen=True, eq=False)
class LensFit:
    """A lens, with what it was computed from.

    Attributes:
        lens: the lens, with standard deviations.
        used: (images,) whether an image counts.
        reasons: why each image does not count; empty where it does.
        pixels: (n, 2) corners in the used images [px].
        residuals: (n, 2) corner minus its projection [px].
        image: (n,) index of each corner's image.
        coverage: share of a grid of 8 x 8 fields of the image that have a corner [1].
        bend_m: bend of the board along and across it, if it clearly explains the residuals [m].
    """

    lens: LensCalibration
    used: Flags
    reasons: tuple[str, ...]
    pixels: Floats
    residuals: Floats
    image: Integers
    coverage: float
    bend_m: float = 0.0

    @property
    def rms_px(self) -> float:
        """Root mean square distance of a corner from its projection [px]."""
        return _rms(self.residuals)


def calibrate_lens(
    camera: str, views: Sequence[BoardView | None], size: tuple[int, int]
) -> LensFit:
    """Return the lens of a camera from images of one board; InputError if they do not determine it.

    Focal length (square pixels), principal point, k1, k2, p1 and p2 are estimated by OpenCV (Zhang,
    2000); or k1 to k4 of a fisheye, if its residuals are clearly smaller. Images whose corners are
    not on a plane, or that contradict the others, are left out. The standard deviations are those
    of leaving out one image at a time (jackknife). If the board is bent, which all images share,
    they are larger by what the bend moves the lens.

    `views` has None where no board was found; `size` is the width and height of all images [px].
    """
    min_std_px = 0.1  # of focal length and principal point
    max_focal_std = 0.05  # relative; boards that all face the camera do not determine it
    reasons = ["" if view is not None else "no whole board found" for view in views]
    for n, view in enumerate(views):
        # In squares: a lens bends a board less; corners that were counted wrongly, 0.4 to 1.
        if view is not None and view.bend > 0.35:
            reasons[n] = "its corners are not those of a flat board"
    model = _choose_model([v for v, no in zip(views, reasons, strict=True) if v and not no], size)
    while True:
        chosen = [n for n, reason in enumerate(reasons) if not reason]
        if len(chosen) < MIN_VIEWS:
            raise InputError(
                f"{camera}: board images",
                expected=f"{MIN_VIEWS} images or more with the whole board",
                found=f"{len(chosen)} of {len(views)}",
                todo="Check the number of corners and squares of the board, and add images in which"
                " it is tilted, sharp and near the borders.",
            )
        kept = [view for view in (views[n] for n in chosen) if view is not None]
        numbers, residuals = _solve(kept, size, model)
        error = np.array([_rms(each) for each in residuals])
        worst = int(error.argmax())
        if error[worst] <= 0.3 or len(kept) == MIN_VIEWS:
            break
        others = _solve(kept[:worst] + kept[worst + 1 :], size, model)[1]
        # The worst image is left out if it doubles the residual.
        if _rms(np.concatenate(residuals)) <= 2.0 * _rms(np.concatenate(others)):
            break
        reasons[chosen[worst]] = f"it contradicts the others, by {error[worst]:.1f} px"
    left_out = np.array(
        [_solve(kept[:n] + kept[n + 1 :], size, model)[0] for n in range(len(kept))]
    )
    count = len(kept)
    spread = (count - 1) / count * ((left_out - left_out.mean(axis=0)) ** 2).sum(axis=0)
    bend, bent = _fit_bend(kept, size, model)
    spread += (bent - numbers) ** 2
    if np.sqrt(spread[0]) > max_focal_std * numbers[0]:
        tilt = "Add images in which the board is tilted by 30 to 45 degrees about both axes."
        bent_m = float(np.abs(bend).max())
        flatten = f"The board is bent by about {1000.0 * bent_m:.0f} mm: fix it to a flat plate."
        raise InputError(
            f"{camera}: board images",
            expected=f"boards that determine the focal length within {100 * max_focal_std:g} %",
            found=f"{numbers[0]:.0f} px with a standard deviation of {np.sqrt(spread[0]):.0f} px",
            todo=f"{flatten} {tilt}" if bent_m else tilt,
        )
    corner = np.array([_corner_factor(each, size, model) for each in left_out])
    corner_std = np.hypot(
        np.sqrt((count - 1) / count * ((corner - corner.mean()) ** 2).sum()),
        _corner_factor(bent, size, model) - _corner_factor(numbers, size, model),
    )
    # Three coefficients share the displacement of the corner.
    lens = LensCalibration(
        id=camera,
        image_size=size,
        focal_px=float(numbers[0]),
        principal_point_px=(float(numbers[1]), float(numbers[2])),
        distortion=tuple(numbers[3:].tolist()),
        lens_model=model,
        focal_std_px=float(max(np.sqrt(spread[0]), min_std_px)),
        principal_point_std_px=float(max(np.sqrt(0.5 * (spread[1] + spread[2])), min_std_px)),
        distortion_std=float(max(corner_std, 1e-4)),
    )
    pixels = np.concatenate([view.pixels for view in kept])
    return LensFit(
        lens=lens,
        used=np.array([not reason for reason in reasons]),
        reasons=tuple(reasons),
        pixels=pixels,
        residuals=np.concatenate(residuals),
        image=np.repeat(chosen, [len(each) for each in residuals]),
        coverage=image_coverage(pixels, size),
        bend_m=float(np.abs(bend).max()),
    )


def _rms(residuals: Floats) -> float:
    """Return the root mean square length of residuals (n, 2) [px]."""
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))


def _fit_bend(
    views: Sequence[BoardView], size: tuple[int, int], model: LensName
) -> tuple[Floats, Floats]:
    """Return the bend (2,) of the board [m] and the lens with it; zeros unless it is clear.

    The heights of its corners are z = bend . (x^2, y^2), x and y from -1 to 1 over the board.
    """
    clear = 0.7  # ratio of residuals with the bend and without
    bend, step_m = np.zeros(2), 1e-3
    flat, off = _solve(views, size, model)
    found, now = flat, np.concatenate(off)
    for _ in range(2):
        moved = (_solve(views, size, model, bend + step)[1] for step in step_m * np.eye(2))
        by_bend = np.stack([(np.concatenate(each) - now).ravel() for each in moved], axis=-1)
        bend = bend - step_m * np.linalg.lstsq(by_bend, now.ravel(), rcond=None)[0]
        found, after = _solve(views, size, model, bend)
        now = np.concatenate(after)
    is_clear = _rms(now) < clear * _rms(np.concatenate(off))
    return (bend, found) if is_clear else (np.zeros(2), flat)


def _choose_model(views: Sequence[BoardView], size: tuple[int, int]) -> LensName:
    """Return the fisheye if its residuals are clearly smaller than those of Brown's model."""
    clear = 0.7  # ratio of median residuals: wide lenses reach 0.1 to 0.4, noise of few boards 0.9
    if len(views) < MIN_VIEWS:
        return "brown"
    median = {
        model: float(np.median([_rms(each) for each in _solve(views, size, model)[1]]))
        for model in ("brown", "fisheye")
    }
    return "fisheye" if median["fisheye"] < clear * median["brown"] else "brown"


def _solve(
    views: Sequence[BoardView],
    size: tuple[int, int],
    model: LensName,
    bend: Floats | tuple[float, float] = (0.0, 0.0),
) -> tuple[Floats, list[Floats]]:
    """Return f, cx, cy and the coefficients, and the residuals (n, 2) of each view [px].

    The board has a `bend` (2,) [m], as `_fit_bend` says.
    """
    import cv2

    every = np.concatenate([view.places for view in views])
    low, high = every.min(axis=0), every.max(axis=0)
    shape = [(2.0 * view.places - low - high) ** 2 / (high - low) ** 2 for view in views]
    places = [np.c_[view.places, each @ bend] for view, each in zip(views, shape, strict=True)]
    images = [view.pixels.astype(np.float32) for view in views]
    middle = 0.5 * (np.array(size) - 1.0)
    start = np.array([[max(size), 0.0, middle[0]], [0.0, max(size), middle[1]], [0.0, 0.0, 1.0]])
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_FIX_K3
    _, matrix, found, rvecs, tvecs = cv2.calibrateCamera(
        [each.astype(np.float32) for each in places], images, size, start, np.zeros(5), flags=flags
    )
    lens = np.append(found.ravel()[:4], 0.0)
    turns = np.array([cv2.Rodrigues(each)[0] for each in rvecs])
    camera = Camera.from_matrices(matrix, lens, turns, np.reshape(tvecs, (-1, 3)), size)
    boards = _Boards(camera, views, places)
    if model == "fisheye":
        boards = boards.fit_fisheye()
    camera = boards.camera
    numbers = [camera.focal[0, 0], *camera.principal_point[0], *camera[0].coefficients]
    # A corner beyond the fold of a wrong lens counts as far off.
    return np.array(numbers), [np.nan_to_num(each, nan=1e3) for each in boards.residuals]


@dataclass(frozen=True, eq=False)
class _Boards:
    """Boards before a camera of square pixels, as Zhang (2000) fits them.

    Attributes:
        camera: (views,) one lens, with the pose of each board.
        views: the corners.
        places: (n, 3) of the corners of each view [m].
    """

    camera: Camera
    views: Sequence[BoardView]
    places: Sequence[Floats]

    @cached_property
    def _seen(self) -> list[Projection]:
        return [
            self.camera[n].project_with_jacobians(places) for n, places in enumerate(self.places)
        ]

    @property
    def residuals(self) -> list[Floats]:
        """Corner minus its projection (n, 2) [px], by view; NaN beyond the fold."""
        pairs = zip(self.views, self._seen, strict=True)
        return [view.pixels - seen.points_image for view, seen in pairs]

    @property
    def cost(self) -> float:
        """Sum of squared residuals [px^2]."""
        return float(sum((each**2).sum() for each in self.residuals))

    def fit_fisheye(self) -> _Boards:
        """Return the fisheye and the poses of least squares, from a fit of Brown's model.

        OpenCV's cv2.fisheye.calibrate has the same objective; it often ends far from the minimum.
        """
        k1, k2 = self.camera.distortion[:, :2].T
        lens = np.zeros((len(self.views), 8))
        lens[:, 0], lens[:, 1] = k1 + 1.0 / 3.0, k2 + k1 + 2.0 / 15.0
        start = replace(self.camera, distortion=lens, lens_model=LensModel.FISHEYE)
        return minimize(
            replace(self, camera=start),
            _Boards._step,
            Damping(start=1e-3, decrease=10.0, lowest=1e-12, highest=1e8),
            iterations=100,
            converged=lambda before, after: 0.0 <= before.cost - after.cost <= 1e-9 * before.cost,
        ).state

    def _step(self, damping: float) -> _Boards:
        """Return the boards after a damped Gauss-Newton step of the lens and all poses."""
        columns, camera = LensModel.FISHEYE.columns, self.camera
        shared = 3 + len(columns)
        count = shared + 6 * len(self.views)
        matrix, right = np.zeros((count, count)), np.zeros(count)
        for n, (seen, off) in enumerate(zip(self._seen, self.residuals, strict=True)):
            by_focal = (seen.d_intrinsics[..., :2] * camera.focal[n]).sum(axis=-1, keepdims=True)
            parts = by_focal, seen.d_intrinsics[..., 2:], seen.d_distortion[..., columns]
            rows = np.concatenate([*parts, seen.d_pose], axis=-1).reshape(-1, shared + 6)
            own = np.append(np.arange(shared), shared + 6 * n + np.arange(6))
            matrix[np.ix_(own, own)] += rows.T @ rows
            right[own] += rows.T @ off.ravel()
        size = np.sqrt(np.diag(matrix))
        matrix = matrix / np.outer(size, size) + damping * np.eye(count)
        step = np.linalg.solve(matrix, right / size) / size
        distortion = camera.distortion.copy()
        distortion[:, columns] += step[3:shared]
        moved = replace(
            camera,
            focal=camera.focal * np.exp(step[0]),
            principal_point=camera.principal_point + step[1:3],
            distortion=distortion,
            cam_from_world=camera.cam_from_world.retract(step[shared:].reshape(-1, 6)),
        )
        return replace(self, camera=moved)


def _corner_factor(numbers: Floats, size: tuple[int, int], model: LensName) -> float:
    """Return the relative displacement of the image's farthest corner by the distortion [1]."""
    far = np.maximum(numbers[1:3], np.array(size) - numbers[1:3]) / numbers[0]
    powers = float((far**2).sum()) ** np.arange(1, 5)
    terms = numbers[3:] if model == "fisheye" else numbers[[3, 4]]
    return float(terms @ powers[: len(terms)])


def choose_views(
    frames: Iterable[Image], board: Board
) -> tuple[list[BoardView | None], tuple[int, int]]:
    """Return different views of a board in frames (height, width, 3), and the frames' size."""
    views: list[BoardView | None] = []
    size = (0, 0)
    for frame in frames:
        size = (frame.shape[1], frame.shape[0])
        view = board.find(frame)
        if view is None or any(_is_same(view, other, size[0]) for other in views if other):
            continue
        views.append(view)
        if len(views) == 40:
            break
    return views, size


def image_coverage(pixels: Floats, size: Sequence[int] | Integers) -> float:
    """Return the share of a grid of 8 x 8 fields of an image that pixels (n, 2) [px] reach [1]."""
    fields = np.clip((8 * pixels / np.array(size)).astype(int), 0, 7)
    return len(np.unique(fields, axis=0)) / 64.0


def _is_same(one: BoardView, other: BoardView, width: int) -> bool:
    """Return whether two views show a board at the same place."""
    if one.places.shape != other.places.shape or not np.array_equal(one.places, other.places):
        return False
    return bool(np.abs(one.pixels - other.pixels).mean() < 0.02 * width)
