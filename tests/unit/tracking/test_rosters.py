import numpy as np
import pytest

from data_contracts.match import PlayerSpec
from worldpose.tracking.person import Person
from worldpose.tracking.rosters import people_allowed, within_limit
from worldpose.tracking.sightings import Sighting


def roster(red, blue, officials):
    return [
        *(PlayerSpec(id=f"r{n}", team="red") for n in range(red)),
        *(PlayerSpec(id=f"b{n}", team="blue") for n in range(blue)),
        *(PlayerSpec(id=f"o{n}", role="official") for n in range(officials)),
    ]


@pytest.mark.parametrize(
    ("people", "limit"),
    [((11, 11, 3), 25), ((16, 18, 1), 23), ((11, 11, 0), None), ((11, 5, 3), None)],
)
def test_eleven_of_each_team_and_the_officials_are_allowed_if_all_are_named(people, limit):
    assert people_allowed(roster(*people)) == limit


def person(number, first, last, evidence):
    nothing = Sighting(np.empty(0, int), np.empty(0), np.empty((0, 3)))
    someone = Person(number, np.empty((0, 3)), last, evidence=evidence)
    someone.sightings.update({first: nothing, last: nothing})
    return someone


def test_weakest_of_too_many_at_once_goes():
    people = [
        person(0, 0, 9, 9.0),
        person(1, 0, 4, 4.0),
        person(2, 3, 9, 5.0),
        person(3, 6, 9, 1.0),
    ]
    kept = within_limit(people, 2)
    assert [each.number for each in kept] == [0, 2]
    assert within_limit(people, None) == people
    assert within_limit([], 2) == []
