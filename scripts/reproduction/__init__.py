"""Reproduction of the paper's tables and examples: printed figures, training and report."""
