"""The state-space model: densities against SciPy, symmetries, masks, and the targets of each part of the loss."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from scipy import special, stats
from statespace_config import (
    STATE,
    finite,
    random_codes,
    random_densities,
    random_states,
    same,
    trajectories,
    turned_states,
    unit,
)

from sts_jax import optics, statespace, storage
from sts_jax.evaluation import metrics
from sts_jax.mvae import Gaussian
from sts_jax.statespace import config, harmonics, networks, objective, poses, state

CONFIG = dataclasses.replace(STATE, drawn=0.5, drawn_first=0.5)
NUMBER, QUARTER = 4, jnp.array([0.0, 1.0])  # samples of a batch, and a rotation by 90 degrees
split = jax.jit(state.split)


@pytest.fixture(scope="module")
def batch():
    given = jax.tree.map(jnp.asarray, trajectories(NUMBER))
    return given | {"present": {name: jnp.ones(NUMBER, bool) for name in statespace.INPUTS}}


@pytest.fixture(scope="module")
def empty(batch):
    return batch["empty"]


@pytest.fixture(scope="module")
def complete(batch):
    """The batch with additional first moments without an end and trajectories without images."""
    rng = np.random.default_rng(1)
    falls = {"state": random_states(rng, 5), "pose": random_codes(rng, 5), "outcome": jnp.array([2, 1, 0, 1, 2])}
    falls["condition"] = jnp.asarray(rng.normal(size=(5, 3)), jnp.float32)
    views = {"visual": batch["inputs"]["visual"][:3, ::-1], "state": random_states(rng, 3)}
    return batch | {"views": views, "falls": falls}


@pytest.fixture(scope="module")
def model():
    return statespace.init(jax.random.key(0), CONFIG)[:2]


@pytest.fixture(scope="module")
def loss(model):
    """The loss, its parts and its gradient. It is compiled once with and once without views and falls."""

    @jax.jit
    @functools.partial(jax.value_and_grad, has_aux=True)
    def run(params, batch):
        return statespace.loss(model[0], params, jax.random.key(0), **batch)

    return lambda batch, params=model[1]: run(params, batch)


@pytest.fixture(scope="module")
def sample(model):
    """Samples for the first moments of a batch, compiled once. Targets are no argument."""
    run = jax.jit(functools.partial(statespace.sample, model[0], model[1], jax.random.key(1), num=6, drawn=2))
    return lambda batch: run(*(batch[name] for name in ("inputs", "present", "empty", "condition")))


def replaced(batch, part, **values):
    return batch | {part: batch[part] | values}


def changed(params, path, change):
    """Parameters with a changed kernel at a path."""
    module = nnx.to_pure_dict(params)
    at = functools.reduce(lambda node, name: node[name], path, module)
    at["kernel"] = change(at["kernel"])
    new = jax.tree.map(lambda x: x, params)
    nnx.replace_by_pure_dict(new, module)
    return new


def test_excess_equals_the_metric_and_is_zero_at_the_target():
    rng = np.random.default_rng(0)
    image, target = (rng.uniform(0.01, 0.99, (2, 8, 8, 3)).astype(np.float32) for _ in range(2))
    target[0, :4] = 1  # saturated, with an entropy of 0
    upper = np.arange(8)[None, :, None] < np.full((2, 1, 8), 4)
    for weights, rows in ((None, 8), (jnp.asarray(upper, jnp.float32), 4)):
        found = objective.excess(jnp.asarray(image), jnp.asarray(target), weights)
        np.testing.assert_allclose(found, metrics.image_error(image[:, :rows], target[:, :rows]).excess, rtol=1e-4)
    np.testing.assert_allclose(objective.excess(jnp.asarray(image), jnp.asarray(image)), 0, atol=1e-4)


def test_log_density_is_that_of_a_mixture_in_the_turned_frame():
    rng = np.random.default_rng(0)
    angle = rng.uniform(-3, 3, 2)
    final = random_densities(rng, 2, 2, angle)
    code, outcome = random_codes(rng, 2), jnp.array([2, 0])
    since = poses.matrix(random_codes(rng, 2))
    chance, density = jax.jit(objective.log_density)(final, code, since, outcome)
    for i, j in enumerate([2, 0]):
        turn = np.eye(3)
        turn[:2, :2] = [[np.cos(angle[i]), np.sin(angle[i])], [-np.sin(angle[i]), np.cos(angle[i])]]
        position, matrix = np.asarray(code[i, :3]), np.asarray(code[i, 3:]).reshape(3, 3)
        level = turn @ np.asarray(since[i]) @ turn.T
        own = np.concatenate([turn @ position, (turn @ matrix).ravel(), level.ravel()])
        parts = [
            float(final.weight[i, j, k])
            + stats.multivariate_normal(final.mean[i, j, k], np.diag(np.exp(final.log_var[i, j, k]))).logpdf(own)
            for k in range(2)
        ]
        np.testing.assert_allclose(density[i], special.logsumexp(parts), rtol=1e-4)
        np.testing.assert_allclose(chance[i], final.outcome[i, j])


def test_expert_turns_with_the_image(model, empty):
    """A rotation by 90 degrees maps pixels to pixels. The weights of the absolute angle are zero here."""
    params = changed(model[1], ("encoders", "visual", "place"), lambda kernel: kernel.at[5:].set(0))
    place = (np.arange(32) - 15.5) / 32
    x, y = np.meshgrid(place - 0.1, place + 0.05)
    along, across = np.cos(-1.0) * x + np.sin(-1.0) * y, np.cos(-1.0) * y - np.sin(-1.0) * x
    inside = (np.abs(along) < 0.3) & (np.abs(across) < 0.12)
    change = inside[..., None] * np.random.default_rng(0).uniform(0.1, 0.5, (32, 32, 3))
    both = jnp.asarray(np.stack([change, np.rot90(change, -1)]), jnp.float32)  # from columns to rows, downwards
    expert = jax.jit(lambda params, x: nnx.merge(model[0], params).encoders["visual"](x))(params, both)
    count = state.CODE + CONFIG.traits + CONFIG.own * harmonics.number(CONFIG.degree)
    for values, turn_state, turn_shown in (
        (expert.mean, state.turn, harmonics.turn),
        (jnp.exp(expert.log_var), state.turn_variance, harmonics.turn_variance),
    ):
        known, still, shown = np.split(values, [state.CODE, count], axis=1)
        expected = jax.jit(turn_state)(QUARTER[None], split(known[:1]))
        for found, part in zip(split(known[1:]), expected, strict=True):
            np.testing.assert_allclose(found, part, rtol=1e-3, atol=1e-4)
        np.testing.assert_allclose(still[1], still[0], rtol=1e-3, atol=1e-4)
        np.testing.assert_allclose(
            shown[1], jax.jit(turn_shown)(QUARTER[None], shown[:1, None])[0, 0], rtol=1e-3, atol=1e-4
        )
    pose, _, _, _, shown, low = split(np.asarray(expert.mean)[:, : state.CODE])
    assert min(np.abs(np.diff(x, axis=0)).max() for x in (pose, shown, low)) > 0.01


def test_final_pose_turns_with_state_and_condition(model):
    """Exact if the variances are isotropic and the weights of absolute heading, place and condition are zero."""
    start = 2 * poses.CODE + 7 + 5 + 2 * CONFIG.support
    absolute = slice(start, start + 4 + 2)
    params = changed(model[1], ("transition", "first"), lambda kernel: kernel.at[absolute].set(0))
    rng = np.random.default_rng(0)
    begin, end, outcome = random_states(rng, 3), random_codes(rng, 3), jnp.array([0, 1, 2])
    condition = jnp.asarray(rng.normal(size=(3, 3)), jnp.float32)
    angle = unit([0.4, 2.0, -1.3])

    @jax.jit
    def density(begin, end, condition):
        final = nnx.merge(model[0], params).transition(Gaussian(begin, jnp.full_like(begin, -3.0)), condition)
        since = poses.matrix(end) @ poses.matrix(begin[:, :12]).swapaxes(1, 2)
        return objective.log_density(final, end, since, outcome)

    before = density(begin, end, condition)
    moved = np.concatenate([jax.jit(poses.turn)(angle, condition[:, :2]), condition[:, 2:]], axis=1)
    turned = turned_states(angle, begin)
    after = density(turned, jax.jit(poses.turn_code)(angle, end), moved)
    for a, b in zip(before, after, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4)
    alone = density(turned, end, condition)
    assert np.abs(alone[1] - before[1]).min() > 1


def test_decoder_draws_an_object_at_its_projection(model):
    """One object, displaced and turned. The weights of the absolute place and heading are zero here."""
    params = changed(model[1], ("decoder", "first"), lambda kernel: kernel.at[jnp.r_[0:2, 12:16]].set(0))
    params = changed(params, ("decoder", "last"), lambda kernel: 30 * kernel)
    code = random_codes(np.random.default_rng(0), 1)[0].at[:3].set(jnp.array([0, 0, 1.5]))
    # All three come from one present moment.
    since = poses.matrix(random_codes(np.random.default_rng(1), 1))[0]
    turns = jnp.stack([since, since, poses.about_vertical(QUARTER) @ since])
    known = jnp.tile(random_states(np.random.default_rng(2), 1), (3, 1))
    lowest = 1.5 * CONFIG.position_scale - float(jax.jit(state.reach)(split(known[:1]), since[None])[0])
    assert lowest > 0.01
    step = CONFIG.view / 16 * (CONFIG.camera_distance + lowest) / CONFIG.camera_distance
    there = code.at[:2].set(jnp.array([3 * step, -2 * step]) / CONFIG.position_scale)
    camera = optics.Camera()
    places = np.stack([code, there])[:, :3] * CONFIG.position_scale
    places[:, 2] = lowest
    pixels, _ = optics.to_pixels(camera, optics.full_window(camera, (16, 16)), (16, 16), jnp.asarray(places))
    np.testing.assert_allclose(pixels[1] - pixels[0], [3, -2], atol=1e-4)
    grey = {name: jnp.full((16, 16, 3), 0.4) for name in statespace.IMAGES}
    batch = jnp.stack([code, there, jax.jit(poses.turn_code)(QUARTER, code)])
    look = jnp.ones((3, CONFIG.look))

    @jax.jit
    def draw(code):
        return networks.compose(nnx.merge(model[0], params).decoder(code, turns, known, look), grey)

    drawn = draw(batch)
    for picture in drawn.values():
        here, moved, turned = np.asarray(picture)
        assert np.std(here[4:12, 4:12]) > 1e-3
        np.testing.assert_allclose(moved[:-2, 3:], here[2:, :-3], atol=1e-4)
        np.testing.assert_allclose(turned, np.rot90(here, -1), atol=1e-4)


def test_share_of_levels_that_cover_a_pixel_is_its_probability():
    chance = np.linspace(0.02, 0.98, 25).reshape(1, 5, 5, 1)
    logit = jnp.tile(jnp.asarray(np.log(chance / (1 - chance)), jnp.float32), (200, 1, 1, 1))
    drawn = networks.Layers(logit, jnp.ones((200, 5, 5, 3)), jnp.zeros((200, 5, 5, 3)))
    empty = {"visual": jnp.zeros((5, 5, 3)), "tactile": jnp.full((5, 5, 3), 0.4)}
    compose = jax.jit(networks.compose)
    soft, sharp = (compose(drawn, empty, level) for level in (None, (jnp.arange(200) + 0.5) / 200))
    np.testing.assert_allclose(soft["visual"][0], np.broadcast_to(chance[0], (5, 5, 3)), atol=1e-5)
    np.testing.assert_allclose(np.mean(sharp["visual"], axis=0), soft["visual"][0], atol=0.02)
    assert np.mean((sharp["visual"] < 0.05) | (sharp["visual"] > 0.95)) > 0.7
    for images in (soft, sharp):
        np.testing.assert_allclose(images["tactile"], 0.4, rtol=1e-5)
    lit = drawn._replace(touch=jnp.full((200, 5, 5, 3), 40.0), pressed=logit)  # an imprint is white
    soft_touch, sharp_touch = (compose(lit, empty, level)["tactile"] for level in (None, (jnp.arange(200) + 0.5) / 200))
    np.testing.assert_allclose(soft_touch, 0.4 + 0.6 * soft["visual"], atol=1e-5)
    np.testing.assert_allclose(sharp_touch, 0.4 + 0.6 * sharp["visual"], atol=1e-5)
    level, contrast = jnp.full(200, 0.3), jnp.linspace(1, 9, 200)
    softer = compose(drawn, empty, level, contrast)["visual"]
    odds = (chance / (1 - chance) / (0.3 / 0.7))[0, None] ** np.asarray(contrast)[:, None, None, None]
    np.testing.assert_allclose(softer, np.broadcast_to(odds / (1 + odds), softer.shape), rtol=1e-3, atol=1e-6)


def test_belief_from_the_true_state_is_the_true_state(model, empty, batch):
    inputs = {"visual": batch["inputs"]["visual"], "state": batch["targets"]["state"]}
    counts = {name: jnp.ones(NUMBER, bool) for name in inputs}

    @jax.jit
    def believe(inputs, counts):
        return networks.fuse(networks.experts(nnx.merge(*model), inputs, counts, empty), counts)

    belief, alone = believe(inputs, counts), believe(inputs, counts | {"state": jnp.zeros(NUMBER, bool)})
    np.testing.assert_allclose(belief.mean[:, : state.CODE], inputs["state"], atol=2e-3)
    np.testing.assert_allclose(belief.mean[:, state.CODE :], alone.mean[:, state.CODE :], atol=1e-5)


def test_tint_is_the_mean_colour_of_the_object_in_the_visual_image(model, empty, batch):
    given = batch["inputs"]
    found = jax.jit(lambda inputs: networks.experts(nnx.merge(*model), inputs, batch["present"], empty))(given)
    rows = slice(state.CODE, state.CODE + config.TINT)
    for i, image in enumerate(np.asarray(given["visual"], np.float64)):
        change = image - np.asarray(empty["visual"])
        pixels = [pixel for line in change for pixel in line if max(abs(pixel)) > 12 / 255]
        np.testing.assert_allclose(found["visual"].mean[i, rows], (np.mean(pixels, axis=0) + 0.3) / 0.12, atol=1e-3)
    assert np.all(found["visual"].log_var[:, rows] < -5)
    np.testing.assert_array_equal(found["tactile"].mean[:, rows], 0)  # a tactile image shows no colours
    for name in ("tactile", "pose"):
        np.testing.assert_array_equal(found[name].log_var[:, rows], networks.UNKNOWN_LOG_VAR)


def test_belief_from_several_inputs_is_the_product_of_their_beliefs(sample, batch):
    def belief(*names):
        given = {name: x & (name in names) for name, x in batch["present"].items()}
        return sample(batch | {"present": given}).belief

    parts = [Gaussian(*(np.asarray(x, np.float64) for x in belief(name))) for name in statespace.INPUTS]
    precision = 1 + sum(np.exp(-part.log_var) - 1 for part in parts)
    mean = sum(part.mean * np.exp(-part.log_var) for part in parts) / precision
    fused = belief(*statespace.INPUTS)
    np.testing.assert_allclose(fused.log_var, -np.log(precision), atol=1e-3)
    np.testing.assert_allclose(fused.mean, mean, atol=1e-3)
    np.testing.assert_allclose(parts[2].mean[:, :12], batch["inputs"]["pose"], atol=1e-3)  # the pose is known,
    np.testing.assert_allclose(parts[2].log_var[:, 12:], 0, atol=1e-6)  # and shape and look are unknown
    same(belief(), jax.tree.map(jnp.zeros_like, fused))


@pytest.mark.slow
def test_items_that_do_not_count_may_be_nan(sample, loss, batch):
    names = list(enumerate(statespace.INPUTS))
    present = {name: batch["present"][name].at[i].set(False) for i, name in names}
    broken = {name: batch["inputs"][name].at[i].set(jnp.nan) for i, name in names}
    masked = batch | {"present": present}
    same(sample(masked | {"inputs": broken}), sample(masked))
    same(loss(masked | {"inputs": broken}), loss(masked))
    finite(loss(masked))


def concerned(loss, batch, part, name):
    """The parts of the loss that change with some values of a batch."""
    values = batch[part][name]
    new = (values + 1) % 3 if name == "outcome" else values[::-1]
    before, after = (loss(x)[0][1] for x in (batch, replaced(batch, part, **{name: new})))
    return {term for term in before if before[term] != after[term]}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "terms"),
    [
        ("visual", {"visual", "covered"}),
        ("tactile", {"tactile"}),
        ("state", {"state", "doubt", "first", "covered", "pose", "visual", "tactile"}),  # also the final rotation
        ("pose", {"pose", "visual", "tactile", "covered"}),
        ("outcome", {"outcome", "pose"}),
    ],
)
def test_target_changes_only_its_parts_of_the_loss(loss, batch, name, terms):
    """In particular, the end has no influence on the parts of the first moment and on the divergence of the look."""
    assert concerned(loss, batch, "targets", name) == terms


@pytest.mark.slow
def test_views_and_falls_change_only_their_parts_of_the_loss(loss, batch, complete):
    before, without = (loss(x)[0][1] for x in (complete, batch))
    for part in before:  # two compiled programs round differently
        alike = np.isclose(before[part], without[part], rtol=1e-5)
        assert alike == (part not in {"state", "doubt", "first", "covered", "outcome", "pose"}), part
    for name in ("visual", "state"):
        assert concerned(loss, complete, "views", name) == {"state", "doubt", "first", "covered"}
    assert concerned(loss, complete, "falls", "pose") == {"pose"}
    for name in ("state", "outcome", "condition"):
        assert concerned(loss, complete, "falls", name) == {"outcome", "pose"}


@pytest.mark.slow
def test_views_have_the_weight_of_other_first_moments(loss, complete):
    """Each of three views and of the pictures that count has the same share of the squared error."""

    def squared(*counts):
        masks = {"visual": jnp.array(counts, bool), "tactile": jnp.zeros(NUMBER, bool)}
        return (3 + sum(counts)) * loss(replaced(complete, "present", **masks))[0][1]["state"]

    views = squared(0, 0, 0, 0)
    each = [squared(*row) - views for row in np.eye(4, dtype=int).tolist()]
    np.testing.assert_allclose(squared(1, 1, 1, 1), views + sum(each), rtol=1e-4)
    assert min(each) > 0


@pytest.mark.slow
@pytest.mark.parametrize("shown", ["object", "nothing"])
def test_gradient_is_finite_for_an_unknown_rotation(loss, complete, model, empty, shown):
    """No pose counts, and the states of the encoders are zero, so that headings come from vectors of length 0."""
    params = model[1]
    for name in statespace.IMAGES:
        params = changed(params, ("encoders", name, "last"), jnp.zeros_like)
    given = replaced(complete, "present", pose=jnp.zeros(NUMBER, bool))
    if shown == "nothing":
        given = replaced(given, "inputs", **{name: jnp.tile(x, (NUMBER, 1, 1, 1)) for name, x in empty.items()})
    value, gradient = loss(given, params)
    finite((value, gradient))
    assert np.abs(nnx.to_pure_dict(gradient)["encoders"]["visual"]["last"]["kernel"]).max() > 0


def test_beliefs_of_falls_are_exact_or_have_noise_of_their_variance():
    number = 400
    code = jnp.tile(random_states(np.random.default_rng(0), 8), (number // 8, 1))
    falls = {"state": code, "pose": code[:, :12], "outcome": jnp.zeros(number, jnp.int32)}
    ends = jax.jit(objective._known_ends)(jax.random.key(0), falls)
    mean, variance = (np.asarray(x, np.float64) for x in (ends.belief.mean, jnp.exp(ends.belief.log_var)))
    np.testing.assert_allclose(mean[:, :12], code[:, :12], atol=1e-3)
    np.testing.assert_allclose(mean[::2], code[::2], atol=1e-3)
    # Without the prior, the belief is a Gaussian of this mean and variance.
    mean, variance = mean[1::2, 12:], variance[1::2, 12:]
    noise = variance / (1 - variance)
    error = (mean * noise / variance - code[1::2, 12:]) / np.sqrt(noise)
    np.testing.assert_allclose(error.mean(), 0, atol=0.03)
    np.testing.assert_allclose(error.std(), 1, atol=0.03)
    assert np.sqrt(noise).min() > 0.019
    assert np.sqrt(noise).max() < 1.01


def test_half_of_the_trajectories_are_reflected_with_their_turns_and_jerks(batch):
    number = len(batch["targets"]["state"])
    code, pose = jnp.asarray(batch["targets"]["state"]), jnp.asarray(batch["targets"]["pose"])
    belief = Gaussian(code + 1, jnp.zeros_like(code))
    before = objective._Ends(belief, code, pose, jnp.arange(number), jnp.asarray(batch["condition"]), jnp.ones(number))
    after = jax.jit(objective._reflected, static_argnums=1)(jax.random.key(0), STATE, before)
    chosen = np.asarray(after.pose[:, 0] != before.pose[:, 0])
    assert 0 < chosen.sum() < number
    turns = [objective.rotation_between(x.state, x.pose) for x in (before, after)]
    sides = np.array([-1.0, 1, 1])
    expected = np.where(chosen[:, None, None], sides[:, None] * turns[0] * sides, turns[0])
    np.testing.assert_allclose(turns[1], expected, atol=1e-5)
    jerks = np.where(chosen[:, None], batch["condition"] * sides, batch["condition"])
    np.testing.assert_array_equal(after.condition, jerks)
    np.testing.assert_allclose(
        after.belief.mean - after.state, np.where(chosen[:, None], state.reflection(code), 1), atol=1e-5
    )
    same((after.outcome, after.counts, after.belief.log_var), (before.outcome, before.counts, belief.log_var))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"inputs": ("pose", "visual")}, "inputs must be some of .* in this order, with an image"),
        ({"window": 12}, "window must be a positive multiple of 8 pixels, got 12"),
        ({"input_size": 24}, "input_size must be a positive multiple of 16 pixels, the image_size, got 24"),
        ({"shading": 4}, "shading must be 0, or >= 1 with imprints=True and an even image_size, got shading=4"),
        (
            {"imprints": True, "outlines": 4},
            "outlines must be 0, or >= 1 with shading >= 1, got outlines=4 and shading=0",
        ),
        ({"condition": 1}, r"condition must be >= 2 \* vectors >= 0, got condition=1 and vectors=1"),
        ({"outcome_names": ("rests",)}, "outcome_names must be empty or have 3 names"),
        ({"weights": {"touch": 1.0}}, r"field model\.weights\.touch is unknown"),
    ],
)
def test_config_rejects_values_out_of_range(change, message):
    with pytest.raises(ValueError, match=message):
        storage.decode(statespace.Config, dataclasses.asdict(CONFIG) | change, "model")
