"""Placeholder."""

LIMIT = 5.0


def free_over_known(game):
    return None
