"""Gaussians with independent components: the product of experts, and the divergence from the prior."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class Gaussian(NamedTuple):
    """A Gaussian with independent components."""

    mean: Float[Array, "*batch latent"]  # mean of each component
    log_var: Float[Array, "*batch latent"]  # natural logarithm of the variance of each component


def product_of_experts(
    experts: Gaussian, present: Bool[Array, "modality *batch"], prior: Gaussian | None = None
) -> Gaussian:
    """The normalised product of the prior and of the experts that are present.

    `q(z | X) = p(z) prod_{m in X} N(z; mean_m, var_m) / Z`. With the precisions `T_m = 1 / var_m`, and `mean_0` and
    `T_0` of the prior, its variance is `var = 1 / (T_0 + sum_m T_m)`, and its mean is
    `var (T_0 mean_0 + sum_m T_m mean_m)`.

    Args:
        experts: Mean and log variance of each expert, `(modality, *batch, latent)`. Absent experts may have any finite
            values.
        present: True for each expert that is present, `(modality, *batch)`.
        prior: `(*batch, latent)`. None for the standard normal `N(0, I)`.

    Source: the paper's equation for the product of experts (PoE), and Wu and Goodman 2018, section 2.2.
    """
    precision = jnp.where(present[..., None], jnp.exp(-experts.log_var), 0)
    summed = jnp.sum(precision * experts.mean, axis=0)
    if prior is None:
        total = 1 + jnp.sum(precision, axis=0)
    else:
        total = jnp.exp(-prior.log_var) + jnp.sum(precision, axis=0)
        summed = summed + jnp.exp(-prior.log_var) * prior.mean
    return Gaussian(summed / total, -jnp.log(total))


def kl_standard_normal(g: Gaussian) -> Float[Array, "*batch"]:
    """Kullback-Leibler divergence of a Gaussian from the standard normal prior (nats).

    `KL(g || N(0, I)) = sum(mean^2 + var - 1 - log var) / 2`, summed over the latent components.
    """
    return 0.5 * jnp.sum(g.mean**2 + jnp.exp(g.log_var) - 1 - g.log_var, axis=-1)


def kl_divergence(g: Gaussian, prior: Gaussian) -> Float[Array, "*batch"]:
    """Kullback-Leibler divergence of a Gaussian from another one (nats), summed over the latent components.

    `KL(g || p) = sum((mean - mean_p)^2 / var_p + var / var_p - 1 - log(var / var_p)) / 2`.
    """
    log_ratio = g.log_var - prior.log_var
    apart = (g.mean - prior.mean) ** 2 * jnp.exp(-prior.log_var)
    return 0.5 * jnp.sum(apart + jnp.exp(log_ratio) - 1 - log_ratio, axis=-1)
