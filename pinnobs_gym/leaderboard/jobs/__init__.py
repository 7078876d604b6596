"""The jobs of a leaderboard: their definition, planning, and the processes that run them."""
