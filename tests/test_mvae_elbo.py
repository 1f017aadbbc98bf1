"""The bound against a loop over subsets and samples, with equal subsets computed once and with masks."""

from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from sts_jax import mvae

CONFIG = mvae.Config(
    (
        mvae.Modality("visual", "image", (32, 32, 3)),
        mvae.Modality("tactile", "vector", (4,)),
        mvae.Modality("pose", "vector", (7,), 100.0),
    ),
    latent=5,
    hidden=12,
    widths=(4, 6, 8, 10),
)
VECTORS = mvae.Config(
    tuple(mvae.Modality(n, "vector", (size,), w) for n, size, w in (("a", 3, 1.0), ("b", 4, 10.0), ("c", 2, 0.5))),
    latent=4,
    hidden=8,
)
BATCH = 6


@pytest.fixture(autouse=True)
def _no_rank_promotion():
    with jax.numpy_rank_promotion("raise"):
        yield


def batch(config, seed=0):
    rng = np.random.default_rng(seed)
    return {m.name: jnp.asarray(rng.random((BATCH, *m.shape)), jnp.float32) for m in config.modalities}


def compiled(config, *, seed=0, **static):
    """`(inputs, targets, masks) -> (loss, gradient, new statistics, terms)`."""
    graphdef, params, stats = mvae.init(jax.random.key(seed), config)

    def run(params, stats, inputs, targets, masks):
        return jax.value_and_grad(
            lambda p: mvae.loss(graphdef, p, stats, jax.random.key(7), inputs, targets, **masks, **static),
            has_aux=True,
        )(params)

    run = jax.jit(run)

    def call(inputs, targets, **masks):
        (value, (new, terms)), grads = run(params, stats, inputs, targets, masks)
        assert jax.tree.structure((grads, new)) == jax.tree.structure((params, stats))
        return value, grads, new, terms

    return call


def gradient(config, inputs, targets, *, present=None, target_present=None, condition=None, **static):
    masks = {"present": present or {}, "target_present": target_present or {}, "condition": condition}
    return compiled(config, **static)(inputs, targets, **masks)


def close(a, b, rtol=2e-4):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, rtol=rtol, atol=rtol * max(1e-3, float(jnp.max(jnp.abs(y)))))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("config", "asked", "absent"),
    [
        (CONFIG, "all", ("tactile",)),
        (VECTORS, "own", ("b",)),
        (VECTORS, "all", ("a", "b")),
        (VECTORS, "all", ("a", "b", "c")),
    ],
)
def test_computing_equal_subsets_once_equals_plain_enumeration(config, asked, absent):
    inputs, targets = batch(config), batch(config, 1)
    masks = {name: jnp.zeros(BATCH, bool) for name in absent}
    plain = gradient(config, inputs, targets, present=masks, asked=asked)
    quick = gradient(config, inputs, targets, absent=absent, asked=asked)
    close(plain, quick)


@pytest.mark.parametrize("asked", ["all", "own"])
def test_the_loss_equals_a_loop_over_subsets_and_samples(asked):
    """Vectors only, so that samples are independent. The noise follows from the key as documented."""
    inputs, targets = batch(VECTORS), batch(VECTORS, 1)
    rng = np.random.default_rng(5)
    present = {name: jnp.asarray(rng.random(BATCH) < 0.6).at[0].set(False) for name in VECTORS.names}
    known = {name: jnp.asarray(rng.random(BATCH) < 0.6) for name in VECTORS.names}
    value, _, _, terms = gradient(
        VECTORS, inputs, targets, present=present, target_present=known, asked=asked, beta=0.3
    )
    graphdef, params, stats = mvae.init(jax.random.key(0), VECTORS)
    model = nnx.merge(graphdef, params, stats)
    key = jax.random.key(7)
    total = kl = counted = 0.0
    for size in (1, 2, 3):
        for subset in combinations(range(3), size):
            for b in range(BATCH):
                left = [i for i in subset if present[VECTORS.names[i]][b]]
                if not left and any(mask[b] for mask in present.values()):
                    continue
                counted += 1
                precision, weighted = np.ones(4), np.zeros(4)
                for i in left:
                    name = VECTORS.names[i]
                    q = model.encode(name, inputs[name][b : b + 1], None)
                    precision = precision + np.exp(-np.asarray(q.log_var[0]))
                    weighted = weighted + np.exp(-np.asarray(q.log_var[0])) * np.asarray(q.mean[0])
                mean, var = weighted / precision, 1 / precision
                divergence = 0.5 * np.sum(mean**2 + var - 1 - np.log(var))
                eps = jax.random.normal(jax.random.fold_in(key, sum(1 << i for i in left)), (BATCH, 4))[b]
                z = jnp.asarray(mean + np.sqrt(var) * eps, jnp.float32)[None]
                kl += divergence
                total += 0.3 * divergence / BATCH
                for i, m in enumerate(VECTORS.modalities):
                    if (asked == "all" or i in subset) and known[m.name][b]:
                        error = np.mean((model.decode(m.name, z, None)[0] - targets[m.name][b]) ** 2)
                        total += m.weight * error / BATCH
    np.testing.assert_allclose(value, total, rtol=1e-4)
    np.testing.assert_allclose(terms.kl, kl / counted, rtol=1e-4)


@pytest.mark.slow
def test_the_values_of_a_masked_modality_change_no_bit():
    present = {
        "visual": jnp.array([1, 1, 0, 1, 0, 1], bool),
        "tactile": jnp.array([0, 1, 0, 1, 1, 0], bool),
        "pose": jnp.array([1, 0, 0, 1, 1, 1], bool),
    }
    results = []
    run = compiled(CONFIG)
    for fill in (0.0, np.nan, np.inf, 1e9):
        data = {"inputs": batch(CONFIG), "targets": batch(CONFIG, 1)}
        for name, mask in present.items():
            for part, known in ((data["inputs"], mask), (data["targets"], ~mask)):
                x = part[name]
                part[name] = jnp.where(known.reshape(-1, *(1,) * (x.ndim - 1)), x, fill)
        option = {"present": present, "target_present": {name: ~mask for name, mask in present.items()}}
        results.append(run(data["inputs"], data["targets"], **option))
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(results[0]))
    for other in results[1:]:
        jax.tree.map(np.testing.assert_array_equal, other, results[0])


ONES = jnp.ones(BATCH, bool)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"inputs": {"sound": ONES}}, r"unknown names \['sound'\]"),
        ({"targets": {}}, r"needs exactly these targets, got targets \[\]"),
        ({"condition": jnp.ones((BATCH, 2))}, "width 2"),
    ],
)
def test_bad_arguments_of_the_loss_are_named(change, message):
    given = {"inputs": batch(VECTORS), "targets": batch(VECTORS)} | change
    with pytest.raises(ValueError, match=message):
        gradient(VECTORS, given.pop("inputs"), given.pop("targets"), **given)


def test_a_posterior_needs_inputs():
    graphdef, params, stats = mvae.init(jax.random.key(0), VECTORS)
    with pytest.raises(ValueError, match="give at least one input, and use only"):
        mvae.infer(graphdef, nnx.merge_state(params, stats), {})
