"""Tools of the benchmarks: timing, new processes, reference images, starts, classifiers and emulated devices."""
