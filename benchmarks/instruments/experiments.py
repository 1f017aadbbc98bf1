"""The experiments whose configurations the benchmarks use, by the name of their scenario."""

from experiments import freefall, inclined, perturbed, released

EXPERIMENTS = {"freefall": freefall, "inclined": inclined, "perturbed": perturbed, "released": released}
