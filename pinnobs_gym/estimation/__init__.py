"""What an estimator is, and the mathematics that estimators share."""
