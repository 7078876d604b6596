"""How an estimator is played and scored, episode by episode, and how scores are stored."""
