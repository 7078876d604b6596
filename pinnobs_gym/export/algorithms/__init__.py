"""The estimators that are exported, one file a kind.

A file has a function ``algorithm(estimator, code, prior)``, which returns an
`pinnobs_gym.export.algorithm.Algorithm`, or None for an estimator of another kind.
"""
