"""The bound against a loop over subsets and samples, with equal subsets computed once and with masks."""

import functools
from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from statespace_config import finite, same

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


pytestmark = pytest.mark.usefixtures("strict_ranks")


def batch(config, seed=0):
    rng = np.random.default_rng(seed)
    return {m.name: jnp.asarray(rng.random((BATCH, *m.shape)), jnp.float32) for m in config.modalities}


def compiled(config, **static):
    """`(inputs, targets, masks by argument) -> ((loss, (new statistics, terms)), gradient)`."""
    graphdef, params, stats = mvae.init(jax.random.key(0), config)

    @jax.jit
    @functools.partial(jax.value_and_grad, has_aux=True)
    def run(params, inputs, targets, masks):
        return mvae.loss(graphdef, params, stats, jax.random.key(7), inputs, targets, **masks, **static)

    return lambda inputs, targets, **masks: run(params, inputs, targets, masks)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("config", "asked", "absent"),
    [(CONFIG, "all", ("tactile",)), (VECTORS, "own", ("b",)), (VECTORS, "all", ("a", "b", "c"))],
)
def test_computing_equal_subsets_once_equals_plain_enumeration(config, asked, absent):
    data = batch(config), batch(config, 1)
    masks = {name: jnp.zeros(BATCH, bool) for name in absent}
    plain = compiled(config, asked=asked)(*data, present=masks)
    quick = compiled(config, asked=asked, absent=absent)(*data)
    for x, y in zip(jax.tree.leaves(plain), jax.tree.leaves(quick), strict=True):
        np.testing.assert_allclose(x, y, rtol=2e-4, atol=2e-4 * max(1e-3, float(jnp.max(jnp.abs(y)))))


@pytest.mark.parametrize("asked", ["all", "own"])
def test_the_loss_equals_a_loop_over_subsets_and_samples(asked):
    """Vectors only, so that samples are independent. The noise follows from the key as documented."""
    inputs, targets = batch(VECTORS), batch(VECTORS, 1)
    rng = np.random.default_rng(5)
    present = {name: jnp.asarray(rng.random(BATCH) < 0.6).at[0].set(False) for name in VECTORS.names}
    known = {name: jnp.asarray(rng.random(BATCH) < 0.6) for name in VECTORS.names}
    run = compiled(VECTORS, asked=asked, beta=0.3)
    (value, (_, terms)), _ = run(inputs, targets, present=present, target_present=known)
    model = nnx.merge(*mvae.init(jax.random.key(0), VECTORS))
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
                    q = model.encoders[name](inputs[name][b : b + 1], None)
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
                        error = np.mean((model.decoders[m.name](z, None)[0] - targets[m.name][b]) ** 2)
                        total += m.weight * error / BATCH
    np.testing.assert_allclose(value, total, rtol=1e-4)
    np.testing.assert_allclose(terms.kl, kl / counted, rtol=1e-4)


@pytest.mark.slow
def test_the_values_of_a_masked_modality_change_no_bit():
    rows = {"visual": [1, 1, 0, 1, 0, 1], "tactile": [0, 1, 0, 1, 1, 0], "pose": [1, 0, 0, 1, 1, 1]}
    present = {name: jnp.array(row, bool) for name, row in rows.items()}
    absent = {name: ~mask for name, mask in present.items()}
    run = compiled(CONFIG)

    def filled(data, known, fill):
        masks = {name: known[name].reshape(-1, *(1,) * (x.ndim - 1)) for name, x in data.items()}
        return {name: jnp.where(masks[name], x, fill) for name, x in data.items()}

    def result(fill):
        data = filled(batch(CONFIG), present, fill), filled(batch(CONFIG, 1), absent, fill)
        return run(*data, present=present, target_present=absent)

    finite(result(0.0))
    for fill in (np.nan, np.inf, 1e9):
        same(result(fill), result(0.0))


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
    with pytest.raises(ValueError, match=message):
        compiled(VECTORS)(**({"inputs": batch(VECTORS), "targets": batch(VECTORS)} | change))
