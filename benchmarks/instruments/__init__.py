"""Tools of the benchmarks, such as timers, calls in new processes, reference images and emulated devices."""
