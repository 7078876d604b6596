"""Trainers of learned estimators, a module or package each: a Config, whose ``episodes`` says how
many episodes the training takes, and `train`. One whose Config says 0 plays its own; see
`pinnobs_gym.training.by_name.train`. If there is more to see of what `train` returns than its
estimates, there is ``figures(system, trained, record)``, too: pictures by name. A module without
both a Config and `train` is no trainer."""
