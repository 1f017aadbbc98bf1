"""Commands that measure speed, endurance, accuracy, and the information in tactile data.

`--help` describes each command.
"""
