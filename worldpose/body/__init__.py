"""Body model: joints, keypoints and surface [m] from shape, joint angles and position.

Input: `BodyParameters`, and the open body or an installed one. Output: world points.
`worldpose.body.jacobian` has derivatives for least squares, `worldpose.body.differentiable` has
gradients; only the latter needs torch.
"""

from typing import TYPE_CHECKING

from worldpose.lazy_names import import_on_use

if TYPE_CHECKING:
    from worldpose.body.body_file import (
        BODY_FOLDER_VARIABLE,
        OPEN_BODY,
        body_folder,
        body_path,
        digest_of_body,
        find_body,
        install_body,
        is_open_body,
        load_body,
        load_open_body,
        save_body,
    )
    from worldpose.body.keypoints import (
        BODY25,
        CHALLENGE15,
        EVALUATED14,
        SKELETONS,
        FoldedKeypoints,
        fold_keypoints,
        fold_regressor,
    )
    from worldpose.body.model import BodyModel, BodyParameters

__all__ = [
    "BODY25",
    "BODY_FOLDER_VARIABLE",
    "CHALLENGE15",
    "EVALUATED14",
    "OPEN_BODY",
    "SKELETONS",
    "BodyModel",
    "BodyParameters",
    "FoldedKeypoints",
    "body_folder",
    "body_path",
    "digest_of_body",
    "find_body",
    "fold_keypoints",
    "fold_regressor",
    "install_body",
    "is_open_body",
    "load_body",
    "load_open_body",
    "save_body",
]

__getattr__ = import_on_use(
    __name__,
    {
        "worldpose.body.body_file": (
            "BODY_FOLDER_VARIABLE",
            "OPEN_BODY",
            "body_folder",
            "body_path",
            "digest_of_body",
            "find_body",
            "install_body",
            "is_open_body",
            "load_body",
            "load_open_body",
            "save_body",
        ),
        "worldpose.body.keypoints": (
            "BODY25",
            "CHALLENGE15",
            "EVALUATED14",
            "SKELETONS",
            "FoldedKeypoints",
            "fold_keypoints",
            "fold_regressor",
        ),
        "worldpose.body.model": (
            "BodyModel",
            "BodyParameters",
        ),
    },
)
