"""Drawn imprints: the energy score against loops, edges and outlines of known images, and what the loss trains."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx
from statespace_config import STATE, trajectories

from sts_jax import statespace
from sts_jax.evaluation import metrics
from sts_jax.statespace import imprints, networks, objective

SIZE = 16  # pixels
GREY = jnp.full((SIZE, SIZE, 3), 0.5)
CONFIG = dataclasses.replace(STATE, imprints=True, shading=4, outlines=4)


@pytest.fixture(scope="module")
def batch():
    return jax.tree.map(jnp.asarray, trajectories(4))


@pytest.fixture(scope="module")
def model():
    return statespace.init(jax.random.key(0), CONFIG)[:2]


def fitted(params, loss, steps=150, rate=0.02):
    """Minimise `loss(params, key)` with Adam."""
    optimiser = optax.adam(rate)

    @jax.jit
    def step(params, moments, key):
        updates, moments = optimiser.update(jax.grad(loss)(params, key), moments)
        return optax.apply_updates(params, updates), moments

    moments = optimiser.init(params)
    for key in jax.random.split(jax.random.key(0), steps):
        params, moments = step(params, moments, key)
    return params


@pytest.mark.parametrize("size", [16, 20])
def test_the_energy_score_is_that_of_loops_over_squares(size):
    rng = np.random.default_rng(0)
    one, other, true = rng.uniform(size=(3, 2, size, size, 3))
    across, down = 5, 3

    def distance(a, b):
        squares = ((a - b) ** 2).sum(-1)
        total = np.sqrt(squares.sum() + 1e-4) - 0.01
        for side in (4, 8):
            whole = -(-size // 8) * 8  # the grid covers the image, and what leaves it on one side enters on the other
            for top in range(0, whole, side):
                for left in range(0, whole, side):
                    rows, columns = ((np.arange(side) + start) % whole for start in (top - down, left - across))
                    inside = np.ix_(rows[rows < size], columns[columns < size])
                    total += np.sqrt(squares[inside].sum() + 1e-4) - 0.01
        return total

    expected = [
        (distance(a, t) + distance(b, t) - distance(a, b)) / 2 for a, b, t in zip(one, other, true, strict=True)
    ]
    found = imprints.energy_score(*map(jnp.float32, (one, other, true)), jnp.array([down, across]))
    np.testing.assert_allclose(found, expected, rtol=1e-5)


@pytest.mark.parametrize("true", [0.2, 0.7])
def test_the_expected_energy_score_is_least_for_the_true_distribution(true):
    rng = np.random.default_rng(1)
    pair = rng.uniform(size=(2, SIZE, SIZE, 3))  # one of two images is the true one, the first with probability `true`
    chosen = jnp.asarray(pair[[0, 0, 0, 0, 1, 1, 1, 1]]), jnp.asarray(pair[[0, 0, 1, 1, 0, 0, 1, 1]])
    scores = imprints.energy_score(*chosen, jnp.asarray(pair[[0, 1] * 4]), jnp.zeros(2, int))

    def expected(chance):
        drawn, ends = (np.array([x, 1 - x]) for x in (chance, true))
        return np.einsum("i,j,k,ijk", drawn, drawn, ends, np.asarray(scores).reshape(2, 2, 2))

    chances = np.linspace(0, 1, 21)
    assert chances[np.argmin([expected(chance) for chance in chances])] == pytest.approx(true)


def test_shading_finds_the_edges_of_an_imprint_from_its_outline():
    rng = np.random.default_rng(0)
    outline = np.zeros((60, SIZE, SIZE, 1), np.float32)
    for image, (row, column, height, width) in zip(
        outline, rng.integers([2, 2, 4, 4], [7, 7, 9, 9], (60, 4)), strict=True
    ):
        image[row : row + height, column : column + width] = 1
    # the first column inside is dark, the last one is bright
    change = 2 * (np.roll(outline, 1, axis=2) - np.roll(outline, -1, axis=2)) * outline
    outline, flat = jnp.asarray(outline), jnp.zeros((60, SIZE, SIZE, 3))
    target = networks.imprinted(flat + change, outline, GREY)
    graphdef, params = nnx.split(imprints.Shading(8, 0, nnx.Rngs(0)))
    train, other = slice(40), slice(40, None)

    def error(params, some):
        shaded = flat[some] + nnx.merge(graphdef, params)(outline[some], flat[some])
        return jnp.mean(objective.excess(networks.imprinted(shaded, outline[some], GREY), target[some]))

    assert error(fitted(params, lambda params, _: error(params, train)), other) < 0.1 * error(params, other)


@pytest.mark.slow  # trains two networks
def test_a_drawn_imprint_is_one_of_the_possible_ones_and_as_sharp():
    """A dark square is on the left or on the right of a place that is known, with equal probability."""
    rng = np.random.default_rng(0)
    number = 128
    rows, columns, right = rng.integers(4, 8, number), rng.integers(4, 8, number), rng.integers(0, 2, number)
    true, known = np.full((number, SIZE, SIZE, 3), 0.5, np.float32), np.full((number, SIZE, SIZE, 1), -6.0, np.float32)
    for i, (row, column, side) in enumerate(zip(rows, columns, right, strict=True)):
        true[i, row : row + 4, column + 4 * side : column + 4 * side + 4] = 0.1
        known[i, row : row + 4, column : column + 8] = 0  # both halves are equally probable
    touch, mass = jnp.full((number, SIZE, SIZE, 3), math.log(0.1 / 0.9)), jnp.zeros((number, 1))
    parts = nnx.Dict({"outlines": imprints.Outlines(8, nnx.Rngs(0)), "shading": imprints.Shading(8, 2, nnx.Rngs(1))})
    graphdef, params = nnx.split(parts)

    def draw(params, key):
        parts = nnx.merge(graphdef, params)
        noise = jax.random.normal(key, (number, imprints.NOISE))
        pressed, features, depth = parts["outlines"](jnp.asarray(known), touch, mass, noise)
        change = depth[:, None, None, None] * (touch + parts["shading"](pressed, touch, features))
        return networks.imprinted(change, pressed, GREY)

    def loss(params, key):
        one, other, shift = jax.random.split(key, 3)
        place = jax.random.randint(shift, (2,), 0, 8)
        return jnp.mean(imprints.energy_score(draw(params, one), draw(params, other), jnp.asarray(true), place))

    drawn = np.asarray(draw(fitted(params, loss, 400, 0.01), jax.random.key(1)))
    dark = (0.5 - drawn[..., 0]).clip(0) / 0.4
    halves = np.array(
        [
            [dark[i, row : row + 4, column + 4 * side : column + 4 * side + 4].mean() for side in (0, 1)]
            for i, (row, column) in enumerate(zip(rows, columns, strict=True))
        ]
    )
    one, other = halves.max(1), halves.min(1)
    assert np.mean((one > 0.7) & (other < 0.3)) > 0.7  # one of the halves, and not the mean of both
    assert 0.25 < np.mean(halves[:, 1] > halves[:, 0]) < 0.75
    np.testing.assert_allclose(halves.sum(1).mean(), 1, atol=0.2)
    assert 0.75 < metrics.gradient_energy(drawn).mean() / metrics.gradient_energy(true).mean() < 1.25


@pytest.mark.slow  # compiles a loss of its own
@pytest.mark.parametrize(("outlines", "term"), [(0, "shaded"), (4, "imprint")])
def test_networks_that_draw_imprints_are_trained_by_one_term_that_trains_nothing_else(outlines, term, batch):
    graphdef, params, _ = statespace.init(jax.random.key(0), dataclasses.replace(CONFIG, outlines=outlines))

    @jax.jit
    def slope(params):
        return jax.grad(lambda params: statespace.loss(graphdef, params, jax.random.key(0), **batch)[1][term])(params)

    found = nnx.to_pure_dict(slope(params))
    own = [found["decoder"].pop("shading"), *([found["decoder"].pop("outlines")] if outlines else [])]
    assert all(np.any(x) for x in jax.tree.leaves(own))
    assert not any(np.any(x) for x in jax.tree.leaves(found))


def test_samples_have_imprints_of_their_own_and_the_mean_is_the_expected_imprint(model, batch):
    given = [batch[name] for name in ("inputs", "empty", "condition")]
    present = {name: jnp.ones(4, bool) for name in statespace.INPUTS}

    @jax.jit
    def samples(params, inputs, empty, condition):
        return statespace.sample(model[0], params, jax.random.key(1), inputs, present, empty, condition, num=3, drawn=3)

    deep = nnx.to_pure_dict(model[1])
    kernel = deep["decoder"]["outlines"]["depth"]["kernel"]
    deep["decoder"]["outlines"]["depth"]["kernel"] = kernel + 1  # the noise changes the depth strongly
    params = jax.tree.map(lambda x: x, model[1])
    nnx.replace_by_pure_dict(params, deep)
    plain, changed = samples(model[1], *given), samples(params, *given)
    np.testing.assert_array_equal(plain.images["visual"], changed.images["visual"])
    np.testing.assert_array_equal(plain.mean["tactile"], changed.mean["tactile"])
    assert np.all(np.any(plain.images["tactile"] != changed.images["tactile"], axis=(2, 3, 4)))
