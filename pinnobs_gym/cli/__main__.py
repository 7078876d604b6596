"""``python -m pinnobs_gym.cli``: the command `pinnobs`."""

import sys

from pinnobs_gym.cli import main

if __name__ == "__main__":
    sys.exit(main())
