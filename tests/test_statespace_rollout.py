"""One-step state-space models: closed forms, a loop by hand, SciPy's rotations, symmetries, and arrays of courses."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx
from scipy import special, stats
from scipy.spatial.transform import Rotation
from statespace_config import (
    STATE,
    finite,
    random_codes,
    random_states,
    same,
    trajectories,
    turned_states,
    unit,
    untrained,
)

from sts_jax import objects, statespace, storage
from sts_jax.mvae import Gaussian
from sts_jax.statespace import networks, objective, poses, state
from sts_jax.statespace.rollout import _Course, _motions, step

CONFIG = dataclasses.replace(STATE, outcomes=1, stride=1, drawn=0.5, drawn_first=0.5)
NUMBER, FRAMES = 4, 7
EVERY = dict.fromkeys(("visual", "state"), jnp.ones(NUMBER, bool))


def awake(params):
    """Make the component of resting objects unlikely, in place. The outputs of an untrained transition are small."""
    bias = params["transition"]["mixture"]["bias"]
    bias[...] = bias[...].at[-1 - 2 * poses.MOTION].set(-10)
    return params


@pytest.fixture(scope="module")
def model():
    graphdef, params, _ = statespace.init(jax.random.key(0), CONFIG)
    return graphdef, awake(params)


@pytest.fixture(scope="module")
def batch():
    """Random trajectories with courses that turn and move by random small motions."""
    given = jax.tree.map(jnp.asarray, trajectories(NUMBER))
    course = courses(np.random.default_rng(3), given["targets"]["state"][:, :12])
    given["targets"] |= {"course": course, "outcome": jnp.zeros(NUMBER, jnp.int32)}
    given["condition"] = jnp.tile(given["condition"][:, None], (1, FRAMES, 1)).at[..., 2].set(jnp.arange(FRAMES) / 10)
    return given


advanced = jax.jit(poses.advanced)


def courses(rng, first, frames=FRAMES):
    codes = [first]
    for _ in range(frames - 1):
        codes.append(advanced(codes[-1], jnp.asarray(0.2 * rng.normal(size=(len(first), 6)), jnp.float32)))
    return jnp.stack(codes, axis=1)


@pytest.fixture(scope="module")
def roll(model):
    """Courses from the visual image and the true state, compiled once for each number of steps and courses."""

    @functools.partial(jax.jit, static_argnames=("steps", "num"))
    def run(key, inputs, condition, empty, steps, num):
        return statespace.rollout(*model, key, inputs, EVERY, empty, condition, steps=steps, num=num)

    def rolled(batch, key=None, *, code=None, steps=3, num=1):
        inputs = {"visual": batch["inputs"]["visual"], "state": batch["targets"]["state"] if code is None else code}
        return run(key, inputs, batch["condition"][:, :steps], batch["empty"], steps, num)

    return rolled


def test_motions_are_differences_and_rotation_vectors():
    rng = np.random.default_rng(0)
    before, move = random_codes(rng, 20), jnp.asarray(rng.normal(size=(20, 6)), jnp.float32)
    after, motion = advanced(before, move), jax.jit(poses.motion)
    np.testing.assert_allclose(motion(before, after), move, atol=1e-5)
    turned = Rotation.from_rotvec(move[:, 3:]) * Rotation.from_matrix(poses.matrix(before))
    np.testing.assert_allclose(poses.matrix(after), turned.as_matrix(), atol=1e-5)
    angle = unit(rng.uniform(-3, 3, 20))
    scene = [poses.turn_code(angle, code) for code in (before, after)]
    np.testing.assert_allclose(motion(*scene), poses.turn_motion(angle, move), atol=1e-5)
    back = poses.turn_motion_back(angle, poses.turn_motion(angle, move))
    np.testing.assert_allclose(back, move, atol=1e-5)


def test_a_moved_state_code_is_that_of_the_moved_object():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(5, 20, 3)) * [0.02, 0.015, 0.01]
    support = np.max(points @ objects.DIRECTIONS.T.astype(np.float64), axis=1)
    solid = support, rng.uniform(0.02, 0.2, 5), 0.005 * rng.normal(size=(5, 3))
    solid = [jnp.asarray(x, jnp.float32) for x in solid]
    before, after = random_codes(rng, 5), random_codes(rng, 5)
    turn = poses.matrix(after) @ poses.matrix(before).swapaxes(1, 2)
    moved = jax.jit(state.moved)(state.split(statespace.encode(before, *solid)), after[:, :3], turn)
    np.testing.assert_allclose(state.join(moved), statespace.encode(after, *solid), atol=2e-4)


def test_variances_of_a_moved_rotation_are_those_of_a_product():
    rng = np.random.default_rng(0)
    variance = jnp.asarray(rng.uniform(0.1, 1, (1, state.CODE)), jnp.float32)
    turn = poses.matrix(random_codes(rng, 1))
    moved = jax.jit(state.moved_variance, static_argnums=1)(state.split(variance), 0.5, turn).pose[0]
    dense = np.kron(turn[0], np.eye(3)) @ np.diag(variance[0, 3:12]) @ np.kron(turn[0], np.eye(3)).T
    np.testing.assert_allclose(moved[3:], np.diag(dense), rtol=1e-5)
    np.testing.assert_array_equal(moved[:3], 0.5)


@pytest.fixture(scope="module")
def transition(model):
    """The transition of four items with given parameters, compiled once."""

    @jax.jit
    def run(params, code, condition, velocity):
        belief = Gaussian(code, jnp.full_like(code, -3.0))
        return nnx.merge(model[0], params).transition(belief, condition, velocity)

    return run


def test_density_of_a_step_is_that_of_a_mixture_about_constant_velocity(model, transition):
    rng = np.random.default_rng(0)
    code = random_states(rng, NUMBER).at[:, 2].set(3.0)
    condition = jnp.asarray(rng.normal(size=(NUMBER, 3)), jnp.float32)
    velocity, motion = (jnp.asarray(0.3 * rng.normal(size=(NUMBER, 6)), jnp.float32) for _ in range(2))
    density = transition(model[1], code, condition, velocity)
    numbers = jax.jit(poses.turn_motion_back)(density.heading, motion)
    _, found = jax.jit(objective._log_mixture)(density, numbers, jnp.zeros(NUMBER, int))
    for i in range(NUMBER):
        back = np.kron(np.eye(2), Rotation.from_euler("z", -np.arctan2(*density.heading[i][::-1])).as_matrix())
        parts = [
            float(density.weight[i, 0, k])
            + stats.multivariate_normal(density.mean[i, 0, k], np.diag(np.exp(density.log_var[i, 0, k]))).logpdf(
                back @ np.asarray(motion[i])
            )
            for k in range(CONFIG.components)
        ]
        np.testing.assert_allclose(found[i], special.logsumexp(parts), rtol=1e-3)
        ahead = back @ np.asarray(velocity[i])
        assert np.abs(density.mean[i, 0, :-1] - ahead).max() < 0.2  # it changes the velocity little
        np.testing.assert_array_equal(density.mean[i, 0, -1], 0)  # an object at rest


def test_an_object_does_not_sink_into_the_pad(model, transition):
    """Spheres 2 mm above the pad, 100 mm above, below it and beside it, all with 50 mm per step downwards."""
    radius, position = 0.01, np.array([[0, 0, 0.012], [0, 0, 0.11], [0, 0, -0.03], [0.1, 0, 0.012]])
    place = np.concatenate([position / 0.05, np.tile(np.eye(3).ravel(), (4, 1))], axis=1)
    solid = np.full((4, 128), radius), np.full(4, 0.05), np.zeros((4, 3))
    code = statespace.encode(*(jnp.asarray(x, jnp.float32) for x in (place, *solid)))
    params = jax.tree.map(lambda x: x, model[1])
    for name in ("kernel", "bias"):
        params["transition"]["mixture"][name][...] = 0 * params["transition"]["mixture"][name][...]
    velocity = jnp.zeros((4, 6)).at[:, 2].set(-1.0)
    density = transition(params, code, jnp.zeros((4, 3)), velocity)
    for mean, down in zip(density.mean[:, 0, 0], [-0.08, -1.0, -1.0, -1.0], strict=True):  # 2 mm into the pad at most
        np.testing.assert_allclose(mean, [0, 0, down, 0, 0, 0], atol=1e-3)


def test_a_step_turns_with_the_scene(model, transition):
    """Exact if the weights of absolute heading, place and condition are zero, as for the final pose."""
    start = 2 * poses.CODE + 7 + 5 + 2 * CONFIG.support
    params = jax.tree.map(lambda x: x, model[1])
    kernel = params["transition"]["first"]["kernel"]
    kernel[...] = kernel[...].at[start : start + 6].set(0)
    rng = np.random.default_rng(0)
    begin, condition = random_states(rng, NUMBER), jnp.asarray(rng.normal(size=(NUMBER, 3)), jnp.float32)
    velocity = jnp.asarray(rng.normal(size=(NUMBER, 6)), jnp.float32)
    angle = unit([0.4, 2.0, -1.3, 3.0])
    before = transition(params, begin, condition, velocity)
    moved = np.concatenate([jax.jit(poses.turn)(angle, condition[:, :2]), condition[:, 2:]], axis=1)
    turned = turned_states(angle, begin)
    after = transition(params, turned, moved, jax.jit(poses.turn_motion)(angle, velocity))
    for a, b in zip(before[:-1], after[:-1], strict=True):
        np.testing.assert_allclose(a, b, atol=2e-4)
    assert np.abs(before.mean - transition(params, turned, moved, velocity).mean).max() > 0.1


def test_a_rollout_is_the_transition_applied_by_hand(model, batch, roll):
    """Each state code is encoded anew from the pose, the shape and the mass of the object."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(NUMBER, 20, 3)) * [0.02, 0.015, 0.01]
    support = np.max(points @ objects.DIRECTIONS.T.astype(np.float64), axis=1)
    solid = support, rng.uniform(0.02, 0.2, NUMBER), 0.005 * rng.normal(size=(NUMBER, 3))
    solid = [jnp.asarray(x, jnp.float32) for x in solid]
    pose, velocity = random_codes(rng, NUMBER).at[:, 2].set(1.0), jnp.zeros((NUMBER, 6))
    rolled = roll(batch, code=statespace.encode(pose, *solid))

    @jax.jit
    def by_hand(code, condition, velocity):
        inputs, one = {"state": code}, {"state": jnp.ones(NUMBER, bool)}
        net = nnx.merge(*model)
        belief = networks.of_state(networks.fuse(networks.experts(net, inputs, one, batch["empty"]), one))
        return net.transition(belief, condition, velocity)

    for i in range(3):
        density = by_hand(statespace.encode(pose, *solid), batch["condition"][:, i], velocity)
        likeliest = density.mean[jnp.arange(NUMBER), 0, density.weight[:, 0].argmax(-1)]
        velocity = poses.turn_motion(density.heading, likeliest)
        pose = advanced(pose, velocity)
        np.testing.assert_allclose(rolled.pose[i, 0], pose, atol=2e-3)
    assert np.abs(velocity).max() > 0.01


