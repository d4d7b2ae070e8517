"""Settings of training and of fine-tuning on reviewed labels."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from data_contracts.records import Record


class TrainingSettings(Record):
    """Settings of the training of a net."""

    steps: int = Field(default=1500, ge=1, le=1_000_000)
    """Number of batches."""
    planned: int | None = Field(default=None, ge=1, le=1_000_000)
    """Batches over which the rate rises and falls; `steps` if None. A training may end earlier."""
    rate: float = Field(default=1e-3, ge=1e-12, le=0.1)
    """Highest learning rate of AdamW [1]; it falls as a cosine. The nets' initial training had half
    as much again."""
    decay: float = Field(default=0.02, ge=0, le=10)
    """Weight decay of AdamW [1]."""
    memory: float = Field(default=0.998, ge=0, lt=1)
    """Share of the running mean of the weights that a step keeps [1]; less at first."""
    clip: float = Field(default=5.0, ge=1e-6, le=1000)
    """Largest norm of the gradient [1]."""
    check_every: int = Field(default=250, ge=1, le=100_000)
    """Steps between checks on held-out frames, each with a checkpoint: a check takes as long as
    dozens of steps."""
    patience: int = Field(default=6, ge=1, le=1000)
    """Checks without improvement after which training stops."""
    keep: Literal["best", "last"] = "best"
    """Which weights result: those of the best check, or those of the last step, where held-out
    frames do not show what the training is for. `last` ignores `patience`."""
    seed: int = Field(default=0, ge=0, le=2_147_483_647)
    bfloat16: bool = False
    """Compute in bfloat16 where that is safe: twice as fast on processors that support it."""


class FineTuningSettings(Record):
    """Settings of the fine-tuning of a net."""

    checked: float = Field(default=0.15, gt=0, lt=0.5)
    """Share of frames that choose the best weights [1]."""
    held_out: float = Field(default=0.25, gt=0, lt=0.5)
    """Share of frames in the test set [1], which neither trains the net nor chooses its weights."""
    gain: float = Field(default=0.005, ge=0, le=1)
    """Least gain of the metric on the held-out frames for a version to be adopted [1]: less can be
    chance."""
    training: TrainingSettings = TrainingSettings()
    """Steps, rate and seed."""
