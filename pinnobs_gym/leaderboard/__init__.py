"""Comparison of estimators from stored scores: standings, ranks, suites of jobs, and the page."""
