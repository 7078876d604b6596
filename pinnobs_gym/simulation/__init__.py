"""What a plant is, how it moves, and how episodes depart from its setup."""
