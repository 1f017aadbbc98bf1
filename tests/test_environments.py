"""The environments, against the checker of Gymnasium, the interface of MuJoCo Playground, and each other."""

import dataclasses
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import trimesh

import sts_jax as sts
from sts_jax import scene
from sts_jax.environments import Lift, State, Task
from sts_jax.environments.task import Reward, Start, judge, placed

gymnasium = pytest.importorskip("gymnasium")
from gymnasium.utils.env_checker import check_env  # noqa: E402

from sts_jax.environments.gym import GymLift  # noqa: E402

TASK = Task(resolution=(16, 16))
# Public members of mujoco_playground.MjxEnv (0.2.0), without `model_assets`, which is for environments with an XML file
MEMBERS = {
    *("action_size", "dt", "mj_model", "mjx_model", "n_substeps", "observation_size", "render", "reset", "sim_dt"),
    *("step", "unwrapped", "xml_path"),
}
RISE, CLOSE, WAIT = np.array([1.0, 0]), np.array([0.0, 1]), np.zeros(2)


def sensor():
    """A sensor of 40 mm with a coarse grid, which compiles fast."""
    made = sts.Sensor.sized(0.04)
    return dataclasses.replace(made, gel=dataclasses.replace(made.gel, cells=(20, 20)))


@pytest.fixture(scope="module")
def lift():
    return Lift(sensor(), task=TASK)


@pytest.fixture(scope="module")
def gym_lift():
    kwargs = {"sensor": sensor(), "task": TASK, "render_mode": "rgb_array"}
    return gymnasium.make("sts_jax/Lift-v0", disable_env_checker=True, **kwargs).unwrapped


def grasp(squeeze):
    """Actions that close, squeeze by `squeeze` (share of a step) further, and lift."""
    yield from [CLOSE] * 35
    yield from [squeeze * CLOSE] * 4
    yield from [WAIT] * 5
    yield from [RISE / 2] * 40


@pytest.mark.slow
def test_gymnasium_finds_no_fault(gym_lift):
    check_env(gym_lift)


def test_gymnasium_makes_it_with_a_time_limit():
    assert gymnasium.spec("sts_jax/Lift-v0").max_episode_steps == 150
    assert GymLift.metadata["render_modes"] == ["rgb_array"]


@pytest.mark.slow
def test_a_firm_grasp_lifts_and_a_light_one_slips(gym_lift):
    rises = {}
    for friction, squeeze in ((0.3, 0.1), (0.3, 0.5), (1.0, 0.1)):
        observation, _ = gym_lift.reset(seed=1)
        untouched = observation["pixels/left_tactile"]
        gym_lift.model.geom_friction[gym_lift.setting.geoms, 0] = friction
        for action in grasp(squeeze):
            observation, reward, terminated, truncated, info = gym_lift.step(action.astype(np.float32))
        assert not terminated
        assert not truncated
        felt = np.any(observation["pixels/left_tactile"] != untouched)
        assert felt == (info["touch"] > 0)
        weights = TASK.weights._asdict()
        assert reward == pytest.approx(sum(weights[name] * info[name] for name in weights), abs=1e-5)
        rises[friction, squeeze] = info["lift"]
    # A pad can hold at most mu N, and half the weight hangs on each: 2 mu N >= m g.
    assert rises[0.3, 0.1] < 0.1
    assert rises[0.3, 0.5] == rises[1.0, 0.1] == 1


@pytest.mark.slow
def test_seeds_draw_the_ranges_of_the_task(gym_lift):
    frictions, places = [], []
    for seed in range(20):
        _, info = gym_lift.reset(seed=seed)
        frictions.append(info["friction"])
        places.append(gym_lift.data.qpos[3:5].copy())
    assert min(frictions) >= TASK.friction[0]
    assert max(frictions) <= TASK.friction[1]
    assert np.ptp(frictions) > 0.4
    assert np.abs(places).max() <= TASK.offset
    assert np.ptp(places, axis=0).min() > TASK.offset


