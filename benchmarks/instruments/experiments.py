"""Dictionary from the name of a scenario to the experiment whose configuration the benchmarks use."""

from experiments import freefall, inclined, perturbed, released

EXPERIMENTS = {"freefall": freefall, "inclined": inclined, "perturbed": perturbed, "released": released}
