"""Football: the ball, duels for it, and the paths of two teams and officials."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import interp1d

from data_contracts.arrays import Floats
from worldpose.simulation.falls import dive, fall, slide
from worldpose.simulation.motions import SETTLE, Action, Motion, jump, kick
from worldpose.simulation.paths import MARGIN, STEP, GroundPath, drift, keep_ready
from worldpose.simulation.settings import ActionRates, CrowdSettings

PASS_EVERY: Final = (2.0, 4.5)
"""Time between passes [s]."""
PASS_LENGTH: Final = 12.0
"""Standard deviation of a pass per axis [m]."""
SHOT_RANGE: Final = 28.0
"""Maximum distance from the goal for shots [m]."""
SHOT_SPEED: Final = 24.0
"""Mean speed of a shot on its way [m/s]; instep kicks of trained players leave at 25 to 34 m/s."""
GOAL_LINE: Final = 51.5
"""Where the goalkeeper catches shots [m]: before the line of a pitch of 105 m."""
HELD: Final = 2.0
"""Time that a goalkeeper keeps the ball [s]."""


@dataclass(frozen=True, eq=False)
class Touch:
    """A player's touch of the ball.

    Attributes:
        time: [s].
        place: (2,) [m].
        target: (2,) destination of the ball [m].
        kind: a kick on the ground; a header that two contest; a kick that an opponent slides into;
            a shot; a save.
    """

    time: float
    place: Floats
    target: Floats
    kind: Literal["pass", "header", "tackle", "shot", "save"]


@dataclass(frozen=True, eq=False)
class Ball:
    """Trajectory of the ball.

    Attributes:
        position: (samples, 2) [m], every `STEP`.
        touches: touches in temporal order.
    """

    position: Floats
    touches: tuple[Touch, ...]


def roll_ball(time: Floats, rates: ActionRates, rng: np.random.Generator) -> Ball:
    """Return a ball that goes from pass to pass and stays in play.

    Args:
        time: (samples,) [s], every `STEP`.
        rates: shares of headers, tackles and shots.
        rng: draws passes and touches.
    """
    place = rng.uniform(-1.0, 1.0, 2) * [30.0, 18.0]
    when, places, kinds = [float(time[0])], [place], ["pass"]
    while when[-1] < time[-1]:
        chance, across = rng.random(), rng.uniform(-3.3, 3.3)
        wait, way = rng.uniform(PASS_EVERY[0], PASS_EVERY[1]), PASS_LENGTH * rng.standard_normal(2)
        goal = np.array([np.copysign(GOAL_LINE, place[0]), across])
        far = float(np.linalg.norm(goal - place))
        if kinds[-1] == "pass" and far < SHOT_RANGE and rng.random() < rates.shots:
            kinds[-1] = "shot"
            when += [when[-1] + far / SHOT_SPEED, when[-1] + far / SHOT_SPEED + HELD]
            places += [goal, goal]
            kinds += ["save", "pass"]
            place = goal
            continue
        # Play drifts back to the middle third instead of staying in a corner.
        place = np.clip(0.9 * place + way, [-46.0, -29.0], [46.0, 29.0])
        when.append(when[-1] + wait)
        places.append(place)
        high = chance < rates.headers
        kinds.append("header" if high else "tackle" if chance > 1.0 - rates.tackles else "pass")
    # Smoothed over a third of a second: the target of people's gaze must not jump.
    raw = np.stack([np.interp(time, when, axis) for axis in np.array(places).T], axis=-1)
    half = round(0.35 / STEP)
    kernel = np.hanning(2 * half + 1)
    padded = np.pad(raw, ((half, half), (0, 0)), mode="edge")
    position = [np.convolve(axis, kernel / kernel.sum(), mode="valid") for axis in padded.T]
    touches = tuple(
        Touch(when[n], places[n], places[n + 1], kinds[n])  # type: ignore[arg-type]
        for n in range(1, len(when) - 1)
    )
    return Ball(np.stack(position, axis=-1), touches)


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
        max_speed: (samples, people), speed limit before an action [m/s].
        push: (samples, people, 2), acceleration off a leg [m/s^2].
        actions: actions of each person.
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
        self.max_speed = np.full((len(time), len(team)), np.inf)
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
        self.max_speed[stretch, call.person] = call.speed

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
            self.max_speed[sample:, person] = np.inf
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
        self.max_speed[sample:, person] = np.inf
        if motion.stops is None:
            self._set(self.max_speed, person, begin, begin + motion.blow, call.speed)
        if motion.flight is not None:
            off_ground, land = motion.flight
            self._set(self.mode, person, begin + off_ground - SETTLE, begin + land, COASTING)
            if motion.name == "dive":
                self._set(self.mode, person, begin, begin + 0.2, STOPPING)
                self._set(self.mode, person, begin + 0.2, begin + off_ground, PUSHING)
                pace = DIVE_SPEED / (off_ground - 0.2) * (1.0 if left else -1.0)
                self._set(self.push, person, begin + 0.2, begin + off_ground, pace * aside)
            else:
                self._set(self.max_speed, person, begin, begin + land + 0.3, call.speed)
        if motion.stops is not None:
            moves_again = begin + motion.moves_again
            self._set(self.mode, person, begin + motion.stops, moves_again, STOPPING)
            # After getting up, people do not sprint at once.
            self._set(self.max_speed, person, moves_again, end, 1.5)

    def _set(
        self, array: NDArray[Any], person: int, begin: float, end: float, value: float | Floats
    ) -> None:
        first, behind = (max(round((when + MARGIN) / STEP), 0) for when in (begin, end))
        array[first:behind, person] = value


def overlaps_any(actions: list[Action], begin: float, end: float) -> bool:
    """Return whether an action overlaps an interval [s]."""
    return any(action.begin < end and action.end > begin for action in actions)


def sort_actions(actions: list[Action]) -> tuple[Action, ...]:
    """Return actions by their start, without those that overlap an earlier one."""
    kept: list[Action] = []
    for action in sorted(actions, key=lambda action: action.begin):
        if not overlaps_any(kept, action.begin, action.end):
            kept.append(replace(action))
    return tuple(kept)


FORMATION: Final = np.array(
    # goalkeeper, four defenders, three midfielders, three forwards
    [
        [-47.0, 0.0],
        *([-22.0, 21.0], [-25.0, 7.0], [-25.0, -7.0], [-22.0, -21.0]),
        *([-8.0, 13.0], [-11.0, 0.0], [-8.0, -13.0]),
        *([9.0, 19.0], [12.0, 0.0], [9.0, -19.0]),
    ]
)
"""Places of a 4-3-3 that attacks towards positive x, while the ball is at the centre spot [m]."""
FOLLOW: Final = np.array([0.60, 0.45])
"""Formation shift along x and y relative to the ball's displacement [1]: teams stay compact."""
KEEPER_FOLLOW: Final = np.array([0.12, 0.12])
"""The same for goalkeepers, who stay near their goal [1]."""
ROAM: Final = 8.0
"""Drift of players from their place in the formation [m], standard deviation per axis."""
ROAM_TIME: Final = 10.0
"""Correlation time of that drift [s]."""
PRESSING: Final = 2
"""Players of each team who go for the ball: one on it, one in support."""
SPRINT_EVERY: Final = 45.0
"""Mean time between a player's sprints [s]."""
SPRINT_TIME: Final = 2.5
"""Planned duration of a sprint [s]."""
TOP_SPEED: Final = (7.8, 9.2)
"""Range over players [m/s]."""
ACCELERATION: Final = 5.0
"""Maximum at a standstill, falling to zero at top speed; maximum in braking and turns [m/s^2]."""
REACTION: Final = 0.5
"""Time constant of a wished change of velocity [s]."""
JERK_TIME: Final = 0.12
"""Time constant of the acceleration [s]."""
EAGERNESS: Final = 0.38
"""Speed wished per metre to the target [1/s]: 10 m away they jog, 20 m away they run hard."""
NEAR_ENOUGH: Final = 2.0
"""A player that near the target stands [m], until the target is `WORTH_GOING` away."""
WORTH_GOING: Final = 5.0
"""[m]"""
BODY_SPACE: Final = 1.3
"""Distance below which players make way for each other [m]."""
TURN_TIME: Final = 0.15
"""Time constant of a body's turn to its direction of movement or gaze [s]."""
TURN_RATE: Final = 7.0
"""Maximum turn rate of a body [rad/s]."""


