"""Trainers of learned estimators, one file each: a Config and `train`."""
