"""Commands that measure speed, endurance, accuracy, and the information in tactile data.

The option `--help` of each command describes the command.
"""