def test_the_object_starts_on_the_table(gym_lift):
    setting = gym_lift.setting
    for yaw in (-0.2, 0.15):
        data = mujoco.MjData(setting.model)
        data.qpos[:] = placed(setting, Start(np.array([0.003, -0.002]), yaw, 0.5))
        mujoco.mj_forward(setting.model, data)
        turned = data.xmat[setting.body].reshape(3, 3)
        np.testing.assert_allclose(turned[:2, 0], [np.cos(yaw), np.sin(yaw)], atol=1e-6)
        np.testing.assert_allclose(
            data.xpos[setting.body], [0.003, -0.002, setting.home.xpos[setting.body, 2]], atol=1e-6
        )


@pytest.mark.slow
def test_the_interface_is_that_of_playground(lift):
    assert set(dir(lift)) >= MEMBERS
    assert [field.name for field in dataclasses.fields(State)] == ["data", "obs", "reward", "done", "metrics", "info"]
    assert lift.n_substeps * lift.sim_dt == pytest.approx(lift.dt)
    assert lift.unwrapped is lift
    keys = jax.random.split(jax.random.key(0), 3)
    state = jax.eval_shape(jax.vmap(lift.reset), keys)
    after = jax.eval_shape(jax.vmap(lift.step), state, jnp.zeros((3, lift.action_size)))
    assert {name: value.shape[1:] for name, value in state.obs.items()} == lift.observation_size
    assert state.reward.shape == state.done.shape == (3,)
    # `lax.scan` over steps needs a state of the same structure, shapes and types.
    assert jax.tree.structure(state) == jax.tree.structure(after)
    assert [(x.shape, x.dtype) for x in jax.tree.leaves(state)] == [(x.shape, x.dtype) for x in jax.tree.leaves(after)]


def test_playgrounds_wrappers_accept_it(lift):
    playground = pytest.importorskip("mujoco_playground")
    members = {name for name in vars(playground.MjxEnv) if not name.startswith("_")}
    assert members - {"model_assets"} == MEMBERS
    assert set(playground.State.__annotations__) == {field.name for field in dataclasses.fields(State)}
    env = playground.wrapper.wrap_for_brax_training(lift, episode_length=3)
    state = jax.eval_shape(env.reset, jax.random.split(jax.random.key(0), 2))
    after = jax.eval_shape(env.step, state, jnp.zeros((2, env.action_size)))
    assert jax.tree.structure(state) == jax.tree.structure(after)


@pytest.mark.slow
def test_both_engines_agree_on_a_grasp(lift, gym_lift):
    reset, step = jax.jit(lift.reset), jax.jit(lift.step)
    state = reset(jax.random.key(3))
    gym_lift.reset(seed=0)
    gym_lift.model.geom_friction[gym_lift.setting.geoms, 0] = state.info["friction"]
    gym_lift.data.qpos[:] = state.data.qpos
    mujoco.mj_forward(gym_lift.model, gym_lift.data)
    for action in grasp(0.5):
        state = step(state, jnp.asarray(action))
        observation, reward, terminated, _, info = gym_lift.step(action.astype(np.float32))
        assert not terminated
        assert state.done == 0
        assert info["lift"] == pytest.approx(float(state.metrics["lift"]), abs=0.02)
    assert info["held"] == state.metrics["held"] == 1
    assert reward == pytest.approx(float(state.reward), abs=0.02)
    for name, value in observation.items():
        expected = np.asarray(state.obs[name]) * (1 if name == "state" else 255)
        np.testing.assert_allclose(value, expected, atol=1e-3 if name == "state" else 3)
    assert lift.render([state], 20, 30)[0].shape == (40, 60, 3)
    again = reset(jax.random.key(3))
    for first, second in zip(jax.tree.leaves(reset(jax.random.key(3))), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(np.asarray(first), np.asarray(second))


@pytest.mark.parametrize(
    ("place", "forces", "qpos", "reward", "done"),
    [
        ([0, 0, 0.03], [0.0, 0.0], 0.0, 0, False),
        ([0, 0, 0.03], [0.5, 2.0], 0.0, 0.1 - 0.1, False),  # touches, but squeezes
        ([0, 0, 0.055], [0.5, 0.5], 0.0, 0.1 + 0.5 - 0.025, False),
        ([0, 0, 0.09], [0.5, 0.5], 0.0, 0.1 + 1 + 1 - 0.025, False),
        ([0, 0, 0.09], [0.0, 0.0], 0.0, 1, False),  # thrown, not held
        ([0.2, 0, 0.03], [0.0, 0.0], 0.0, 0, True),
        ([0, 0, 0.03], [0.0, 0.0], np.nan, 0, True),
        ([0, 0, np.nan], [1.0, 1.0], 0.0, 0, True),
    ],
)
def test_judgement(place, forces, qpos, reward, done):
    got = judge(TASK, np.array(place, np.float32), 0.03, np.array(forces, np.float32), np.full(10, qpos, np.float32))
    assert got[0] == pytest.approx(reward, abs=1e-5)
    assert bool(got[2]) is done
    assert isinstance(got[1], Reward)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mass": 0.0}, "task.mass is 0.0, but it must be > 0"),
        ({"yaw": -0.1}, "task.yaw is -0.1, but it must be >= 0"),
        ({"friction": (0.5, 0.2)}, r"task.friction is \(0.5, 0.2\)"),
        ({"control_dt": 0.0015}, "task.control_dt is 0.0015 s, but it must be a multiple of timestep, 0.001 s"),
        ({"offset": 0.04}, "opening is 0.1 m, but the object reaches"),
        ({"height": 0.29}, r"task.height is 0.29 m, but the gripper rises by 0.278 m at most"),
    ],
)
def test_bad_tasks_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        Lift(sensor(), task=dataclasses.replace(TASK, **changes))


