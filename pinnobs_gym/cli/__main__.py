"""``python -m pinnobs_gym.cli``: the command `pinnobs`."""

from pinnobs_gym.cli import program

if __name__ == "__main__":
    program()
