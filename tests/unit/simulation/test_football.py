import numpy as np
import pytest

from worldpose.simulation import SCENARIOS
from worldpose.simulation.football import ACCELERATION, TURN_RATE, play
from worldpose.simulation.gait import stride_cycle
from worldpose.simulation.paths import MARGIN, STEP
from worldpose.simulation.settings import ActionRates

CROWD = SCENARIOS["match"].crowd
PLAYERS = 22


@pytest.fixture(scope="module")
def minute():
    return play(CROWD, 60.0, np.random.default_rng(1))


def field_players(minute):
    """Everybody but goalkeepers, who push off sideward with more than legs that run give."""
    return minute[0][2:]


@pytest.fixture(scope="module")
def speeds(minute):
    return np.array([path.speed for path in minute[0][:PLAYERS]])


def test_time_covers_the_clip_and_a_margin_on_either_side(minute):
    paths, ball = minute
    assert len(paths) == 25
    for path in (*paths, ball):
        # Sums of steps of 0.01: rounding only.
        assert path.time[0] == pytest.approx(-MARGIN, abs=1e-12)
        assert path.time[-1] == pytest.approx(60.0 + MARGIN, abs=1e-9)
        assert len(path.position) == len(path.heading) == len(path.speed) == len(path.time)


def test_speed_is_what_the_positions_say(minute):
    for path in minute[0]:
        moved = np.linalg.norm(np.diff(path.position, axis=0), axis=-1) / STEP
        np.testing.assert_allclose(moved, path.speed[:-1], atol=1e-9)


def test_the_distance_covered_is_that_of_a_match(speeds):
    # 10 to 13 km in 90 minutes are 1.9 to 2.4 m/s; the paper's clips come to 2.4 m/s.
    assert 1.7 < speeds.mean() < 2.6


def test_time_is_spent_as_in_match_analyses(speeds):
    shares = np.diff([(speeds < limit).mean() for limit in (-1.0, 0.25, 2.0, 4.2, 5.5, 20.0)])
    standing, walking, jogging, running, sprinting = shares
    # docs/explanation/simulation.md: a sixth standing, two fifths walking, a third jogging, the
    # rest fast.
    assert 0.08 < standing < 0.28
    assert 0.25 < walking < 0.50
    assert 0.20 < jogging < 0.45
    assert 0.03 < running < 0.15
    assert 0.003 < sprinting < 0.08


def test_nobody_is_faster_than_footballers_are(speeds):
    assert 6.5 < speeds.max() < 9.5  # a minute of 22 players holds a sprint


def test_accelerations_are_those_of_footballers(minute):
    for path in field_players(minute):
        velocity = np.diff(path.position, axis=0) / STEP
        acceleration = np.linalg.norm(np.diff(velocity, axis=0), axis=-1) / STEP
        # A lagged mean of accelerations within the limit is within the limit; rounding.
        assert acceleration.max() <= ACCELERATION + 1e-6
    fastest = np.array([np.abs(np.diff(path.speed)).max() / STEP for path in minute[0]])
    assert fastest.max() > 3.0  # hard starts and stops do happen


def test_accelerations_build_up_over_a_tenth_of_a_second(minute):
    for path in field_players(minute):
        velocity = np.diff(path.position, axis=0) / STEP
        jerk = np.linalg.norm(np.diff(velocity, 2, axis=0), axis=-1) / STEP**2
        # From full braking to full drive within the time constant of 0.12 s.
        assert jerk.max() < 2.0 * ACCELERATION / 0.12 + 1e-3


def test_bodies_face_where_they_run_and_turn_no_faster_than_people(minute):
    for path in minute[0]:
        assert np.abs(np.diff(path.heading)).max() / STEP <= TURN_RATE + 1e-9
        velocity = np.diff(path.position, axis=0)
        fast = path.speed[:-1] > 4.0
        course = np.arctan2(velocity[fast, 1], velocity[fast, 0])
        # A turn at 5 m/s^2 and 4 m/s is 1.25 rad/s, which a body follows 0.15 s late.
        assert np.cos(course - path.heading[:-1][fast]).min(initial=1.0) > 0.9


def test_everybody_stays_about_the_pitch(minute):
    for path in minute[0]:
        # Assistants run 1.2 m outside the touch line; a sprinter needs a few metres to stop.
        assert np.abs(path.position[:, 0]).max() < 52.5 + 3.0
        assert np.abs(path.position[:, 1]).max() < 34.0 + 5.0


