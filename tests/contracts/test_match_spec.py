import pytest

from data_contracts.match import CameraSpec, ClipSpec, MatchSpec, PlayerSpec


def roster(red, blue, officials):
    return (
        *(PlayerSpec(id=f"r{n}", team="red") for n in range(red)),
        *(PlayerSpec(id=f"b{n}", team="blue") for n in range(blue)),
        *(PlayerSpec(id=f"o{n}", role="official") for n in range(officials)),
    )


@pytest.mark.parametrize(
    ("people", "limit"),
    [((11, 11, 3), 25), ((16, 18, 1), 23), ((11, 11, 0), None), ((11, 5, 3), None)],
)
def test_eleven_of_each_team_and_the_officials_are_allowed_if_all_are_named(people, limit):
    spec = MatchSpec(
        match_id="final",
        fps=25.0,
        cameras=(CameraSpec(id="left", width=1920, height=1080),),
        clips=(ClipSpec(id="clip", first_frame=0, frame_count=1),),
        roster=roster(*people),
    )
    assert spec.max_people == limit
