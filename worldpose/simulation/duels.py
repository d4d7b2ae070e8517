"""Duels: players' kicks, headers, tackles and saves at the touches of the ball."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.simulation.ball import Touch
from worldpose.simulation.motions import Action, Motion
from worldpose.simulation.moves import jump, kick
from worldpose.simulation.paths import MARGIN, STEP
from worldpose.simulation.settings import ActionRates
from worldpose.simulation.tumbles import dive, fall, slide

CALL: Final = 2.5
"""Time before a touch at which a player goes for the ball [s]."""
REACH: Final = 1.8
"""Distance from which the ball is played [m]: a player who is farther away at the start of the
motion leaves it."""
KICK_SPEED: Final = 3.2
"""Speed of a kicker [m/s]; kickers in motion capture run up at 3 to 3.5 m/s."""
JUMP_SPEED: Final = 1.8
"""Speed of a person who jumps off both feet [m/s]."""
SLIDE_SPEED: Final = 5.5
"""Speed of a person who slides in [m/s]."""
DIVE_SPEED: Final = 3.3
"""Sideward speed of a goalkeeper at take-off [m/s]; measurements give 3.9 +- 0.3 m/s."""
DIVE_REACH: Final = (0.7, 3.5)
"""A goalkeeper catches balls nearer than the first standing, and lets in balls beyond the second
[m]."""
SETTLE: Final = 0.35
"""Time before take-off with constant pace [s]."""

AT_EASE, COASTING, STOPPING, PUSHING = range(4)
"""Modes of movement: free; constant velocity; to a stop; sideward, off a leg."""


@dataclass(frozen=True, eq=False)
class _Call:
    """A person's planned action at a touch."""

    person: int
    touch: Touch
    motion: Motion
    speed: float
    aside: float = 0.0


