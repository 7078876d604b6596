"""Running and scoring estimators episode by episode, and storing the scores."""
