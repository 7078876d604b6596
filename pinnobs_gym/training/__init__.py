"""The trainer base class, training by name, the training loop, checkpoints and the log."""
