"""Conditions, priors and evidence of the MVAE against closed forms of linear Gaussian data and integrals on a grid."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx
from scipy import special

from sts_jax import mvae

pytestmark = pytest.mark.usefixtures("strict_ranks")

SUBSETS = [("a",), ("b",), ("a", "b")]
WIDTH = 3  # of the condition


def affine(layers, matrix, offset=()):
    """Make two layers with Swish compute `x @ matrix` exactly, and the constants `offset` behind it.

    `swish(u) - swish(-u) = u`.
    """
    out, more = matrix.shape[1], len(offset)
    layers.first.kernel[...] = jnp.asarray(np.hstack([matrix, -matrix]), jnp.float32)
    second = np.vstack([np.eye(out, out + more), -np.eye(out, out + more)])
    layers.second.kernel[...] = jnp.asarray(second, jnp.float32)
    layers.second.bias[...] = jnp.asarray([0.0] * out + list(offset), jnp.float32)


def log_var(variance):
    """The output of the last layer at which an encoder or the prior has this variance."""
    return 8 * np.arctanh(np.log(variance) / 8)


class Linear:
    """`z ~ N(B c, D)`, `x_m = A_m z + G_m c + noise`, and the model whose experts, prior and decoders are exact.

    `A_m` is a multiple of an orthogonal matrix, so that the posterior has independent components.
    """

    def __init__(self):
        rng = np.random.default_rng(4)
        self.prior, self.variance = rng.normal(size=(2, WIDTH)), np.array([0.5, 2.0])
        scales, self.noise = {"a": 0.8, "b": 1.7}, {"a": 0.5, "b": 0.9}
        self.loadings = {m: scale * np.linalg.qr(rng.normal(size=(2, 2)))[0] for m, scale in scales.items()}
        self.shifts = {m: rng.normal(size=(2, WIDTH)) for m in scales}
        modalities = tuple(mvae.Modality(m, "vector", (2,), 1 / self.noise[m] ** 2) for m in scales)
        options = {"condition": WIDTH, "encode_condition": True, "prior": "conditional"}
        config = mvae.Config(modalities, latent=2, hidden=4, **options)
        model = nnx.merge(*mvae.init(jax.random.key(0), config))
        affine(model.prior, self.prior.T, log_var(self.variance))
        for m, a in self.loadings.items():
            inverse = np.linalg.inv(a)
            precise = [log_var(self.noise[m] ** 2 / scales[m] ** 2)] * 2
            affine(model.encoders[m], np.vstack([inverse.T, -(inverse @ self.shifts[m]).T]), precise)
            affine(model.decoders[m], np.vstack([a.T, self.shifts[m].T]))
        self.graphdef, self.params, self.stats = nnx.split(model, nnx.Param, nnx.BatchStat)
        self.state = nnx.merge_state(self.params, self.stats)

    def draw(self, count):
        rng = np.random.default_rng(5)
        c = rng.normal(size=(count, WIDTH))
        z = c @ self.prior.T + np.sqrt(self.variance) * rng.normal(size=(count, 2))
        x = {m: z @ a.T + c @ self.shifts[m].T for m, a in self.loadings.items()}
        return c, {m: mean + self.noise[m] * rng.normal(size=(count, 2)) for m, mean in x.items()}

    def evidence(self, names, x, c):
        """`log p(x of these modalities | c)` and the mean and covariance of `z`, by dense linear algebra."""
        a, g = (np.vstack([parts[m] for m in names]) for parts in (self.loadings, self.shifts))
        noise = np.diag(np.repeat([self.noise[m] ** 2 for m in names], 2))
        covariance = a @ np.diag(self.variance) @ a.T + noise
        rest = np.hstack([x[m] for m in names]) - c @ (a @ self.prior + g).T
        gain = np.diag(self.variance) @ a.T @ np.linalg.inv(covariance)
        squares = np.einsum("ni,ij,nj->n", rest, np.linalg.inv(covariance), rest)
        evidence = -0.5 * (squares + np.linalg.slogdet(2 * np.pi * covariance)[1])
        return evidence, c @ self.prior.T + rest @ gain.T, np.diag(self.variance) - gain @ a @ np.diag(self.variance)


LINEAR = Linear()
NUMBERS = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), LINEAR.draw(5))


@pytest.mark.parametrize("names", SUBSETS)
def test_with_a_conditional_prior_posterior_and_evidence_are_exact(names):
    c, x = LINEAR.draw(5)
    evidence, mean, covariance = LINEAR.evidence(names, x, c)
    condition, numbers = NUMBERS
    given = {m: numbers[m] for m in names}
    posterior = mvae.infer(LINEAR.graphdef, LINEAR.state, given, condition=condition)
    np.testing.assert_allclose(posterior.mean, mean, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(np.exp(posterior.log_var), np.tile(np.diag(covariance), (5, 1)), rtol=1e-4)
    prior = mvae.prior(LINEAR.graphdef, LINEAR.state, 5, condition=condition)
    np.testing.assert_allclose(prior.mean, c @ LINEAR.prior.T, rtol=1e-4, atol=1e-4)
    run = functools.partial(mvae.log_evidence, LINEAR.graphdef, LINEAR.state, condition=condition)
    # From the exact posterior, one sample suffices. From that of one modality, the estimate converges.
    np.testing.assert_allclose(run(jax.random.key(0), given, given, num=1), evidence, atol=1e-3)
    other = run(jax.random.key(1), {"a": numbers["a"]}, given, num=20_000, chunk=7_000)
    np.testing.assert_allclose(other, evidence, atol=0.1)


@pytest.mark.parametrize(("asked", "asked_of"), [("own", lambda names: names), ("all", lambda names: ("a", "b"))])
def test_the_loss_is_the_sum_of_the_exact_conditional_evidence_of_all_subsets(asked, asked_of):
    """Up to the constants of the Gaussian likelihoods. `all` has the terms of the other modalities in closed form."""
    c, x = (jax.tree.map(lambda a: np.repeat(a[:1], 40_000, axis=0), part) for part in LINEAR.draw(1))
    condition, numbers = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), (c, x))
    key, parts = jax.random.key(3), (LINEAR.graphdef, LINEAR.params, LINEAR.stats)
    total, (_, terms) = jax.jit(
        lambda condition, numbers: mvae.loss(*parts, key, numbers, numbers, condition=condition, asked=asked)
    )(condition, numbers)
    expected = divergence = 0.0
    for names in SUBSETS:
        evidence, mean, covariance = (part[0] if len(part) == 40_000 else part for part in LINEAR.evidence(names, x, c))
        apart, ratio = mean - c[0] @ LINEAR.prior.T, np.diag(covariance) / LINEAR.variance
        divergence += 0.5 * np.sum(apart**2 / LINEAR.variance + ratio - 1 - np.log(ratio)) / 3
        expected -= evidence + sum(math.log(2 * math.pi * LINEAR.noise[m] ** 2) for m in names)
        for m in set(asked_of(names)) - set(names):
            rest = x[m][0] - LINEAR.loadings[m] @ mean - LINEAR.shifts[m] @ c[0]
            spread = np.trace(LINEAR.loadings[m] @ covariance @ LINEAR.loadings[m].T)
            expected += 0.5 * (rest @ rest + spread) / LINEAR.noise[m] ** 2
    np.testing.assert_allclose(total, expected, atol=0.05)
    np.testing.assert_allclose(terms.kl, divergence, rtol=1e-4)


@pytest.mark.slow
def test_evidence_of_image_category_and_vector_equals_an_integral_on_a_grid():
    modalities = (
        mvae.Modality("image", "image", (32, 32, 1)),
        mvae.Modality("label", "category", (4,), 5.0),
        mvae.Modality("place", "vector", (3,), 1.5),
    )
    config = mvae.Config(modalities, latent=2, hidden=8, widths=(2, 2, 2, 2), condition=1, prior="conditional")
    model = nnx.merge(*mvae.init(jax.random.key(2), config))
    for name, factor in (("image", 3.0), ("label", 6.0), ("place", 2.0)):  # so that the latent matters
        model.decoders[name].first.kernel[...] *= factor
    model.prior.second.bias[...] = jnp.array([0.5, -1.0, -1.0, 0.3])  # a prior away from N(0, I)
    graphdef, state = nnx.split(model)
    rng = np.random.default_rng(0)
    targets = {
        "image": jnp.asarray(rng.random((2, 32, 32, 1)) < 0.5, jnp.float32),
        "label": jax.nn.one_hot(jnp.array([0, 3]), 4),
        "place": jnp.asarray(rng.normal(size=(2, 3)), jnp.float32),
    }
    condition = jnp.asarray(rng.normal(size=(2, 1)), jnp.float32)

    side = np.linspace(-7, 7, 141)
    z = np.stack(np.meshgrid(side, side, indexing="ij"), -1).reshape(-1, 1, 2)
    grid, wide = jnp.asarray(np.repeat(z, 2, 1), jnp.float32), jnp.broadcast_to(condition, (len(z), 2, 1))
    out = mvae.decode(graphdef, state, grid, condition=wide)
    out, target = jax.tree.map(lambda x: np.asarray(x, float), (out, targets))
    prior = mvae.prior(graphdef, state, 2, condition=condition)
    mean, log_var = (np.asarray(x, float) for x in prior)
    density = -0.5 * np.sum((z - mean) ** 2 / np.exp(log_var) + log_var + np.log(2 * np.pi), -1)  # (point, item)
    likelihoods = {
        "image": -np.log1p(np.exp((1 - 2 * target["image"]) * out["image"])).sum((2, 3, 4)),
        "label": np.sum(out["label"] * target["label"], -1) - np.log(np.exp(out["label"]).sum(-1)),
        # variance size / (2 weight) = 1
        "place": -0.5 * np.sum((out["place"] - target["place"]) ** 2, -1) - 1.5 * np.log(2 * np.pi),
    }
    for names in (("image",), ("label",), ("place",), ("image", "label", "place")):
        truth = special.logsumexp(density + sum(likelihoods[m] for m in names), axis=0)
        # The masked input leaves the prior as the proposal.
        estimate = mvae.log_evidence(
            *(graphdef, state, jax.random.key(1), {"label": targets["label"]}, {m: targets[m] for m in names}),
            present={"label": jnp.zeros(2, bool)},
            condition=condition,
            num=4000,
            chunk=1000,
        )
        np.testing.assert_allclose(estimate, truth + 2 * np.log(side[1] - side[0]), atol=0.1, err_msg=str(names))


def test_a_condition_that_the_model_does_not_encode_keeps_the_posterior():
    config = mvae.Config((mvae.Modality("a", "vector", (2,)),), latent=2, hidden=4, condition=WIDTH)
    graphdef, params, stats = mvae.init(jax.random.key(0), config)
    state, given = nnx.merge_state(params, stats), {"a": jnp.ones((5, 2))}
    plain = mvae.infer(graphdef, state, given)
    for x, y in zip(plain, mvae.infer(graphdef, state, given, condition=jnp.ones((5, WIDTH))), strict=True):
        np.testing.assert_array_equal(x, y)
    assert not np.any(mvae.prior(graphdef, state, 5, condition=jnp.ones((5, WIDTH))))


GIVEN = {"a": NUMBERS[1]["a"]}


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda *model: mvae.infer(*model, GIVEN), "condition has width 0, but the model needs width 3"),
        (lambda *model: mvae.prior(*model, 5, condition=jnp.ones((5, 2))), "condition has width 2"),
        (lambda *model: mvae.predict(*model, GIVEN, condition=jnp.ones((5, 4))), "condition has width 4"),
        (lambda *model: mvae.log_evidence(*model, jax.random.key(0), GIVEN, {}, num=2), r"targets \[\]"),
        (lambda *model: mvae.log_evidence(*model, jax.random.key(0), GIVEN, GIVEN, num=0), "num=0"),
        (lambda *model: mvae.log_evidence(*model, jax.random.key(0), GIVEN, GIVEN), "condition has width 0"),
        (lambda *model: mvae.Config((mvae.Modality("a", "vector", (2,)),), prior="conditional"), "condition=0"),
        (lambda *model: mvae.Modality("label", "category", (2, 2)), "'category' of shape"),
    ],
)
def test_a_bad_argument_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call(LINEAR.graphdef, LINEAR.state)


# A stable linear system, x' = F x + G c + noise. For c = 0, N(0, I) is its stationary distribution.
F = 0.99 * np.array([[math.cos(0.4), -math.sin(0.4)], [math.sin(0.4), math.cos(0.4)]])
G = np.array([[0.3], [-0.2]])
Q = 1 - 0.99**2  # variance of the noise in each component


def advance(rng, x, c, steps):
    for _ in range(steps):
        x = x @ F.T + c @ G.T + math.sqrt(Q) * rng.normal(size=x.shape)
    return x


def moments(steps):
    """`x after so many steps ~ N(f x + g c, v I)`."""
    powers = [np.linalg.matrix_power(F, i) for i in range(steps + 1)]
    return powers[-1], sum(powers[:-1]) @ G, Q * sum(0.99 ** (2 * i) for i in range(steps))


@functools.cache
def trained(steps, *, shuffled=False):
    """A small model of x after `steps` steps, trained on pairs. Its variance of the output is half of the true one.

    The prediction of a sample then has the true variance: the other half comes from the latent.
    """
    rng = np.random.default_rng(0)
    c, x = rng.normal(size=(8192, 1)), rng.normal(size=(8192, 2))
    y = advance(rng, x, c, steps)
    if shuffled:
        y = rng.permutation(y)
    options = {"condition": 1, "encode_condition": True, "prior": "conditional"}
    modality = mvae.Modality("x", "vector", (2,), weight=2 / moments(steps)[2])
    config = mvae.Config((modality,), latent=2, hidden=32, **options)
    graphdef, params, stats = mvae.init(jax.random.key(1), config)
    optimiser = optax.adam(optax.cosine_decay_schedule(5e-3, 3000))
    c, x, y = (jnp.asarray(part, jnp.float32) for part in (c, x, y))

    def step(carry, key):
        params, state = carry
        rows = jax.random.choice(key, len(x), (256,))
        inputs, targets = {"x": x[rows]}, {"x": y[rows]}
        gradient = jax.grad(
            lambda params: mvae.loss(graphdef, params, stats, key, inputs, targets, condition=c[rows])[0]
        )(params)
        update, state = optimiser.update(gradient, state, params)
        return (optax.apply_updates(params, update), state), None

    keys = jax.random.split(jax.random.key(2), 3000)
    (params, _), _ = jax.jit(lambda carry: jax.lax.scan(step, carry, keys))((params, optimiser.init(params)))
    return graphdef, nnx.merge_state(params, stats), moments(steps)[2] / 2


def sampled(model, key, x, c):
    """A sample of the model's prediction for each row."""
    graphdef, state, variance = model
    first, second = jax.random.split(key)
    q = mvae.infer(graphdef, state, {"x": x}, condition=c)
    z = q.mean + jnp.exp(0.5 * q.log_var) * jax.random.normal(first, q.mean.shape)
    return mvae.decode(graphdef, state, z, condition=c)["x"] + math.sqrt(variance) * jax.random.normal(second, x.shape)


