"""An estimator of one episode at a time, in a file that imports nothing."""


class Copied:
    """It repeats its first estimate."""

    def reset(self, xhat0, P0):
        self.xhat = xhat0

    def update(self, t, y, u):
        return self.xhat
