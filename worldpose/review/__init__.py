"""Review: verdicts on results, and manual corrections replayed over unchanged output.

Input: the journal of a match in the store, and the content of the match folder. Output: verdicts on
results, corrected clicks, stale corrections, and the origin of every value.
"""

from worldpose.review.clicks import Replay, replay_corrections, value_now, with_was
from worldpose.review.journal import Journal, append, read_journal, say
from worldpose.review.origins import ORIGINS, joint_origins, unit_origins
from worldpose.review.verdicts import decision_on, requests_by_id, standing_corrections

__all__ = [
    "ORIGINS",
    "Journal",
    "Replay",
    "append",
    "decision_on",
    "joint_origins",
    "read_journal",
    "replay_corrections",
    "requests_by_id",
    "say",
    "standing_corrections",
    "unit_origins",
    "value_now",
    "with_was",
]