STEPS = 4
FRESH = np.random.default_rng(9)
C, X = (jnp.asarray(FRESH.normal(size=(4000, width)), jnp.float32) for width in (1, 2))


def check_predictive(draws, x, c):
    """Compare samples `(k, n, 2)` of x after STEPS steps with the closed form."""
    f, g, variance = moments(STEPS)
    truth = np.asarray(x) @ f.T + np.asarray(c) @ g.T
    mean = draws.mean(0)
    assert np.mean((mean - truth) ** 2) < 0.05 * variance + variance / len(draws)
    np.testing.assert_allclose(np.var(draws, axis=0, ddof=1).mean(0), variance, rtol=0.1)
    assert abs(np.cov((draws - mean).reshape(-1, 2).T)[0, 1]) < 0.1 * variance


@pytest.mark.slow
def test_a_final_step_model_reaches_the_closed_form_predictive():
    model = trained(STEPS)
    draws = np.stack([sampled(model, jax.random.key(i), X, C) for i in range(100)])
    check_predictive(draws, X, C)


@pytest.mark.slow
def test_the_roll_out_of_a_one_step_model_reaches_the_closed_form_predictive():
    model, key = trained(1), jax.random.key(0)
    draws = jnp.tile(X, (100, 1))
    condition = jnp.tile(C, (100, 1))
    for step in range(STEPS):
        draws = sampled(model, jax.random.fold_in(key, step), draws, condition)
    check_predictive(np.asarray(draws).reshape(100, -1, 2), X, C)


@pytest.mark.slow
def test_a_model_of_shuffled_targets_has_no_skill():
    y = advance(np.random.default_rng(1), np.asarray(X), np.asarray(C), STEPS)

    def skill(model):
        graphdef, state, _ = model
        predicted = mvae.predict(graphdef, state, {"x": X}, condition=C)[0]["x"]
        return 1 - np.mean((y - predicted) ** 2) / np.mean((y - y.mean(0)) ** 2)

    assert abs(skill(trained(STEPS, shuffled=True))) < 0.03
    assert skill(trained(STEPS)) > 0.9
