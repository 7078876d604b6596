"""Kazantzis-Kravaris-Luenberger observers: ż = Az + By driven by the output alone, x̂ = T*(z).

The map T of an autonomous plant depends on x alone. It is fitted on the states of simulated
episodes from the initial set, so that unbounded plants (Academic) are trained on the states
reached within an episode, and plants with several classes of states (Satellite) on the declared
class.

States around an attractor (Rössler's) come from infinity in finite time, so that T is not defined
there. If many initial states do, T is fitted along episodes that begin at states which the plant
reaches from them, with the z that it reaches, and T* along episodes from the initial states, too,
whose z begins as it does online.

A plant with inputs (InductionMotor) is not autonomous. Its T depends also on u(t), whose values
give the phase of a periodic input, and on the time since the first sample. Its z begins at the
first sample, not in the infinite past. Such a plant is not integrated backward, because the states
of a dissipative plant would diverge.

Modules: `config` has the settings, `labels` the simulated states and their T(x), `samples` these as
scaled tensors, `fitting` the training of one network, `two_stages` that of T and T*, `trainer` the
base class of the three trainers, `learned_poles` the design of poles by training, and `pictures`
the figures.
"""
