"""The environments: a system's episodes, simulated whole at reset and played step by step."""
