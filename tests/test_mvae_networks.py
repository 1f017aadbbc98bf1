"""The product of experts against dense linear algebra, sizes of the paper's networks, and batch normalisation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from sts_jax import mvae
from sts_jax.mvae import Gaussian, kl_standard_normal, product_of_experts

PAPER = mvae.Config(
    (
        mvae.Modality("visual", "image", (64, 64, 3)),
        mvae.Modality("tactile", "image", (64, 64, 3)),
        mvae.Modality("pose", "vector", (7,), 1000.0),
    )
)


def test_sizes_are_the_papers():
    _, params, _ = mvae.init(jax.random.key(0), PAPER)
    shapes = jax.tree.map(jnp.shape, nnx.to_pure_dict(params))
    encoder, decoder = shapes["encoders"]["visual"], shapes["decoders"]["tactile"]
    assert list(encoder["kernels"].values()) == [(4, 4, 3, 32), (4, 4, 32, 64), (4, 4, 64, 128), (4, 4, 128, 256)]
    assert encoder["first"]["kernel"] == (256 * 5 * 5, 512)
    assert encoder["second"]["kernel"] == (512, 2 * 256)
    assert decoder["first"]["kernel"] == (256, 256 * 5 * 5)
    assert list(decoder["kernels"].values()) == [(4, 4, 256, 128), (4, 4, 128, 64), (4, 4, 64, 32), (4, 4, 32, 3)]
    assert len(decoder["norms"]) == 3  # the last block is linear
    assert shapes["encoders"]["pose"]["first"]["kernel"] == (7, 512)


def vectors(*names):
    return tuple(mvae.Modality(name, "vector", (2,)) for name in names)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: mvae.Modality("visual", "image", (30, 32, 3)), "'visual' must be an 'image' of shape"),
        (lambda: mvae.Modality("pose", "vector", (2, 3)), "'pose' must be"),
        (lambda: mvae.Modality("visual", "image", (64, 64, 3), start=1.0), "start must be a grey value"),
        (lambda: mvae.Config(vectors("a", "a")), "each once"),
        (lambda: mvae.Config(vectors("a"), widths=(4,)), "widths must have 4 numbers"),
        (lambda: mvae.infer(*mvae.init(jax.random.key(0), mvae.Config(vectors("a")))[:2], {}), "at least one input"),
    ],
)
def test_a_value_out_of_range_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_batch_norm_weighs_samples():
    x = np.random.default_rng(0).normal(2, 3, size=(4, 5, 6, 7)).astype(np.float32)
    weights = np.array([2, 0, 1, 3])
    repeated = np.repeat(x.astype(np.float64), weights, axis=0)
    mean, var = repeated.mean((0, 1, 2)), repeated.var((0, 1, 2))
    norm = mvae.BatchNorm(7, momentum=0.9)
    y = norm(jnp.asarray(x), jnp.asarray(weights, jnp.float32))
    np.testing.assert_allclose(y, (x - mean) / np.sqrt(var + 1e-5), atol=1e-5)
    np.testing.assert_allclose(norm.mean[...], 0.1 * mean, rtol=1e-4)
    np.testing.assert_allclose(norm.var[...], 0.9 + 0.1 * var, rtol=1e-4)
    y = norm(jnp.asarray(x), None)
    np.testing.assert_allclose(y, (x - 0.1 * mean) / np.sqrt(0.9 + 0.1 * var + 1e-5), atol=1e-4)


@pytest.mark.slow
def test_an_untrained_model_uses_a_few_quiet_latents_and_leaves_the_others_at_the_prior():
    graphdef, params, stats = mvae.init(jax.random.key(1), PAPER)
    state = nnx.merge_state(params, stats)
    posterior = mvae.infer(graphdef, state, {"visual": jax.random.uniform(jax.random.key(2), (8, 64, 64, 3))})
    variance = np.exp(posterior.log_var)
    assert (variance[:, :16] < 0.2).all()
    # The prior's own precision and an expert's of variance 1 make one half.
    np.testing.assert_allclose(variance[:, 16:], 0.5, atol=0.02)
    assert np.abs(posterior.mean[:, 16:]).max() < 0.05
    nothing, active, other = mvae.decode(graphdef, state, jnp.zeros((3, 256)).at[1, 3].set(1).at[2, 100].set(1))["pose"]
    loud, quiet = (float(np.linalg.norm(x - nothing)) for x in (active, other))
    assert loud > 10 * quiet > 0


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
