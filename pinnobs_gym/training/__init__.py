"""What trainers share: finding them, the training loop, the log."""
