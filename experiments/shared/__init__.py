"""The parts that experiments and commands share: configuration, stages, command line, progress and output."""
