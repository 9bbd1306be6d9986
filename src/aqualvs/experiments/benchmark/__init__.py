"""The public benchmark set and the scores of systems on it."""
