"""Measurements of speed, endurance, accuracy and information. Each module is a command that describes itself."""
