"""What `simulate` and `place` refuse, with a message that names the argument or the field."""

import dataclasses
import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sts_jax import objects, physics
from sts_jax.physics import Freefall, Inclined, Perturbed, Released
from sts_jax.sensor import Sensor

NAN = float("nan")
BODIES = [objects.make(jax.random.key(i), name) for i, name in enumerate(["bottle", "fork"])]
GOOD = {"key": jax.random.key(0), "body": BODIES[0], "sensor": Sensor(), "scenario": Freefall(), "num": 2}
START = physics.Start(np.tile(np.float32([0, 0, 0.1, 1, 0, 0, 0]), (2, 1)), np.array(0), np.zeros((2, 0), np.float32))
HIDDEN = physics.Hidden(np.ones(2), np.ones(2), np.ones(2), np.tile(np.float32([0, 0, 1]), (2, 1)))
LEANING = jnp.asarray(BODIES[0].hulls) + BODIES[0].hulls[..., 2:] * jnp.array([1.5, 0, 0])


def changed(scenario: physics.Scenario, **fields: object) -> dict:
    scenario = dataclasses.replace(scenario)
    for name, value in fields.items():
        object.__setattr__(scenario, name, value)  # past the tests' own checks of types
    return {"scenario": scenario}


def second(**fields: object) -> dict:
    return {"body": [BODIES[0], dataclasses.replace(BODIES[1], **fields)]}


ARGUMENTS = [
    ({"body": "bottle.obj"}, r"body 0 is 'bottle\.obj', but it must be a Body, .*objects\.load"),
    ({"sensor": None}, "sensor is None, but it must be a Sensor"),
    ({"scenario": "freefall"}, r"scenario is 'freefall', but it must be Freefall\(\)"),
    ({"key": 0}, r"key is 0, but it must be a JAX key, such as jax\.random\.key\(0\)"),
    ({"num": 0}, "num is 0, but it must be a whole number"),
    ({"num": 10**10}, "num is 10000000000, .* from 1 to 100,000,000"),
    ({"num": 10**7}, r"num is 10000000, which gives 600,000,000 frames.* GB: call it several times"),
    ({"chunk": 10**10}, "chunk is 10000000000, .* from 1 to 100,000,000"),
    ({"progress": "bar"}, "progress is 'bar', but it must be True, False or a function"),
    ({"engine": "bullet"}, "engine is 'bullet', but it must be 'mjx' or 'mujoco'"),
    (second(shell_mass=jnp.float32(-0.1)), "body 1: shell_mass is -0.1"),
    (second(vertices=jnp.full((1024, 3), NAN)), r"body 1: vertices has values that are not finite \(3,072 of"),
    (second(shell_inertia=-jnp.eye(3), contents_density=jnp.float32(0)), "body 1: principal moments"),
    ({**second(hulls=LEANING), "scenario": Perturbed()}, "body 1: it does not stand upright"),
]
FIELDS = [
    (changed(Freefall(), frames=59.5), r"scenario\.frames is 59.5, .* a whole number"),
    (changed(Freefall(), fill=(0.0, "1")), r"scenario\.fill is .* a tuple of two numbers"),
    (changed(Freefall(), friction=(-0.1, 0.5)), r"scenario\.friction is .* 0 < low"),
    (changed(Freefall(), rate=30.0), "rate is 30"),
    (changed(Freefall(), frames=10), r"scenario\.frames is 10 .* 0.05 m .* 0.301 s: give at least 11 frames"),
    (changed(Inclined(), slope=30.0), r"scenario\.slope is 30.0 rad, .* use math\.radians"),
    (changed(Released(), beyond=(-10.0, 10.0)), r"scenario\.beyond .* use math\.radians"),
]
CONTACTS = [
    (changed(Freefall(), frames=10**9), r"scenario\.frames is 1000000000 with 32 time steps .* from 1 to 312,500"),
    (changed(Inclined(), tries=10**10), r"scenario\.tries is 10000000000, but it must be from 1 to 10,000"),
]
for name, values in {
    "timestep": (NAN, 0.0, -0.001),
    "time_constant": (NAN, 0.0, np.inf),
    "damping_ratio": (NAN, -np.inf, 0.0),
    "soft": (NAN, 0.0, 1.0),
    "hard": (-0.1, 1.5),
    "width": (NAN, 0.0, -1.0),
    "torsional": (NAN, -0.1),
    "rolling": (np.inf, -0.1),
    "impratio": (NAN, 0.0, -1.0),
    "iterations": (0, 10**12),
    "ls_iterations": (0, -1),
}.items():
    for value in values:
        contact = dataclasses.replace(Freefall().contact, **{name: value})
        CONTACTS.append((changed(Freefall(), contact=contact), rf"scenario\.contact\.{name} must be .*, got {value}"))
