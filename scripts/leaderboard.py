"""Score every estimator on every system, and write the tables.

This is `pinnobs leaderboard`, with the same options.
"""

import sys

from pinnobs_gym.cli import main

if __name__ == "__main__":
    sys.exit(main(["leaderboard", *sys.argv[1:]]))