def play(
    crowd: CrowdSettings, duration: float, rng: np.random.Generator
) -> tuple[list[GroundPath], GroundPath]:
    """Return the paths of all people, players by team and then officials, and the path of the ball.

    Every person steers for a target that moves: players for their place in a formation that shifts
    with the ball, the nearest of each team for the ball, a sprinter for open space, the referee
    for a place near play, assistants along the touch lines. Targets need not be smooth: people
    accelerate within human bounds (docs/explanation/simulation.md).

    Args:
        crowd: number of people and of officials among them.
        duration: time covered besides the margins [s].
        rng: draws play; the same for any number of cameras.
    """
    samples = round((duration + 2.0 * MARGIN) / STEP) + 1
    time = np.linspace(-MARGIN, -MARGIN + (samples - 1) * STEP, samples)
    players = max(crowd.people - crowd.officials, 0)
    team = np.arange(crowd.people) % 2
    side = np.where(team == 0, 1.0, -1.0)
    game = roll_ball(time, crowd.actions, rng)
    ball = game.position
    targets, hurry = _draw_targets(time, ball, players, crowd.people, side, rng)
    top = rng.uniform(TOP_SPEED[0], TOP_SPEED[1], crowd.people)
    duels = Duels(time, game.touches, team, players, crowd.actions, rng)

    position, velocity = targets[0].copy(), np.zeros((crowd.people, 2))
    push, moving = np.zeros((crowd.people, 2)), np.ones(crowd.people, dtype=bool)
    look = ball[0] - position
    heading = np.arctan2(look[:, 1], look[:, 0])
    places = np.empty((samples, crowd.people, 2))
    speeds, headings = np.empty((2, samples, crowd.people))
    for i in range(samples):
        target = targets[i].copy()
        for which in (0, 1):
            mates = np.flatnonzero((team[:players] == which) & (np.arange(players) >= 2))
            far = np.linalg.norm(position[mates] - ball[i], axis=-1)
            for rank, mate in enumerate(mates[np.argsort(far, kind="stable")[:PRESSING]]):
                target[mate] = ball[i] - side[mate] * np.array([0.8 + 4.0 * rank, 0.5 * rank])
        haste = np.full(crowd.people, np.nan)
        for person, (place, left) in duels.advance(i, position, velocity, heading).items():
            target[person] = place
            haste[person] = np.linalg.norm(place - position[person]) / max(left, 0.3)
        mode = duels.mode[i]
        velocity, push, moving = _steer(
            position,
            velocity,
            push,
            moving,
            target - position,
            _Wishes(hurry[i], haste, np.minimum(duels.max_speed[i], top), mode, duels.push[i]),
            top,
        )
        places[i], headings[i] = position, heading
        speeds[i] = np.linalg.norm(velocity, axis=-1)
        look = np.where(speeds[i][:, None] > 0.6, velocity, ball[i] - position)
        turn = np.arctan2(look[:, 1], look[:, 0]) - heading
        turn = (turn + np.pi) % (2.0 * np.pi) - np.pi
        turn = np.clip(turn / TURN_TIME, -TURN_RATE, TURN_RATE)
        heading = heading + np.where(mode == AT_EASE, turn, 0.0) * STEP
        position = position + velocity * STEP
    paths = [
        GroundPath(time, places[:, n], headings[:, n], speeds[:, n], sort_actions(duels.actions[n]))
        for n in range(crowd.people)
    ]
    for keeper in range(min(2, players)):
        goal = np.array([-52.5, 0.0]) * side[keeper]
        paths[keeper] = keep_ready(paths[keeper], goal, ball)
    way = np.gradient(ball, STEP, axis=0)
    course = np.unwrap(np.arctan2(way[:, 1], way[:, 0]))
    return paths, GroundPath(time, ball, course, np.linalg.norm(way, axis=-1))