GIVEN = [
    ({"start": START._replace(pose=np.zeros((2, 7)))}, r"start\.pose has quaternions whose length is not 1"),
    ({"start": START._replace(condition=np.zeros((2, 1)))}, r"start\.condition has shape \(2, 1\), .* \(2, 0\)"),
    ({"start": START._replace(held=np.array(-1))}, r"start\.held is -1, but each value must be an integer >= 0"),
    ({"start": START._replace(held=np.array(999))}, r"start\.held is 999, but it must be at most scenario\.steps"),
    ({"hidden": HIDDEN._replace(up=np.ones((2, 3)))}, r"hidden\.up has rows that are not unit vectors"),
    ({"hidden": HIDDEN._replace(fill=np.array([0, 1.5]))}, r"hidden\.fill is from 0.0 to 1.5"),
]


@pytest.mark.parametrize(("change", "message"), [*ARGUMENTS, *FIELDS, *CONTACTS, *GIVEN])
def test_what_simulate_refuses_is_named(change, message):
    with pytest.raises((TypeError, ValueError), match=message):
        inspect.unwrap(physics.simulate)(**GOOD | change)


TURN = np.float32([[1, 0, 0], [0, np.cos(0.5), -np.sin(0.5)], [0, np.sin(0.5), np.cos(0.5)]])
BODY = BODIES[0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"face": 99}, r"`face` is 99, .* no such face: the body can rest on faces 0 \(the most likely\) to \d+"),
        ({"position": (0.2, 0.0)}, r"position is \(0.2, 0.0\) m, but the body would fall off"),
        ({"up": (0.0, 0.0, 2.0)}, r"`up` is .* of length 2, but it must have the length 1"),
        ({"body": dataclasses.replace(BODY, hulls=BODY.hulls @ TURN.T), "face": "upright"}, "does not stand stably"),
        ({"body": dataclasses.replace(BODY, hulls=jnp.zeros((1, 64, 3)))}, "hulls span no volume"),
        ({"body": "mug.obj"}, r"body is 'mug\.obj', but it must be one Body, from .* objects\.load"),
    ],
)
def test_what_place_refuses_is_named(changes, message):
    with pytest.raises((TypeError, ValueError), match=message):
        inspect.unwrap(physics.place)(**{"body": BODY, "sensor": Sensor()} | changes)


def test_stable_faces_are_not_computed_of_a_traced_body():
    with pytest.raises(TypeError, match=r"`body`, .* is traced.* outside jit"):
        jax.eval_shape(lambda body: inspect.unwrap(physics.stable_faces)(body), BODY)


def test_a_scenario_that_holds_longer_than_the_interval_before_frame_0_is_named():
    class Late(Freefall):
        def start(self, key, shape, pad):
            return super().start(key, shape, pad)._replace(held=jnp.asarray(2 * self.steps))

    with pytest.raises(ValueError, match=r"scenario\.start returns held from \d+ to \d+ time steps"):
        physics.simulate(**GOOD | {"scenario": Late(frames=20)})


def test_short_intervals_have_starts_that_are_not_held():
    sliding = physics.simulate(**GOOD | {"scenario": Inclined(rate=250.0, frames=2), "num": 8})
    assert np.isfinite(sliding.pose).all()
