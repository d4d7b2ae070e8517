"""JSON Schemas of all contracts: `python -m data_contracts.schemas docs/schemas` writes them."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core.core_schema import ModelSchema

from data_contracts.arrays import GroupLayout
from data_contracts.body_fitting import BODY_FITTING, REFITTING
from data_contracts.broadcast_calibration import BROADCAST_CALIBRATION, BROADCAST_POOLING, KeyFrames
from data_contracts.bundle_adjustment import BUNDLE_ADJUSTMENT
from data_contracts.camera_consistency import CAMERA_CONSISTENCY, CameraFault
from data_contracts.cameras import CameraCalibration
from data_contracts.conventions import CONVENTIONS, Conventions
from data_contracts.detection import DETECTION, REDETECTION
from data_contracts.evaluation import Evaluation, MethodScore
from data_contracts.filtering import FILTERING
from data_contracts.finetune import NetVersion
from data_contracts.ingest import INGEST
from data_contracts.match import MatchSpec, Registration
from data_contracts.pin import Pin
from data_contracts.pitch import PitchSpec
from data_contracts.proposal import PROPOSAL
from data_contracts.records import Record, field_docstrings
from data_contracts.release import (
    BaselineSettings,
    CheckReport,
    DataSetManifest,
    DataSetStatistics,
    ReleaseManifest,
)
from data_contracts.review import Correction, JournalEntry, ReviewDecision, ReviewRequest
from data_contracts.run import Project, Reservation, ResultManifest, RunRecord
from data_contracts.settings import RunSettings
from data_contracts.static_calibration import STATIC_CALIBRATION, ClickedMarkings
from data_contracts.tracking import BROADCAST_TRACKING, TRACKING, Join, Track
from data_contracts.triangulation import RETRIANGULATION, TRIANGULATION

RECORDS: dict[str, type[Record]] = {
    "match": MatchSpec,
    "registration": Registration,
    "camera": CameraCalibration,
    "pitch": PitchSpec,
    "clicked_markings": ClickedMarkings,
    "key_frames": KeyFrames,
    "camera_fault": CameraFault,
    "track": Track,
    "join": Join,
    "review_request": ReviewRequest,
    "review_decision": ReviewDecision,
    "correction": Correction,
    "journal_entry": JournalEntry,
    "project": Project,
    "reservation": Reservation,
    "result_manifest": ResultManifest,
    "run": RunRecord,
    "run_settings": RunSettings,
    "pin": Pin,
    "evaluation": Evaluation,
    "method_score": MethodScore,
    "release_manifest": ReleaseManifest,
    "data_set_manifest": DataSetManifest,
    "check_report": CheckReport,
    "data_set_statistics": DataSetStatistics,
    "baseline_settings": BaselineSettings,
    "net_version": NetVersion,
    "conventions": Conventions,
    "layout": GroupLayout,
}

LAYOUTS: tuple[GroupLayout, ...] = (
    *(INGEST, PROPOSAL, STATIC_CALIBRATION, DETECTION, REDETECTION, CAMERA_CONSISTENCY),
    *(TRACKING, TRIANGULATION, BUNDLE_ADJUSTMENT, RETRIANGULATION, BODY_FITTING),
    *(BROADCAST_CALIBRATION, BROADCAST_POOLING, BROADCAST_TRACKING, REFITTING, FILTERING),
)


class DescribedFields(GenerateJsonSchema):
    """JSON Schemas whose fields are described by their docstrings."""

    def model_schema(self, schema: ModelSchema) -> JsonSchemaValue:
        """Return the schema of one record."""
        made = super().model_schema(schema)
        for name, text in field_docstrings(schema["cls"]).items():
            made["properties"][name].setdefault("description", text)
        return made

    def field_title_should_be_set(self, schema: Any) -> bool:  # noqa: ANN401
        """Return False: a title made of a field's name says nothing more."""
        return False


def documents() -> dict[str, Any]:
    """Every generated document by file name: schemas, array layouts, conventions."""
    schemas = {
        f"{name}.schema.json": record.model_json_schema(schema_generator=DescribedFields)
        for name, record in RECORDS.items()
    }
    return schemas | {
        "arrays.json": [layout.model_dump(mode="json") for layout in LAYOUTS],
        "conventions.json": CONVENTIONS.model_dump(mode="json"),
    }


def write(folder: Path) -> None:
    """Write all documents into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, document in documents().items():
        text = json.dumps(document, indent=2, ensure_ascii=False)
        (folder / name).write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    write(Path(sys.argv[1]))