def test_people_rarely_run_into_each_other(minute):
    place = np.array([path.position for path in minute[0]])[:, ::10]
    apart = np.linalg.norm(place[:, None] - place, axis=-1)
    apart[np.arange(25), np.arange(25)] = np.inf
    # Below half a metre is body contact, as in a duel.
    assert (apart < 0.5).mean() < 0.001
    assert (apart.min(axis=0) < 2.0).mean() > 0.02  # but duels there are


def test_teams_hold_their_halves_and_goalkeepers_their_goals(minute):
    place = np.array([path.position[:, 0].mean() for path in minute[0]])
    assert place[0] < -35.0
    assert place[1] > 35.0
    assert place[2:PLAYERS:2].mean() < place[3:PLAYERS:2].mean()


def test_the_ball_is_where_somebody_is(minute):
    paths, ball = minute
    place = np.array([path.position for path in paths[:PLAYERS]])
    nearest = np.linalg.norm(place - ball.position, axis=-1).min(axis=0)
    assert np.median(nearest) < 6.0


def test_fewer_people_and_nobody_can_play():
    assert play(CROWD.model_copy(update={"people": 0}), 1.0, np.random.default_rng(0))[0] == []
    few = CROWD.model_copy(update={"people": 3, "officials": 0})
    assert len(play(few, 1.0, np.random.default_rng(0))[0]) == 3


def test_strides_are_as_long_as_people_of_that_speed_make_them(minute):
    speed, rate = [], []
    for path in minute[0][:PLAYERS]:
        speed.append(path.speed[::10])
        rate.append(np.gradient(stride_cycle(path, 0.0), STEP)[::10])
    speed, rate = np.concatenate(speed), np.concatenate(rate)
    # Published (docs/explanation/simulation.md): a walker of 1.4 m/s makes 1.35 to 1.6 m, runners
    # of 3 m/s 75 to 95 strides per minute, sprinters at 7 to 9 m/s 1.8 to 2.3 per second.
    for at, shortest, longest in ((1.4, 1.35, 1.6), (3.0, 1.9, 2.4), (6.0, 3.2, 4.0)):
        near = np.abs(speed - at) < 0.1
        assert near.sum() > 20
        assert shortest < at / np.median(rate[near]) < longest


def test_the_ball_is_played_by_those_who_are_there(minute):
    paths, ball = minute
    kicks = headers = 0
    for path in paths[:PLAYERS]:
        for action in path.actions:
            when = action.begin + action.motion.blow
            if action.motion.name in ("kick", "jump") and 0.0 < when < 60.0:
                place, at = (
                    np.array([np.interp(when, path.time, axis) for axis in way.position.T])
                    for way in (path, ball)
                )
                # The ball's way is rounded over a third of a second: 2 m at 7 m/s.
                assert np.linalg.norm(place - at) < 3.5
                kicks += action.motion.name == "kick"
                headers += action.motion.name == "jump"
    # 18 touches per minute; for some, no person is near enough.
    assert 6 <= kicks <= 20
    assert headers <= 10


def test_nobody_does_two_things_at_once(minute):
    for path in minute[0]:
        for one, following in zip(path.actions, path.actions[1:], strict=False):
            assert one.end <= following.begin + 1e-9


def test_who_is_in_the_air_keeps_his_pace_and_who_lies_stays():
    rates = ActionRates(headers=0.4, tackles=0.4, shots=1.0, tripped=1.0)
    crowd = CROWD.model_copy(update={"actions": rates})
    paths = [path for seed in (4, 7) for path in play(crowd, 30.0, np.random.default_rng(seed))[0]]
    done = dict.fromkeys(("jump", "slide", "fall", "dive", "kick"), 0)
    for path in paths:
        velocity = np.diff(path.position, axis=0) / STEP
        for action in path.actions:
            motion, since = action.motion, path.time[:-1] - action.begin
            done[motion.name] = done.get(motion.name, 0) + 1
            if motion.flight is not None:
                flies = (since > motion.flight[0]) & (since < motion.flight[1])
                # Legs' last push dies down with 0.12 s: after a third of a second 6 % of it.
                assert np.ptp(velocity[flies], axis=0).max(initial=0.0) < 0.15
            if motion.stops is not None:
                lies = (since > motion.stops + 1.6) & (since < motion.moves_again)
                assert np.linalg.norm(velocity[lies], axis=-1).max(initial=0.0) < 0.3
    assert min(done.values()) > 0, done
