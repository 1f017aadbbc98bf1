"""The product of experts and the divergence against dense linear algebra."""

import jax.numpy as jnp
import numpy as np
import pytest

from sts_jax.mvae import Gaussian, kl_standard_normal, product_of_experts


@pytest.mark.parametrize("subset", [(), (0,), (1,), (2,), (0, 1), (0, 2), (1, 2), (0, 1, 2)])
def test_linear_gaussian_model_has_its_exact_posterior_and_evidence(subset):
    """With the exact experts of z ~ N(0, I_2), x_m = a_m z + noise, the bound of every subset equals the evidence.

    Each x_m observes both components through an orthogonal matrix, so the posterior is diagonal and each expert
    `p(x_m | z)`, as a Gaussian in z, is too.
    """
    rng = np.random.default_rng(3)
    scale, noise = np.array([0.8, 1.7, 0.3]), np.array([0.5, 0.9, 0.2])
    turns = [np.linalg.qr(rng.normal(size=(2, 2)))[0] for _ in range(3)]
    loadings = [s * q for s, q in zip(scale, turns, strict=True)]
    z = rng.normal(size=2)
    x = [a @ z + s * rng.normal(size=2) for a, s in zip(loadings, noise, strict=True)]

    # The truth by dense linear algebra
    precision = np.eye(2) + sum(loadings[m].T @ loadings[m] / noise[m] ** 2 for m in subset)
    mean = np.linalg.solve(precision, sum((loadings[m].T @ x[m] / noise[m] ** 2 for m in subset), np.zeros(2)))
    evidence = 0.0
    if subset:
        stacked, given = np.concatenate([loadings[m] for m in subset]), np.concatenate([x[m] for m in subset])
        covariance = stacked @ stacked.T + np.diag(np.repeat(noise[list(subset)] ** 2, 2))
        evidence = -0.5 * (
            given @ np.linalg.solve(covariance, given)
            + np.linalg.slogdet(covariance)[1]
            + len(given) * np.log(2 * np.pi)
        )

    # Ours: expert m is p(x_m | z) as a density of z.
    experts = Gaussian(
        jnp.array([turns[m].T @ x[m] / scale[m] for m in range(3)]),
        jnp.array([[2 * np.log(noise[m] / scale[m])] * 2 for m in range(3)]),
    )
    q = product_of_experts(experts, jnp.array([m in subset for m in range(3)]))
    np.testing.assert_allclose(q.mean, mean, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(np.diag(1 / np.exp(np.asarray(q.log_var))), precision, rtol=1e-4, atol=1e-5)
    expected_likelihood = 0.0
    for m in subset:  # E_q log p(x_m | z), in closed form
        rest = x[m] - loadings[m] @ np.asarray(q.mean)
        spread = np.trace(loadings[m] @ np.diag(np.exp(np.asarray(q.log_var))) @ loadings[m].T)
        expected_likelihood -= 0.5 * ((rest @ rest + spread) / noise[m] ** 2 + 2 * np.log(2 * np.pi * noise[m] ** 2))
    np.testing.assert_allclose(expected_likelihood - kl_standard_normal(q), evidence, rtol=1e-4, atol=1e-4)
