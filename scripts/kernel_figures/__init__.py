"""Parts of the group ``kernels`` of `scripts/benchmark.py`."""
