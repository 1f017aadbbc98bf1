"""What is measured: speed, endurance, invariance, what touch tells; each module's own docstring says how."""
