"""Diagonal Gaussians: the product of experts with the prior, and the divergence from the prior."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class Gaussian(NamedTuple):
    """A Gaussian with independent components."""

    mean: Float[Array, "*batch latent"]
    log_var: Float[Array, "*batch latent"]


def product_of_experts(experts: Gaussian, present: Bool[Array, "modality *batch"]) -> Gaussian:
    """The normalised product of the standard normal prior and of every expert that is present.

    `q(z | X) = N(0, I) prod_{m in X} N(mean_m, var_m) / Z`. With the precisions `T_m = 1 / var_m`,
    `var = 1 / (1 + sum_m T_m)` and `mean = var sum_m T_m mean_m`. Without any expert it is the prior.

    Args:
        experts: mean and log variance, `(modality, *batch, latent)`. Absent ones may hold any finite numbers.
        present: which experts count, `(modality, *batch)`.

    Returns:
        The product, `(*batch, latent)`.

    Source: the paper's equation for PoE, and Wu and Goodman 2018, section 2.2.
    """
    precision = jnp.where(present[..., None], jnp.exp(-experts.log_var), 0)
    total = 1 + jnp.sum(precision, axis=0)
    return Gaussian(jnp.sum(precision * experts.mean, axis=0) / total, -jnp.log(total))


def kl_standard_normal(g: Gaussian) -> Float[Array, "*batch"]:
    """Divergence from the prior in nats, `KL(g || N(0, I)) = sum(mean^2 + var - 1 - log var) / 2`."""
    return 0.5 * jnp.sum(g.mean**2 + jnp.exp(g.log_var) - 1 - g.log_var, axis=-1)
