"""Estimators as C files of their own, for other programs and controllers."""
