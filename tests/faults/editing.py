"""People who edit clicks on the review pages while the server dies under them, and the account."""

import http.client
import json
import random
import time
from collections import Counter
from datetime import UTC, datetime

import page_client
from command_line import TINY

from data_contracts.review import Correction
from flows.registering import open_match
from worldpose.review.journal import read_journal
from worldpose.store.store import Store

PATIENCE = 300.0
"""Seconds until a server that was started has to answer."""


class Editor:
    """One person who moves clicks of one camera, and knows what was acknowledged.

    After a cut the very same edits are sent again, or else given up and the page loaded again.
    """

    def __init__(self, port, who, camera, seed, revive=lambda: None):
        self.port, self.who, self.camera, self.revive = port, who, camera, revive
        self.rng = random.Random(seed)
        self.sent, self.acknowledged, self.given_up, self.refused = {}, {}, set(), []
        self.cuts = self.answers = 0
        self.headers = {"content-type": "application/json"}

    def open_page(self):
        """Logs in and looks at the clicks."""
        self.await_server()
        token = {"who": self.who, "token": page_client.TOKEN}
        while (answer := self.ask("POST", "/api/login", token)) is None:
            self.await_server()
        self.headers["cookie"] = answer[2].partition(";")[0]
        self.headers["x-form-secret"] = self.get("/api/session")["form_secret"]
        self.look()

    def look(self):
        self.places = self.get(f"{page_client.MATCH}/pictures/{self.camera}")["points"]

    def edit(self):
        """Moves up to three clicks at once, until it is acknowledged, refused or given up."""
        names = self.rng.sample(sorted(self.places), self.rng.randint(1, 3))
        batch = {f"moved_point.{self.rng.getrandbits(64):016x}": name for name in names}
        places = {name: [self.rng.uniform(0, 900), self.rng.uniform(0, 500)] for name in names}
        edits = [
            {
                "id": number,
                "edit": {
                    "kind": "moved_point",
                    "camera": self.camera,
                    "marking": name,
                    "was": self.places[name],
                    "xy": places[name],
                },
            }
            for number, name in batch.items()
        ]
        began = datetime.now(UTC)
        self.sent |= {each["id"]: (each["edit"], began) for each in edits}
        corrections = f"{page_client.MATCH}/corrections"
        while (answer := self.ask("POST", corrections, {"edits": edits})) is None:
            self.cuts += 1
            self.revive()
            self.await_server()
            if self.rng.random() < 0.3:
                self.given_up |= set(batch)
                self.look()
                return
        if answer[0] != 200:
            self.refused.append(f"{answer[1]}")
            self.look()
            return
        self.answers += 1
        self.acknowledged |= dict.fromkeys(batch, datetime.now(UTC))
        self.places |= places

    def get(self, path):
        while (answer := self.ask("GET", path)) is None:
            self.revive()
            self.await_server()
        assert answer[0] == 200, answer
        return answer[1]

    def ask(self, method, path, body=None):
        """Status, content and cookie of the answer; None where the server is gone."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE)
        try:
            content = None if body is None else json.dumps(body)
            connection.request(method, path, content, self.headers)
            answer = connection.getresponse()
            cookie = answer.headers.get("set-cookie", "")
            return answer.status, json.loads(answer.read()), cookie
        except (OSError, http.client.HTTPException, json.JSONDecodeError):
            return None
        finally:
            connection.close()

    def await_server(self):
        deadline = time.monotonic() + PATIENCE
        while self.ask("GET", "/api/health") is None:
            assert time.monotonic() < deadline, "the server does not come back"
            time.sleep(0.02)


def account(project, editors):
    """Return the faults of a journal after interrupted edits; empty if there are none."""
    store = Store.open(str(project))
    journal = read_journal(store, TINY)
    kept = [each for each in journal.records if isinstance(each, Correction)]
    counts = Counter(each.id for each in kept)
    found = [f"{name} is there {n} times" for name, n in counts.items() if n > 1]
    found += journal.damage
    known = {name: editor for editor in editors for name in editor.sent}
    found += [f"no editor sent {name}" for name in counts if name not in known]
    for each in kept:
        if (editor := known.get(each.id)) is None:
            continue
        edit, began = editor.sent[each.id]
        said = each.edit.model_dump(mode="json", include=set(edit))
        if said != edit or each.who != editor.who:
            found.append(f"{each.id} says {said} by {each.who}")
        if not began <= each.made_at <= editor.acknowledged.get(each.id, datetime.now(UTC)):
            found.append(f"{each.id} was made at {each.made_at}")
    clicked = open_match(store, TINY).folder.clicked
    for editor in editors:
        found += editor.refused
        found += [f"{name} was lost" for name in editor.acknowledged if name not in counts]
        mine = [each.id for each in kept if each.id in editor.acknowledged]
        if mine != [name for name in editor.acknowledged if name in counts]:
            found.append(f"edits of {editor.who} are out of order")
        places = {each.name: list(each.xy) for each in clicked[editor.camera].points}
        if places != editor.places:
            found.append(f"{editor.camera} is not as {editor.who} left it")
    return found