def test_courses_are_rigid_and_an_item_does_not_depend_on_the_others(batch, roll):
    keys = jax.random.split(jax.random.key(1), NUMBER)
    rolled = roll(batch, keys, num=3)
    matrix = np.asarray(poses.matrix(rolled.pose))
    np.testing.assert_allclose(matrix @ matrix.swapaxes(-1, -2), np.broadcast_to(np.eye(3), matrix.shape), atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(matrix), 1, atol=1e-5)
    backwards = roll(jax.tree.map(lambda x: x[::-1], batch) | {"empty": batch["empty"]}, keys[::-1], num=3)
    np.testing.assert_allclose(backwards.pose[:, :, ::-1], rolled.pose, atol=1e-5)
    assert np.abs(np.diff(rolled.pose, axis=1)).max() > 1e-3


def test_a_sampled_step_is_the_mean_of_a_drawn_component_unless_the_object_rests():
    """The second item most probably rests, and the third one has a heading of 90 degrees."""
    share, num = np.array([[0.5, 0.2, 0.3], [0.35, 0.25, 0.4], [0.5, 0.2, 0.3]]), 1000
    mean = np.random.default_rng(0).normal(size=(3, 6))
    angle = np.array([[1.0, 0], [1, 0], [0, 1]])
    parts = np.log([[1]] * 3), np.log(share)[:, None], np.tile(mean, (3, 1, 1, 1)), np.zeros((3, 1, 3, 6)), angle
    density = networks.FinalPose(*(jnp.asarray(np.tile(x, (num, *[1] * (x.ndim - 1))), jnp.float32) for x in parts))
    run = jax.jit(_motions, static_argnames="num")
    found = np.asarray(run(jax.random.split(jax.random.key(0), 3), density, num)).reshape(num, 3, 6)
    turned = [np.kron(np.eye(2), Rotation.from_euler("z", degrees, degrees=True).as_matrix()) for degrees in (0, 0, 90)]
    chosen = []
    for i, expected in enumerate([share[0], [0, 0, 1], share[2]]):
        distance = np.linalg.norm(found[:, i, None] - mean @ turned[i].T, axis=-1)
        np.testing.assert_allclose(distance.min(1), 0, atol=1e-5)
        chosen.append(distance.argmin(1))
        np.testing.assert_allclose(np.bincount(chosen[i], minlength=3) / num, expected, atol=0.06)
    assert (chosen[0] != chosen[2]).any()  # each item has draws of its own
    alone = np.asarray(run(None, jax.tree.map(lambda x: x[:3], density), 1))
    np.testing.assert_allclose(alone, [mean[0], mean[2], turned[2] @ mean[0]], atol=1e-5)


