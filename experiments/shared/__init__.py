"""Code that the experiments and commands share: configuration, stages, command line, progress and output."""
