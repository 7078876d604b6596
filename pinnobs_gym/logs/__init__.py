"""Sensor logs: their reading, what they say of a model, and the fit of its parameters."""
