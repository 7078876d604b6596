"""Groups of trials that try to break the package. Each is a module with ``MOST``, the largest
number of its trials, and a function ``trials(material, rng)`` that yields them, the same for one
seed."""
