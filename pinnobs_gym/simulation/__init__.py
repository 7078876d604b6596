"""The plant, its simulation, and the conditions that change an episode."""
