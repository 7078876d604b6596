"""The interface of estimators, and the mathematics that they share."""
