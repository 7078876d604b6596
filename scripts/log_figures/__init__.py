"""Parts of the group ``logs`` of `scripts/benchmark.py`."""