def _draw_targets(
    time: Floats,
    ball: Floats,
    players: int,
    people: int,
    side: Floats,
    rng: np.random.Generator,
) -> tuple[Floats, Floats]:
    """Return targets (samples, people, 2) [m], and by person a factor on the usual speed there."""
    samples = len(time)
    # One knot per second, without the jitter of a random walk in between.
    knots = np.arange(time[0], time[-1] + 2.0)
    roam = ROAM * drift((len(knots), people, 2), ROAM_TIME, 1.0, rng)
    roam = interp1d(knots, roam, axis=0)(time)
    start = rng.random((samples, people)) < STEP / SPRINT_EVERY
    aims = rng.uniform([12.0, -10.0], [26.0, 10.0], (people, 2))
    sprinting = np.zeros((samples, people), dtype=bool)
    for sample, person in np.argwhere(start):
        sprinting[sample : sample + round(SPRINT_TIME / STEP), person] = True
    hurry = np.where(sprinting, 3.0, 1.0)
    targets = np.empty((samples, people, 2))
    for person in range(people):
        role = person // 2
        if person < players:
            home = FORMATION[role % len(FORMATION)]
            follow, roaming = (KEEPER_FOLLOW, 0.3) if role == 0 else (FOLLOW, 1.0)
            targets[:, person] = side[person] * home + follow * ball + roaming * roam[:, person]
            if role > 0:
                run = side[person] * aims[person]
                targets[:, person] += np.where(sprinting[:, person, None], run, 0.0)
        elif person == players:
            targets[:, person] = 0.9 * ball + [-4.0, 7.0] + 0.4 * roam[:, person]
        else:
            # An assistant keeps level with the last defender of the assistant's half.
            half = 1.0 if (person - players) % 2 else -1.0
            line = half * np.clip(25.0 + half * FOLLOW[0] * ball[:, 0], 0.0, 50.0)
            targets[:, person] = np.stack([line, np.full(samples, half * 35.2)], axis=-1)
    low, high = np.array([-51.0, -35.5]), np.array([51.0, 35.5])
    return np.clip(targets, low, high), hurry


