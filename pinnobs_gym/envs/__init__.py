"""The environments: episodes of a system, simulated completely at reset and played step by step."""
