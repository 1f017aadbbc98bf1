"""Images at any light between the two streams, against a loop in NumPy float64."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sts_jax as sts

expose = jax.jit(sts.expose)
SENSOR = sts.Sensor()


def with_exposure(value):
    return dataclasses.replace(SENSOR, room=dataclasses.replace(SENSOR.room, exposure=value))


def noise(shape, seed=0):
    """A frame of random images with black and white pixels."""
    rng = np.random.default_rng(seed)
    images = rng.uniform(size=(2, *shape, 3)).astype(np.float32)
    images[rng.uniform(size=images.shape) < 0.05] = 0
    images[rng.uniform(size=images.shape) < 0.05] = 1
    visual, tactile = map(jnp.asarray, images)
    lead = shape[:-2]
    return sts.Frame(
        visual=visual,
        tactile=tactile,
        depth=jnp.zeros(shape),
        segmentation=jnp.zeros(shape, bool),
        pose=jnp.zeros((*lead, 7)),
        balanced=jnp.ones(lead, bool),
        pressure=jnp.zeros((*lead, 3, 3)),
        window=jnp.zeros((*lead, 4)),
    )


def decode(s):
    return s / 12.92 if s <= 0.04045 else ((s + 0.055) / 1.055) ** 2.4


def encode(x):
    return 12.92 * x if x <= 0.0031308 else 1.055 * x ** (1 / 2.4) - 0.055


@pytest.mark.parametrize("exposure", [1.0, 6.0])
def test_light_0_and_1_return_the_streams_exactly(exposure):
    frame, sensor = noise((97, 53)), with_exposure(exposure)
    for call in (expose, sts.expose):
        assert np.array_equal(call(sensor, frame, 0.0), frame.visual)
        assert np.array_equal(call(sensor, frame, 1.0), frame.tactile)


@pytest.mark.parametrize("exposure", [1.0, 6.0])
def test_light_is_added_in_linear_units(exposure):
    shape = (97, 53)
    frame = noise(shape)
    rng = np.random.default_rng(1)
    for light in (1e-3, 0.2, 0.5, 0.9):
        image = np.asarray(expose(with_exposure(exposure), frame, light))
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

    def loss(light, exposure, visual):
        shown = sts.expose(with_exposure(exposure), dataclasses.replace(frame, visual=visual), light)
        return jnp.mean(weights * shown)

    value = jax.jit(loss)
    gradient = jax.jit(jax.grad(loss, argnums=(0, 1, 2)))
    for light in (0.0, 0.3, 1.0):
        for leaf in gradient(light, 4.0, frame.visual):
            assert np.all(np.isfinite(leaf))
    by_light, by_exposure, by_visual = gradient(0.3, 4.0, frame.visual)
    step = 0.01
    assert float(by_light) == pytest.approx(
        float(value(0.3 + step, 4.0, frame.visual) - value(0.3 - step, 4.0, frame.visual)) / (2 * step), rel=0.01
    )
    assert float(by_exposure) == pytest.approx(
        float(value(0.3, 4.1, frame.visual) - value(0.3, 3.9, frame.visual)) / 0.2, rel=0.01
    )
    inner = (frame.visual > 0.1) & (frame.visual < 0.9)
    along = jnp.where(inner, weights, 0)
    there, back = value(0.3, 4.0, frame.visual + 0.01 * along), value(0.3, 4.0, frame.visual - 0.01 * along)
    assert float(jnp.sum(by_visual * along)) == pytest.approx(float(there - back) / 0.02, rel=0.01)
    # At 0 and 1 the image is the stream itself, so its derivative is 1.
    at_end = gradient(0.0, 4.0, frame.visual)[2]
    np.testing.assert_allclose(np.asarray(at_end)[inner], np.asarray(weights / weights.size)[inner], rtol=1e-4)
    assert float(jnp.abs(gradient(0.0, 4.0, frame.visual)[0])) > 0


def test_vmap_over_frames_and_over_lights():
    frames, lights = noise((3, 64, 64)), jnp.array([0.0, 0.4, 1.0])
    both = jax.vmap(lambda frame, light: sts.expose(SENSOR, frame, light))(frames, lights)
    for k in range(3):
        one = jax.tree.map(lambda leaf, k=k: leaf[k], frames)
        np.testing.assert_allclose(both[k], expose(SENSOR, one, lights[k]), atol=1e-6)
    assert np.array_equal(both[0], frames.visual[0])
    assert np.array_equal(both[2], frames.tactile[2])
    np.testing.assert_allclose(sts.expose(SENSOR, frames, 0.4)[1], both[1], atol=1e-6)  # leading axes


def test_a_traced_light_is_clipped_and_never_gives_nan():
    frame = noise((64, 64))
    for light, stream in ((-0.5, frame.visual), (np.nan, frame.visual), (1.5, frame.tactile), (np.inf, frame.tactile)):
        assert np.array_equal(expose(SENSOR, frame, light), stream)
