"""Versions of the bundled nets: training data of each, and whether it is better."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from pydantic import Field

from data_contracts.records import CONTRACT_VERSION, Count, Digest, Number, Record

NetKind = Literal["people", "keypoints"]
"""The detector of people, and the estimator of their keypoints."""


class NetVersion(Record):
    """A net that was fine-tuned on reviewed labels, compared with its parent."""

    contract: Literal[1] = CONTRACT_VERSION
    net: NetKind
    parent: Digest
    """SHA-256 of the weights file that training began from."""
    fingerprint: Digest
    """SHA-256 of this version's weights file; the parent's if training changed nothing."""
    file: str
    """Name of the weights file in the folder of this record."""
    labels: Digest
    """SHA-256 of the annotations."""
    learned: int = Field(ge=1, le=1 << 53)
    """Number of training images."""
    held_out: tuple[str, ...]
    """Test images, used neither for training nor for choosing weights."""
    figure: str
    """Metric of `before` and `after`: ap50 of people, pck of keypoints."""
    before: Number
    """Metric of the parent on the test images [1]."""
    after: Number
    """Metric of this version [1]."""
    steps: Count
    """Training steps."""
    adopted: bool
    """Whether this version is better; later runs use it only then."""
    seed: Count
    trained_at: datetime
