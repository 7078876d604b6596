"""Styles of estimators."""

import numpy as np
import pytest

from pinnobs_gym.leaderboard.site import palette


def test_every_estimator_has_a_style_of_its_own():
    names = [f"e{i}" for i in range(3 * len(palette.LIGHT))]
    styles = palette.styles([*names, "peer"], "peer")
    assert len({(s.light, s.dash) for s in styles.values()}) == len(names) + 1
    assert len({(s.dark, s.shape) for s in styles.values()}) == len(names) + 1
    assert palette.styles(["peer", "e0"], "peer")["e0"] == styles["e0"]


def luminance(colour):
    parts = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))


@pytest.mark.parametrize(
    ("colours", "ground"), [(palette.LIGHT, "#ffffff"), (palette.DARK, "#14171b")]
)
def test_colours_stand_out_from_the_ground(colours, ground):
    """The contrast that WCAG 2 asks of graphics, by its own formula."""
    for colour in colours:
        high, low = sorted((luminance(colour), luminance(ground)), reverse=True)
        assert (high + 0.05) / (low + 0.05) >= 3
