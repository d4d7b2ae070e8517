"""Versions of the embedded nets: what each was trained on, and whether it is better."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from pydantic import Field

from data_contracts.records import CONTRACT_VERSION, Count, Digest, Number, Record

NetKind = Literal["people", "keypoints"]
"""The detector of people, and the estimator of their keypoints."""


class NetVersion(Record):
    """A net that was fine-tuned on reviewed labels, beside the one it began from."""

    contract: Literal[1] = CONTRACT_VERSION
    net: NetKind
    parent: Digest
    """SHA-256 of the weights' file that training began from."""
    fingerprint: Digest
    """SHA-256 of this version's weights' file; the parent's where training changed nothing."""
    file: str
    """Name of the weights' file beside this record."""
    labels: Digest
    """SHA-256 of the annotations."""
    learned: int = Field(ge=1, le=1 << 53)
    """Pictures learned from."""
    held_out: tuple[str, ...]
    """Pictures that nothing was learned from or chosen by, which the figures are of."""
    figure: str
    """What `before` and `after` are: ap50 of people, pck of keypoints."""
    before: Number
    """Of the parent, on the held-out pictures [1]."""
    after: Number
    """Of this version [1]."""
    steps: Count
    """Done in training."""
    adopted: bool
    """Is this version better: only then later runs are to use it."""
    seed: Count
    trained_at: datetime
