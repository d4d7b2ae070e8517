"""Checkpoints of detectors and pose estimators that can be pulled by name."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, StringConstraints, model_validator

from data_contracts.records import CONTRACT_VERSION, Count, Digest, Name, Record

FileName = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,127}$")]
"""Name of a file without a folder."""


class CheckpointFile(Record):
    """One file of a checkpoint."""

    name: FileName
    url: str = Field(min_length=1, max_length=2000)
    """https address, or hf://OWNER/REPOSITORY@REVISION/FILE on the Hugging Face hub, whose revision
    is a whole commit id."""
    sha256: Digest
    size: Count | None = None
    """[byte]; absent = not known."""
    member: str | None = Field(default=None, min_length=1, max_length=1000)
    """The end of the file's path in the zip archive that `url` names; absent = no archive. Digest
    and size are those of the file, not of the archive."""


class Checkpoint(Record):
    """A net with its origin, its licence and the digests of its files."""

    contract: Literal[1] = CONTRACT_VERSION
    name: Name
    about: str = Field(default="", max_length=500)
    task: Literal["detector", "pose"]
    kind: str = Field(pattern=r"^(transformers|onnx(-[a-z0-9]+)*)$")
    """How it is loaded: the part before the colon of the settings' names."""
    licence: str = Field(min_length=1, max_length=200)
    """Licence of the weights, as their authors state it."""
    files: tuple[CheckpointFile, ...] = Field(min_length=1, max_length=100)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        names = [file.name for file in self.files]
        if len(set(names)) < len(names):
            raise ValueError("every file has a name of its own")
        if self.kind != "transformers" and len(names) > 1:
            raise ValueError("an ONNX checkpoint is one file")
        return self


class CheckpointCatalog(Record):
    """A file with checkpoints of one's own."""

    contract: Literal[1] = CONTRACT_VERSION
    models: tuple[Checkpoint, ...] = Field(min_length=1, max_length=1000)
