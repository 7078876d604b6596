"""The jobs of a leaderboard: what one is, which are left, and the processes that run them."""
