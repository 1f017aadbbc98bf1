"""Tools of the benchmarks: timing, new processes, reference images, trajectories, classifiers and emulated devices."""
