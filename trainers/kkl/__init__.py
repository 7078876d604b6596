"""Kazantzis-Kravaris-Luenberger observers: ż = Az + By driven by the output alone, x̂ = T*(z).

T of an autonomous plant depends on x alone; it is fitted over the states that episodes of the
initial set visit, so that unbounded plants (Academic) are trained on what an episode's length
reaches, and plants with several classes of states (Satellite) on the declared one. A plant with
inputs (the motor) is not autonomous: its T is told u(t), whose values are the phase of a periodic
input, and how long ago z began, and starts at the first sample instead of in the infinite past;
nothing is integrated backward, along which a dissipative plant would run away.

`config` has the settings, `labels` the simulated states and their T(x), `samples` these as scaled
tensors, `fitting` one training of one network, `two_stages` that of both, `trainer` what the three
trainers share, `pictures` the figures.
"""
