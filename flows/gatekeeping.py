"""Results of a run that need review, from journal verdicts, metrics and policy."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

from data_contracts.review import ReviewDecision, ReviewRequest
from data_contracts.run import GatePolicy, ResultManifest, WaitingUnit
from flows.gates import Gate
from flows.method import GATES
from flows.stage import Match
from worldpose.review import Journal, last_decision, requests_by_id, say
from worldpose.store import Store

ALWAYS = "every result is asked about"


@dataclass(frozen=True)
class Gatekeeper:
    """Decides which results pass and which need review.

    Attributes:
        store: the store of the results.
        match: the match, with its journal as of the start of the run.
        policy: when a review is requested.
    """

    store: Store
    match: Match
    policy: GatePolicy

    def held(self, stage: str, results: Mapping[str, str]) -> tuple[WaitingUnit, ...]:
        """Return the units of `stage` in `results` that later stages must not use yet.

        A verdict applies to a result's bytes, and overrides metrics and policy: a rejected result
        waits for a correction, however good its metrics are.
        """
        gate = {each.stage: each for each in GATES}.get(stage)
        if gate is None or (self.policy == "never" and not self._has_refusals()):
            return ()
        waiting = []
        for name, key in results.items():
            if name.partition("/")[0] != stage:
                continue
            manifest = self._manifest(name, key)
            decision = last_decision(self.match.journal.questions, name, manifest.content)
            if decision is None:
                reasons = self._reasons(gate, manifest)
                if reasons:
                    request = request_id(name, key)
                    waiting.append(WaitingUnit(unit=name, request=request, reasons=reasons))
            elif decision.verdict == "reject":
                said = f"{decision.who} rejected it" + (f": {decision.why}" * bool(decision.why))
                waiting.append(
                    WaitingUnit(unit=name, request=decision.request, reasons=(said,), rejected=True)
                )
        return tuple(waiting)

    def ask(self, run_id: str, waiting: Sequence[WaitingUnit], results: Mapping[str, str]) -> None:
        """Add review requests to the journal, one per result."""
        requests = [
            self._request(unit, results[unit.unit], run_id) for unit in waiting if not unit.rejected
        ]

        def unasked(journal: Journal) -> list[ReviewRequest]:
            known = requests_by_id(journal.questions)
            return [request for request in requests if request.id not in known]

        if requests:
            say(self.store, self.match.match_id, unasked)

    def _reasons(self, gate: Gate, manifest: ResultManifest) -> tuple[str, ...]:
        """Return why a result without a verdict needs review."""
        if self.policy == "never":
            return ()
        asked = (ALWAYS,) if self.policy == "always" else ()
        left_out = (
            f"camera {camera} would be left out: {reason}"
            for camera, reason in manifest.left_out.items()
        )
        return (*asked, *left_out, *gate.objections(manifest.figures))

    def _has_refusals(self) -> bool:
        return any(
            isinstance(record, ReviewDecision) and record.verdict == "reject"
            for record in self.match.journal.questions
        )

    def _request(self, unit: WaitingUnit, key: str, run_id: str) -> ReviewRequest:
        manifest = self._manifest(unit.unit, key)
        return ReviewRequest(
            id=unit.request,
            match_id=self.match.match_id,
            run_id=run_id,
            gate=unit.unit.partition("/")[0],
            keys={unit.unit: key},
            contents={unit.unit: manifest.content},
            reasons=unit.reasons,
            figures=manifest.figures,
            created_at=datetime.now(UTC),
        )

    def _manifest(self, name: str, key: str) -> ResultManifest:
        stage, _, unit = name.partition("/")
        return self.store.manifest(self.match.match_id, stage, unit, key)


def request_id(unit: str, key: str) -> str:
    """Return the review request id of a result: `static_calibration.cam03.1f2e3d4c5b6a`."""
    stage, _, name = unit.partition("/")
    return f"{stage[:24]}.{name[:24]}.{key[:12]}"


def passed(results: Mapping[str, str], waiting: Iterable[WaitingUnit]) -> dict[str, str]:
    """Return the results that later stages can use."""
    held = {unit.unit for unit in waiting}
    return {name: key for name, key in results.items() if name not in held}


def undecided(waiting: Iterable[WaitingUnit]) -> list[WaitingUnit]:
    """Return the units without a verdict; the others wait for corrections."""
    return [unit for unit in waiting if not unit.rejected]
