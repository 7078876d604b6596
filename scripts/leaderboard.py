"""The main job: every estimator on every system, with tables at the end.

The same as `pinnobs leaderboard`, whose options it takes.
"""

import sys

from pinnobs_gym.cli import main

if __name__ == "__main__":
    sys.exit(main(["leaderboard", *sys.argv[1:]]))
