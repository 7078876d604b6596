"""Trainers of learned estimators, a module or package each: a Config, whose ``episodes`` says how
many episodes the training takes, and `train`; and, if there is more to see of what it returns than
its estimates, ``figures(system, trained, record)``: pictures by name."""
