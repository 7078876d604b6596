"""What the group ``export`` of `benchmark.py` measures by: exported files, built and run."""