class Duels:
    """The touches of a game and the players' responses; updated during the game.

    Attributes:
        mode: (samples, people), mode of movement.
        most: (samples, people), speed limit before an action [m/s].
        push: (samples, people, 2), acceleration off a leg [m/s^2].
        actions: of each person.
    """

    def __init__(
        self,
        time: Floats,
        touches: tuple[Touch, ...],
        team: NDArray[np.int64],
        players: int,
        rates: ActionRates,
        rng: np.random.Generator,
    ) -> None:
        """Take the game's arguments; players are the first people, of both teams in turn."""
        self._time, self._team, self._players = time, team, players
        self._rates, self._rng = rates, rng
        self._waiting, self._calls = list(touches), list[_Call]()
        self._busy_until = np.full(len(team), -np.inf)
        self.mode = np.full((len(time), len(team)), AT_EASE, dtype=np.int8)
        self.most = np.full((len(time), len(team)), np.inf)
        self.push = np.zeros((len(time), len(team), 2))
        self.actions = [list[Action]() for _ in team]

    def advance(
        self, sample: int, position: Floats, velocity: Floats, heading: Floats
    ) -> dict[int, tuple[Floats, float]]:
        """Update responses; return targets [m] of people on the ball and times left [s].

        Args:
            sample: its index.
            position: (people, 2) [m].
            velocity: (people, 2) [m/s].
            heading: (people,) [rad].
        """
        now = float(self._time[sample])
        while self._waiting and self._waiting[0].time - CALL <= now:
            self._call(self._waiting.pop(0), now, position)
        due = [call for call in self._calls if call.touch.time - call.motion.blow <= now]
        for call in due:
            self._calls.remove(call)
            self._begin(call, sample, position, velocity, heading)
        return {
            call.person: (call.touch.place, call.touch.time - now)
            for call in self._calls
            if call.touch.kind != "save"
        }

    def _call(self, touch: Touch, now: float, position: Floats) -> None:
        far = np.linalg.norm(position - touch.place, axis=-1)
        free = np.flatnonzero((np.arange(len(far)) < self._players) & (self._busy_until <= now))
        field = free[free >= 2]
        if touch.kind == "save":
            keeper = int(touch.place[0] > 0.0)
            if keeper in free:
                climb = self._rng.uniform(0.8, 2.2)
                self._add(_Call(keeper, touch, dive(climb), np.inf))
            return
        if not len(field):
            return
        first = int(field[np.argmin(far[field])])
        others = field[self._team[field] != self._team[first]]
        second = int(others[np.argmin(far[others])]) if len(others) else -1
        draws = self._rng.random(3)
        if touch.kind == "header":
            for person, draw in ((first, draws[0]), (second, draws[1])):
                if person >= 0:
                    self._add(_Call(person, touch, jump(0.28 + 0.17 * draw), JUMP_SPEED))
        elif touch.kind == "tackle" and second >= 0 and far[second] < 8.0:
            self._add(_Call(second, touch, slide(), SLIDE_SPEED))
            tripped = draws[0] < self._rates.tripped
            motion = fall() if tripped else jump(0.22 + 0.1 * draws[1], hurdle=True)
            self._add(_Call(first, touch, motion, 4.0 if tripped else 2.5))
        else:
            length = float(np.linalg.norm(touch.target - touch.place))
            power = 1.0 if touch.kind == "shot" else float(np.clip(0.3 + length / 40.0, 0.4, 0.9))
            self._add(_Call(first, touch, kick(power), KICK_SPEED))

    def _add(self, call: _Call) -> None:
        self._calls.append(call)
        self._busy_until[call.person] = call.touch.time + 0.5
        begin = call.touch.time - call.motion.blow
        first, behind = (
            round((when + MARGIN) / STEP) for when in (begin - 0.5, begin + call.motion.duration)
        )
        stretch = slice(max(first, 0), max(behind, 0))
        self.most[stretch, call.person] = call.speed

    def _begin(
        self, call: _Call, sample: int, position: Floats, velocity: Floats, heading: Floats
    ) -> None:
        person, motion, begin = call.person, call.motion, float(self._time[sample])
        ahead = call.touch.time - begin
        way = call.touch.place - position[person] - ahead * velocity[person]
        facing = heading[person]
        aside = np.array([-np.sin(facing), np.cos(facing)])
        left, turn = bool(self._rng.random() < 0.5), 0.0
        if motion.name == "dive":
            reach = float(way @ aside)
            if not DIVE_REACH[0] < abs(reach) < DIVE_REACH[1]:
                return
            left = reach > 0.0
        elif np.linalg.norm(way) > REACH:
            self.most[sample:, person] = np.inf
            return
        if motion.name == "kick":
            course = call.touch.target - call.touch.place
            off = (np.arctan2(course[1], course[0]) - facing + np.pi) % (2.0 * np.pi) - np.pi
            turn = float(np.clip(off, -0.7, 0.7))
            # Most kick with the right foot; a ball to the left of the body needs the left one.
            left = bool(self._rng.random() < 0.2)
        self.actions[person].append(Action(begin, motion, left, turn))
        end = begin + motion.duration
        self._busy_until[person] = end
        self.most[sample:, person] = np.inf
        if motion.stops is None:
            self._set(self.most, person, begin, begin + motion.blow, call.speed)
        if motion.flight is not None:
            off_ground, land = motion.flight
            self._set(self.mode, person, begin + off_ground - SETTLE, begin + land, COASTING)
            if motion.name == "dive":
                self._set(self.mode, person, begin, begin + 0.2, STOPPING)
                self._set(self.mode, person, begin + 0.2, begin + off_ground, PUSHING)
                pace = DIVE_SPEED / (off_ground - 0.2) * (1.0 if left else -1.0)
                self._set(self.push, person, begin + 0.2, begin + off_ground, pace * aside)
            else:
                self._set(self.most, person, begin, begin + land + 0.3, call.speed)
        if motion.stops is not None:
            still = (begin + motion.stops, begin + motion.moves_again)
            self._set(self.mode, person, *still, STOPPING)
            # After getting up, people do not sprint at once.
            self._set(self.most, person, still[1], end, 1.5)

    def _set(
        self, array: NDArray[Any], person: int, begin: float, end: float, value: float | Floats
    ) -> None:
        first, behind = (max(round((when + MARGIN) / STEP), 0) for when in (begin, end))
        array[first:behind, person] = value


def overlapping(actions: list[Action], begin: float, end: float) -> bool:
    """Return whether an action overlaps an interval [s]."""
    return any(action.begin < end and action.end > begin for action in actions)


def in_order(actions: list[Action]) -> tuple[Action, ...]:
    """Return actions by their start, without those that overlap an earlier one."""
    kept: list[Action] = []
    for action in sorted(actions, key=lambda action: action.begin):
        if not overlapping(kept, action.begin, action.end):
            kept.append(replace(action))
    return tuple(kept)
