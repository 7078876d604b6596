"""Trainers of learned estimators.

A trainer is a subclass of `pinnobs_gym.training.trainer.Trainer` that assigns ``name``, in a module
of this package or in the ``__init__`` of a subpackage; the registry finds it by that name. Its
settings are a Config, a subclass of `pinnobs_gym.training.settings.TrainingConfig`, whose
``records`` gives the number of recorded episodes to train on; 0 means that the trainer plays
episodes itself. `pinnobs_gym.training.by_name.train_by_name` runs a training. Modules without such
a class hold code that trainers share.
"""
