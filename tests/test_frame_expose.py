"""Images at any light between the two streams, against a loop in NumPy float64."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from optics_bodies import noise, with_field

import sts_jax as sts

expose = jax.jit(sts.expose)
SENSOR = sts.Sensor()


def decode(s):
    return s / 12.92 if s <= 0.04045 else ((s + 0.055) / 1.055) ** 2.4


def encode(x):
    return 12.92 * x if x <= 0.0031308 else 1.055 * x ** (1 / 2.4) - 0.055


@pytest.mark.parametrize("exposure", [1.0, 6.0])
def test_light_0_and_1_return_the_streams_exactly_and_a_traced_light_is_clipped(exposure):
    frame, sensor = noise((97, 53)), with_field(SENSOR, "room.exposure", exposure)
    for lights, stream in (((0.0, -0.5, np.nan), frame.visual), ((1.0, 1.5, np.inf), frame.tactile)):
        assert np.array_equal(sts.expose(sensor, frame, lights[0]), stream)
        assert all(np.array_equal(expose(sensor, frame, light), stream) for light in lights)


@pytest.mark.parametrize("exposure", [1.0, 6.0])
def test_light_is_added_in_linear_units(exposure):
    shape = (97, 53)
    frame = noise(shape)
    rng = np.random.default_rng(1)
    for light in (1e-3, 0.2, 0.5, 0.9):
        image = np.asarray(expose(with_field(SENSOR, "room.exposure", exposure), frame, light))
        for i, j, k in zip(*(rng.integers(n, size=200) for n in (*shape, 3)), strict=True):
            seen, felt = float(frame.visual[i, j, k]), float(frame.tactile[i, j, k])
            # The exposure time is `exposure` with the LEDs off, and 1 at full power.
            outside, leds_on = decode(seen) / exposure, decode(felt)
            radiance = outside + light * (leds_on - outside)
            grey = 1 / exposure + light * (1 - 1 / exposure)  # of a pixel that is 1 in both streams
            assert image[i, j, k] == pytest.approx(encode(radiance / grey), abs=2e-6)


def test_gradients_equal_finite_differences_and_are_finite_at_0_and_1():
    frame = noise((97, 53))
    weights = jnp.asarray(np.random.default_rng(2).normal(size=(97, 53, 3)), jnp.float32)
    inner = (frame.visual > 0.1) & (frame.visual < 0.9)

    def loss(light, exposure, visual):
        shown = sts.expose(
            with_field(SENSOR, "room.exposure", exposure), dataclasses.replace(frame, visual=visual), light
        )
        return jnp.mean(weights * shown)

    value, gradient = jax.jit(loss), jax.jit(jax.grad(loss, argnums=(0, 1, 2)))
    here = (0.3, 4.0, frame.visual)
    steps = (0.01, 0, 0), (0, 0.1, 0), (0, 0, 0.01 * jnp.where(inner, weights, 0))
    for step in steps:
        there, back = (value(*(x + sign * s for x, s in zip(here, step, strict=True))) for sign in (1, -1))
        slope = sum(jnp.sum(g * s) for g, s in zip(gradient(*here), step, strict=True))
        assert float(slope) == pytest.approx(float(there - back) / 2, rel=0.01)
    for light in (0.0, 1.0):
        assert all(np.all(np.isfinite(leaf)) for leaf in gradient(light, *here[1:]))
    # At 0 and 1 the image is the stream itself, so its derivative is 1.
    by_light, _, by_visual = gradient(0.0, *here[1:])
    np.testing.assert_allclose(np.asarray(by_visual)[inner], np.asarray(weights / weights.size)[inner], rtol=1e-4)
    assert float(jnp.abs(by_light)) > 0
