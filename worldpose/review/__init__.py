"""Review: verdicts on results, and manual corrections replayed over unchanged output.

Input: the journal of a match in the store, and the content of the match folder. Output: verdicts on
results, corrected clicks, stale corrections, and the origin of every value.
"""

from worldpose.review.clicks import Replay, add_previous_value, current_value, replay_corrections
from worldpose.review.journal import (
    Journal,
    append,
    last_decision,
    read_journal,
    requests_by_id,
    say,
    standing_corrections,
)
from worldpose.review.origins import ORIGINS, joint_origins, unit_origins

__all__ = [
    "ORIGINS",
    "Journal",
    "Replay",
    "add_previous_value",
    "append",
    "current_value",
    "joint_origins",
    "last_decision",
    "read_journal",
    "replay_corrections",
    "requests_by_id",
    "say",
    "standing_corrections",
    "unit_origins",
]