@pytest.mark.parametrize(("name", "value"), [("friction", [0.3, 0.5]), ("resolution", (16,)), ("speed", [0.2, 0.1])])
def test_a_list_or_a_tuple_of_another_length_in_a_task_is_named(name, value):
    task = dataclasses.replace(TASK)
    object.__setattr__(task, name, value)  # users have no check of annotations
    with pytest.raises(ValueError, match=rf"task.{name} is .* but it must be a tuple of two numbers"):
        task.check()


@pytest.mark.parametrize(
    ("size", "yaw", "offset"), [((0.03, 0.12), np.pi, 0.0), ((0.08, 0.03), 0.0, 0.011), ((0.08, 0.03), 0.6, 0.0078)]
)
def test_an_object_that_does_not_fit_at_some_start_is_refused(tmp_path, size, yaw, offset):
    trimesh.creation.box((*size, 0.04)).export(tmp_path / "box.stl")
    body = sts.objects.load(tmp_path / "box.stl", mass=0.1)
    for sign in (-1, 1):
        scene.gripper(sensor(), body, yaw=sign * yaw)  # it fits at the ends of the range of yaws
    task = dataclasses.replace(TASK, yaw=yaw, offset=offset)
    with pytest.raises(ValueError, match=r"opening is 0\.1 m, but the object reaches"):
        Lift(sensor(), body, task)


@pytest.mark.parametrize("fault", ["state", "action"])
def test_what_diverges_ends_the_episode(gym_lift, fault):
    gym_lift.reset(seed=0)
    if fault == "state":
        gym_lift.data.qvel[0] = 1e12
    action = np.array([np.nan if fault == "action" else 0.0, 0.0], np.float32)
    _, reward, terminated, _, _ = gym_lift.step(action)
    assert (reward, terminated) == (0.0, True)
    gym_lift.reset(seed=0)
    assert not gym_lift.step(np.zeros(2, np.float32))[2]


def test_an_action_may_be_a_list_and_its_shape_is_checked(gym_lift):
    states = []
    for action in ([0.5, 1.0], np.array([0.5, 1.0], np.float32)):
        gym_lift.reset(seed=0)
        gym_lift.step(action)
        states.append(gym_lift.data.qpos.copy())
    np.testing.assert_array_equal(*states)
    for action in (np.zeros(3, np.float32), np.zeros((1, 2), np.float32)):
        with pytest.raises(ValueError, match=r"action has the shape .*, but it must be \(2,\): \('lift', 'grip'\)"):
            gym_lift.step(action)


def test_an_unknown_render_mode_is_refused():
    with pytest.raises(ValueError, match="render_mode is 'human'"):
        GymLift(sensor(), render_mode="human")


def test_without_gymnasium_an_error_names_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "sts_jax.environments.gym")
    with pytest.raises(ImportError, match="pip install gymnasium"):
        import sts_jax.environments.gym  # noqa: F401