def test_an_object_below_the_pad_keeps_its_pose(batch, roll):
    code = batch["targets"]["state"]
    low = code.at[:2, 2].set(-3.0)
    rolled = roll(batch, jax.random.split(jax.random.key(0), NUMBER), code=low, num=3)
    for i in range(3):
        same(rolled.pose[i, :, :2], rolled.pose[0, :, :2])
    np.testing.assert_allclose(rolled.pose[0, :, :2, 2], -3, atol=0.05)
    assert np.abs(np.diff(rolled.pose[:, :, 2:], axis=0)).min() > 0


def test_steps_are_drawn_from_all_frames_with_the_velocity_of_the_course(batch):
    stride, number = 2, 400
    rows = jnp.arange(number) % NUMBER
    code, course = batch["targets"]["state"][rows], batch["targets"]["course"][rows]
    numbered = jnp.tile(jnp.arange(FRAMES, dtype=jnp.float32)[None, :, None], (number, 1, 1))
    ends = objective._Ends(
        Gaussian(code, jnp.full_like(code, -9.2)), code, course, jnp.zeros(number, int), numbered, rows >= 0
    )
    draw, motion_of = jax.jit(objective._drawn_steps, static_argnums=1), jax.jit(poses.motion)
    steps = draw(jax.random.key(0), dataclasses.replace(CONFIG, stride=stride), ends)
    frame = np.asarray(steps.condition[:, 0]).astype(int)
    assert sorted(set(frame.tolist())) == [0, 2, 3, 4]  # frame 1 has no frame two frames before it
    exact = np.asarray((jnp.arange(number) // 2 % 2 == 0) | (frame == 0))
    index, before = np.arange(number), np.maximum(frame - stride, 0)
    velocity = motion_of(course[index, before], course[index, frame])
    motion = motion_of(course[index, frame], course[index, frame + stride])
    np.testing.assert_allclose(steps.velocity[exact], velocity[exact], atol=1e-5)
    np.testing.assert_allclose(steps.motion, motion, atol=1e-5)
    np.testing.assert_allclose(steps.belief.mean[:, :12], course[index, frame], atol=1e-4)
    same(steps.velocity[frame == 0], jnp.zeros_like(velocity[frame == 0]))
    scatter = np.asarray(steps.velocity - velocity)[~exact].std(0)
    np.testing.assert_allclose(scatter, objective._JITTER, rtol=0.3)


@pytest.mark.slow
def test_the_loss_of_a_one_step_model_is_finite_and_the_course_trains_the_transition_only(model, batch):
    given = batch | {"falls": {name: batch["targets"][name] for name in ("state", "course", "outcome")}}
    given["falls"] |= {"condition": batch["condition"]}

    @jax.jit
    @functools.partial(jax.value_and_grad, has_aux=True)
    def run(params, batch):
        return statespace.loss(model[0], params, jax.random.key(0), **batch)

    value, gradient = run(model[1], given)
    finite((value, gradient))
    np.testing.assert_array_equal(value[1]["outcome"], 0)
    other = jax.tree.map(lambda x: x, given)
    other["targets"] |= {"course": batch["targets"]["course"].at[:, 1:, :3].add(0.1)}
    terms = run(model[1], other)[0][1]
    assert {name for name in terms if terms[name] != value[1][name]} == {"pose"}


def test_a_rendered_frame_is_that_of_the_decoder(model, batch, roll):
    rolled = roll(batch)
    images, mean = jax.jit(functools.partial(statespace.render, *model, None))(
        rolled.belief, rolled.pose[1], rolled.turn[1], batch["empty"]
    )

    @jax.jit
    def by_hand(code, pose, turn):
        layers = nnx.merge(*model).decoder(pose, turn, *jnp.split(code, [state.CODE], axis=1))
        empty = {name: networks.reduced(x, CONFIG.image_size) for name, x in batch["empty"].items()}
        return networks.compose(layers, empty)

    for name, image in by_hand(rolled.belief.mean, rolled.pose[1, 0], rolled.turn[1, 0]).items():
        np.testing.assert_allclose(mean[name], image, atol=1e-4)
        np.testing.assert_allclose(images[name][0], image, atol=1e-4)


PERIOD, GRAVITY, SCALE = 0.032, 2.0, 0.05  # s, m/s^2, m


def coasting(rng, number, frames=11):
    """Spheres that fall, and are accelerated along x and y for 0.16 s, with conditions (acceleration, time)."""
    time = PERIOD * np.arange(frames)
    acceleration = rng.uniform(-3, 3, (number, 2))  # m/s^2
    early = np.minimum(time, 0.16)
    path = acceleration[:, None] * (early**2 / 2 + 0.16 * (time - early))[None, :, None]
    start = rng.uniform([-0.02, -0.02, 0.13], [0.02, 0.02, 0.17], (number, 3))
    drop = np.broadcast_to(-GRAVITY * time[None, :, None] ** 2 / 2, (number, frames, 1))
    position = start[:, None] + np.concatenate([path, drop], axis=2)
    matrix = np.broadcast_to(np.eye(3).ravel(), (number, frames, 9))
    code = jnp.asarray(np.concatenate([position / SCALE, matrix], axis=2), jnp.float32)
    radius = rng.uniform(0.01, 0.02, number)
    solid = np.repeat(radius[:, None], 128, 1), rng.uniform(0.02, 0.2, number), np.zeros((number, 3))
    first = statespace.encode(code[:, 0], *(jnp.asarray(x, jnp.float32) for x in solid))
    each = np.broadcast_to(acceleration[:, None], (number, frames, 2))
    condition = np.concatenate([each, np.broadcast_to(time[None, :, None], (number, frames, 1))], axis=2)
    falls = {"state": first, "course": code, "outcome": jnp.zeros(number, jnp.int32)}
    return falls | {"condition": jnp.asarray(condition, jnp.float32)}


@pytest.mark.slow
def test_the_transition_learns_a_fall_and_a_push_of_known_duration():
    """The error after 10 steps is less than a quarter of the way. With a push that never ends, it would be a third."""
    config = dataclasses.replace(CONFIG, transition=64, inputs=("visual",), components=2)
    graphdef, params, _ = statespace.init(jax.random.key(0), config)
    data, test = coasting(np.random.default_rng(0), 4096), coasting(np.random.default_rng(1), 32)
    optimiser = optax.adam(optax.cosine_decay_schedule(5e-3, 400))

    @jax.jit
    def train(params):
        def loss(params, key):
            rows = jax.random.randint(key, (64,), 0, 4096)
            ends = objective._known_ends(key, {name: x[rows] for name, x in data.items()}, "course")
            return objective._step_terms(nnx.merge(graphdef, params), key, ends)["pose"]

        def update(carry, key):
            params, memory = carry
            value, gradient = jax.value_and_grad(loss)(params, key)
            change, memory = optimiser.update(gradient, memory)
            return (optax.apply_updates(params, change), memory), value

        keys = jax.random.split(jax.random.key(0), 400)
        return jax.lax.scan(update, (params, optimiser.init(params)), keys)[0][0]

    params = train(params)
    frames, number = data["course"].shape[1], len(test["state"])
    blank = {name: jnp.zeros((32, 32, 3)) for name in statespace.IMAGES}
    one = {"state": jnp.ones(number, bool)}
    rolled = jax.jit(functools.partial(statespace.rollout, graphdef, steps=frames - 1))(
        params, None, {"state": test["state"]}, one, blank, test["condition"][:, :-1]
    )
    error = np.abs(rolled.pose[-1, 0, :, :3] - test["course"][:, -1, :3]).mean(0)
    way = np.abs(test["course"][:, -1, :3] - test["course"][:, 0, :3]).mean(0)  # the error of the start velocity, 0
    assert (error < way / 4).all()


def test_courses_before_frame_0_are_at_rest(model, batch, roll):
    """A first step from another frame than 0 would begin with a velocity."""
    known = networks.of_state(Gaussian(*roll(batch).belief))
    first = batch["targets"]["state"]
    still = _Course(first[None, :, :3], jnp.tile(jnp.array([1.0, 0, 0, 0]), (1, NUMBER, 1)), jnp.zeros((1, NUMBER, 6)))
    run = jax.jit(lambda course: step(nnx.merge(*model), None, known, course, batch["condition"][:, 0]))
    np.testing.assert_allclose(run(still).position, roll(batch).pose[0, ..., :3], atol=2e-3)
    fast = still._replace(velocity=jnp.ones((1, NUMBER, 6)))
    assert np.abs(run(fast).position - run(still).position).min() > 0.1


@pytest.mark.parametrize(
    ("change", "message"),
    [({"stride": 1, "outcomes": 3}, "stride must be 0, or >= 1 with outcomes=1"), ({"stride": -1}, "stride must be 0")],
)
def test_a_one_step_model_has_one_outcome(change, message):
    with pytest.raises(ValueError, match=message):
        storage.decode(statespace.Config, dataclasses.asdict(STATE) | change, "model")


def test_a_config_without_a_stride_is_that_of_a_final_step_model(model, batch):
    old = {name: value for name, value in dataclasses.asdict(STATE).items() if name != "stride"}
    assert storage.decode(statespace.Config, old, "model") == STATE
    final = statespace.init(jax.random.key(0), STATE)[:2]
    one = {"state": jnp.ones(NUMBER, bool)}
    with pytest.raises(ValueError, match="predicts the last frame: train a one-step model"):
        statespace.rollout(*final, None, {"state": batch["targets"]["state"]}, one, batch["empty"], steps=2)


SCALE_OF_CONDITION = (10.0, 10.0, 1.0)
STEP_VIEW = {"stride": 1, "period": 0.1, "condition_scale": SCALE_OF_CONDITION}
GIVEN_CONDITION = np.array([[5.0, -2.0], [1.0, 3.0]], np.float32)


@pytest.fixture(scope="module")
def predictor():
    new = untrained(dataclasses.replace(CONFIG, inputs=("visual", "pose")), **STEP_VIEW)
    awake(new.model.state)
    return new


def first_frames():
    rng = np.random.default_rng(0)
    pose = np.concatenate([rng.uniform(-0.02, 0.02, (2, 2)), np.full((2, 1), 0.05), np.eye(4)[[0, 1]]], axis=1)
    return {"visual": rng.random((2, 32, 32, 3), np.float32), "pose": pose.astype(np.float32)}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:(visual|tactile|pose) ")
def test_a_predictor_rolls_out_with_the_time_of_each_step(predictor):
    given, view = first_frames(), predictor.preprocessing
    out = predictor.rollout(given, 3, condition=GIVEN_CONDITION, time=0.2)
    each = np.repeat(GIVEN_CONDITION[:, None], 3, axis=1) / 10
    condition = np.concatenate([each, np.broadcast_to(0.2 + 0.1 * np.arange(3)[:, None], (2, 3, 1))], axis=2)
    inputs = {"visual": jnp.asarray(given["visual"]), "pose": view.encode_pose(jnp.asarray(given["pose"]))}
    parts = predictor.model.graphdef, predictor.model.state, None, inputs, dict.fromkeys(inputs, jnp.ones(2, bool))
    empty = {name: jnp.asarray(image) for name, image in predictor.empty.items()}
    rolled = statespace.rollout(*parts, empty, jnp.asarray(condition, jnp.float32), steps=3)
    expected = view.decode_pose(jnp.moveaxis(rolled.pose[:, 0], 0, 1))
    np.testing.assert_allclose(out.pose, expected, atol=3e-4)
    other = predictor.rollout(given, 3, condition=GIVEN_CONDITION, time=0.7)
    assert np.abs(other.pose - out.pose).max((0, 2)).min() > 1e-3
    assert out.visual.shape == out.tactile.shape == (2, 3, 16, 16, 3)
    assert out.mean.shape == (2, 3, rolled.belief.mean.shape[1])
    assert out.samples is out.outcome_probability is None
    last = predictor.rollout(given, 3, condition=GIVEN_CONDITION, time=0.2, last=True)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b[:, 2:], atol=1e-5), last, out)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:(visual|tactile|pose) ")
def test_samples_of_a_predictor_are_courses_with_mean_images_and_central_poses(predictor):
    known = {"condition": GIVEN_CONDITION, "key": jax.random.key(2), "num_samples": 3}
    out = predictor.rollout(first_frames(), 2, **known)
    assert out.samples.visual.shape == (3, 2, 2, 16, 16, 3)
    assert out.samples.pose.shape == (3, 2, 2, 7)
    quats = np.abs(np.einsum("sntq,ntq->snt", out.samples.pose[..., 3:], out.pose[..., 3:]))
    np.testing.assert_allclose(quats.max(0), 1, atol=1e-5)  # the orientation is that of a sample
    assert (np.abs(out.samples.pose[..., :3] - out.pose[..., :3]).max(0) > 0).any()
    one = predictor.rollout(first_frames(), 2, **known | {"num_samples": 0})
    assert one.pose.shape == (2, 2, 7)
    alone = {name: value[1] for name, value in first_frames().items()}
    found = predictor.rollout(alone, 2, **known | {"condition": GIVEN_CONDITION[1]})
    np.testing.assert_allclose(found.pose, out.pose[1], atol=1e-5)