@dataclass(frozen=True, eq=False)
class _Wishes:
    """Desired motion of every person (people,).

    Attributes:
        hurry: factor on the usual speed to the target [1].
        haste: speed that reaches the target in time [m/s]; NaN = free choice.
        max_speed: speed limit [m/s].
        mode: at ease, coasting, stopping or pushing off.
        off_leg: (people, 2), acceleration of those who push off [m/s^2].
    """

    hurry: Floats
    haste: Floats
    max_speed: Floats
    mode: NDArray[np.int8]
    off_leg: Floats


def _steer(
    position: Floats,
    velocity: Floats,
    push: Floats,
    moving: NDArray[np.bool_],
    way: Floats,
    wishes: _Wishes,
    top: Floats,
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return velocity, acceleration and a mask of people on the move, one step later."""
    far = np.linalg.norm(way, axis=-1)
    called = ~np.isnan(wishes.haste)
    moving = (far > np.where(moving, NEAR_ENOUGH, WORTH_GOING)) | called
    wish = np.where(called, wishes.haste, EAGERNESS * wishes.hurry * far)
    wish = np.where(moving, np.minimum(wish, wishes.max_speed), 0.0)
    wished = way * (wish / np.maximum(far, 1e-9))[:, None]
    apart = position[:, None] - position
    gap = np.linalg.norm(apart, axis=-1)
    near = np.clip(1.0 - gap / BODY_SPACE, 0.0, 1.0)
    wished = wished + 5.0 * (apart * (near / np.maximum(gap, 1e-9))[..., None]).sum(axis=1)
    wished = np.where((wishes.mode == STOPPING)[:, None], 0.0, wished)
    change = (wished - velocity) / REACTION
    # The limit of driving forces falls with speed, the limit of braking and turning does not.
    speed = np.linalg.norm(velocity, axis=-1)
    ahead = velocity / np.maximum(speed, 1e-9)[:, None]
    drive = (change * ahead).sum(-1)
    max_drive = ACCELERATION * np.maximum(1.0 - speed / top, 0.0)
    change = change + (np.minimum(drive, max_drive) - drive)[:, None] * ahead
    size = np.linalg.norm(change, axis=-1)
    change = change * np.minimum(1.0, ACCELERATION / np.maximum(size, 1e-9))[:, None]
    change = np.where((wishes.mode == COASTING)[:, None], 0.0, change)
    push = push + (change - push) * STEP / JERK_TIME
    push = np.where((wishes.mode == PUSHING)[:, None], wishes.off_leg, push)
    # A leg that pushed a person off the ground pushes no more.
    thrown = (wishes.mode == COASTING) & (np.linalg.norm(push, axis=-1) > ACCELERATION)
    push = np.where(thrown[:, None], 0.0, push)
    return velocity + push * STEP, push, moving
