"""Kazantzis-Kravaris-Luenberger observers: ż = Az + By driven by the output alone, x̂ = T*(z).

`dynamics` has (A, B) and the exact integration of z, `labels` the simulated states and their T(x),
`networks` the maps T and T*, `observer` the estimator and its file, `fitting` one training of one
network, `recipe` the settings and the course of a training, `pictures` the figures.
"""
