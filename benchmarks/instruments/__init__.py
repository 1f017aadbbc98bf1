"""Modules that several benchmarks measure with: clocks, fresh processes, reference images, starts and classifiers."""
