"""The paper's own variants, equation by equation, in torch: the baseline of the ablation.

Each function names its equation and section. Where the paper leaves a choice open, the docstring
says which one is made. One of them, the mid-hip of `align_keypoints`, was chosen after a trial of
the ablation had shown both. Stages import this package only for `method=paper`.
"""

from worldpose.errors import InputError


def require_torch() -> None:
    """Raise InputError if torch is not installed."""
    try:
        import torch  # noqa: F401
    except ImportError as error:
        todo = "Install worldpose[body], or use method=worldpose."
        raise InputError("method=paper", expected="torch", found=f"{error}", todo=todo) from error
