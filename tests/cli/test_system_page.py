"""The page of a system."""

from angles import Compass

from pinnobs_gym.cli.system_page import page
from pinnobs_gym.systems.satellite import Satellite


def test_the_page_says_which_states_and_outputs_repeat():
    text = page(Compass, "pinnobs/Compass-v0")
    for name in ("heading", "compass"):
        assert text.count(f"`{name}` repeats every 6.28319 rad: whole periods do not count.") == 1
    assert "repeats" not in page(Satellite, "pinnobs/Satellite-v0")
