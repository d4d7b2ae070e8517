"""How nets are trained, and fine-tuned on reviewed labels."""

from __future__ import annotations

from pydantic import Field

from data_contracts.records import Record


class TrainingSettings(Record):
    """How a net is trained."""

    steps: int = Field(default=1500, ge=1, le=1_000_000)
    """Batches."""
    planned: int | None = Field(default=None, ge=1, le=1_000_000)
    """Batches over which the rate rises and falls; `steps` if None. A training may end earlier."""
    rate: float = Field(default=1e-3, ge=1e-12, le=0.1)
    """Highest learning rate of AdamW [1]; it falls as a cosine."""
    decay: float = Field(default=0.02, ge=0, le=10)
    """Weight decay of AdamW [1]."""
    memory: float = Field(default=0.998, ge=0, lt=1)
    """Share of the running mean of the weights that a step keeps [1]; less at first."""
    clip: float = Field(default=5.0, ge=1e-6, le=1000)
    """Longest gradient [1]."""
    check_every: int = Field(default=250, ge=1, le=100_000)
    """Steps between checks against held-out pictures, each with a checkpoint."""
    patience: int = Field(default=6, ge=1, le=1000)
    """Checks without a better one after which training stops."""
    seed: int = Field(default=0, ge=0, le=2_147_483_647)
    bfloat16: bool = False
    """Compute in bfloat16 where that is safe: twice as fast on processors that know it."""


class Refinement(TrainingSettings):
    """How a trained net is trained on."""

    steps: int = Field(default=1500, ge=1, le=1_000_000)
    """Batches."""
    rate: float = Field(default=1e-3, ge=1e-12, le=0.1)
    """Highest learning rate of AdamW [1]: two thirds of that which the nets began with."""
    check_every: int = Field(default=250, ge=1, le=100_000)
    """Steps between checks against held-out pictures, each with a checkpoint: a check takes as long
    as dozens of steps."""


class FineTuningSettings(Record):
    """How a net is fine-tuned."""

    checked: float = Field(default=0.15, gt=0, lt=0.5)
    """Share of pictures that choose the best weights [1]."""
    held_out: float = Field(default=0.25, gt=0, lt=0.5)
    """Share of pictures that the figures are of [1]; nothing is learned or chosen by them."""
    gain: float = Field(default=0.005, ge=0, le=1)
    """What a version must be better by on the held-out pictures to be adopted [1]: less can be
    luck."""
    training: Refinement = Refinement()
    """Steps, rate and seed."""
