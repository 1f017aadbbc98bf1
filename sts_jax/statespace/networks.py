"""Encoders, transition and decoder of the state-space model as Flax NNX modules.

- An encoder for each kind of image (visual and tactile) returns a Gaussian over the state code and the appearance code,
  which the program calls `look`. The belief is the product of the prior and the Gaussians of all inputs (`fuse`).
- The transition maps the belief about the state code and the condition to a density of the final pose and of the
  rotation from the first to the final pose. In a one-step model (`Config.stride`), it also receives the velocity, and
  returns a density of the motion over the next step.
- The decoder renders both images of an object in a given pose, from the latent and the rotation since the first frame.
  `compose` adds the images of the empty sensor.

All convolutions have stride 1, for which XLA's CPU backend is fast. To reduce an image, blocks of pixels are folded
into channels. To enlarge an image, channels are unfolded into blocks of pixels.
"""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from sts_jax import objects
from sts_jax._checked import in_32_bits
from sts_jax.mvae import Gaussian, product_of_experts
from sts_jax.statespace import blocks, harmonics, imprints, poses, state, window
from sts_jax.statespace.config import IMAGES, TINT, Config

UNKNOWN_LOG_VAR = 30.0  # log variance of numbers that an input does not determine: their precision is almost 0
EXACT_LOG_VAR = -9.2  # log variance of a pose that is an input: 0.5 mm for a position scale of 50 mm
CONTRAST = 40.0  # contrast of samples without a calibration, see `compose`
_LOG_VAR_LIMIT = 8.0  # largest absolute value of an encoder's log variances
_FINAL_LOG_VAR = (-3.0, 5.0)  # range of the log variances of the final pose: its centre and half of its width
_STEP_LOG_VAR = (-5.0, 4.2)  # the same for the motion over one step: standard deviations from 0.5 mm to 30 mm
_REST_LOG_VAR = -13.8  # log variance of the motion of a resting object: 0.05 mm
_STEP = 0.3  # unit of the correction of a constant velocity, in numbers of a motion
_BELOW = -0.02  # m, an object whose lowest point is deeper does not land on the pad
_SLACK = 0.002  # m, largest mean depth of the lowest point after a step, more than the error of a support function
_SLOW = 20.0  # factor of the velocity in a further, saturated input, which separates slow from resting objects
_OUTSIDE = 8.0  # difference of the logit of being covered by the object, between inside and outside of the canvas
# The tint describes the mean colour of the object in the visual image. For each colour channel, it is the mean change
# from the empty sensor over the pixels that show the object, minus _MIDDLE, divided by _WIDTH. The tint has
# `TINT` numbers.
_MIDDLE, _WIDTH = -0.3, 0.12
_TINT_LOG_VAR = -6.0  # log variance of a tint that was measured in an image
_BRIGHT = 0.7  # approximate brightness of the empty sensor


class FinalPose(NamedTuple):
    """The predicted density of the final pose of n objects: for each outcome, a mixture of k Gaussians over 21 numbers.

    The first 12 numbers are the final pose code. The other 9 are the matrix of the rotation from the first to the final
    pose, row by row. In a one-step model, the 6 numbers of a motion (`poses`) take the place of the 21. All refer to a
    frame with the origin and the z axis of the sensor frame, and an x axis along `heading`.
    """

    outcome: Float[Array, "n outcomes"]  # log probability of each outcome
    weight: Float[Array, "n outcomes k"]  # log weight of each component of an outcome
    mean: Float[Array, "n outcomes k m"]  # mean of each component
    log_var: Float[Array, "n outcomes k m"]  # log variances of each component
    heading: Float[Array, "n 2"]  # cosine and sine of the angle from the sensor's x axis, see `state.heading`


class Layers(NamedTuple):
    """Outlines and colours of n rendered objects, and the changes that the objects cause in the tactile images."""

    covered: Float[Array, "n size size 1"]  # logit of the probability that a pixel shows the object
    colour: Float[Array, "n size size 3"]  # colour of the object, [0, 1]
    touch: Float[Array, "n size size 3"]  # change of the logits of the tactile image, where it shows an imprint
    # Logit of the probability that a pixel of the tactile image shows an imprint. None: it is 1
    pressed: Float[Array, "n size size 1"] | None = None
    mass: Float[Array, "n 1"] | None = None  # as in a state code, for imprints


def compose(
    layers: Layers,
    empty: dict[str, Float[Array, "size size 3"]],
    level: Float[Array, "n"] | None = None,
    contrast: float | Float[Array, "n"] = CONTRAST,
    decoder: "Decoder | None" = None,
    noise: Float[Array, "n noise"] | None = None,
) -> dict[str, Float[Array, "n size size 3"]]:
    """Combine the rendered objects with the images of the empty sensor, of the same size.

    Let p be the probability that the object covers a pixel. The weight of the object's colour is p, or with thresholds
    `sigmoid(contrast * (logit(p) - logit(level)))`, which gives sharp outlines. If the threshold is drawn uniformly, a
    pixel shows the object with the probability p. An imprint in the tactile image has an outline in the same way.

    Args:
        layers: From the decoder.
        empty: `visual` and `tactile` image of the empty sensor in [0, 1].
        level: Threshold for each object, from 0 to 1, or None.
        contrast: Sharpness of the outlines if there is a threshold.
        decoder: The decoder of the layers, for tactile images whose imprints it draws (`Decoder.imprint`).
        noise: Random numbers for each object from which an imprint is drawn, or None for the mean imprint.

    Returns:
        The images `visual` and `tactile` of each object, in [0, 1].
    """

    def outlined(logit: Float[Array, "n size size 1"]) -> Float[Array, "n size size 1"]:
        if level is None:
            return jax.nn.sigmoid(logit)
        limit = jnp.clip(level, 0.01, 0.99).reshape(-1, 1, 1, 1)
        return jax.nn.sigmoid(jnp.reshape(contrast, (-1, 1, 1, 1)) * (logit - jnp.log(limit / (1 - limit))))

    covered = outlined(layers.covered)
    pressed, touch = None if layers.pressed is None else outlined(layers.pressed), layers.touch
    if pressed is not None and decoder is not None:
        pressed, touch = decoder.imprint(layers, pressed, noise)
    return {
        "visual": covered * layers.colour + (1 - covered) * empty["visual"],
        "tactile": imprinted(touch, pressed, empty["tactile"]),
    }


def imprinted(
    touch: Float[Array, "n size size 3"],
    pressed: Float[Array, "n size size 1"] | None,
    empty: Float[Array, "size size 3"],
) -> Float[Array, "n size size 3"]:
    """Tactile images in [0, 1]: the changes `touch` of the logits, where the weights `pressed` show an imprint."""
    grey = jnp.clip(empty, 0.01, 0.99)
    image = jax.nn.sigmoid(jnp.log(grey / (1 - grey)) + touch)
    return image if pressed is None else pressed * image + (1 - pressed) * empty


def parts(config: Config, look: Float[Array, "n look"]) -> tuple[Array, Array, Array]:
    """Split appearance codes into traits and coefficients of functions on the unit sphere.

    Returns:
        Traits, which do not depend on the object's rotation, `(n, traits)`. Coefficients of the functions of directions
        in the mesh frame, `(n, own, k)`, and in the sensor frame, `(n, shown, k)`.
    """
    count = harmonics.number(config.degree)
    traits, own, shown = jnp.split(look, [config.traits, config.traits + config.own * count], axis=-1)
    return traits, own.reshape(len(look), -1, count), shown.reshape(len(look), -1, count)


def _shape(
    config: Config, known: state.State, own_turn: Float[Array, "n 3 3"], shown_turn: Float[Array, "n 3 3"]
) -> list[Array]:
    """Values of the support functions in both frames at fixed directions, after one rotation each."""
    directions = objects.lattice(config.support)
    return [
        harmonics.values(known.support[:, None], own_turn, directions),
        harmonics.values(known.support_in_sensor[:, None], shown_turn, directions),
    ]


def _joined(*features: Float[Array, "n ..."]) -> Float[Array, "n k"]:
    """Flatten and concatenate the features of each item."""
    return jnp.concatenate([x.reshape(len(x), -1) for x in features], axis=-1)


class Encoder(nnx.Module):
    """Estimates the state code and the appearance code from a visual or from a tactile image.

    In a visual image, the tint is measured from the pixels. A tactile image does not determine it.
    """

    def __init__(self, config: Config, name: str, rngs: nnx.Rngs) -> None:
        self.config = config
        self.name = name
        half, quarter, eighth = config.encoder
        self.first = nnx.Conv(12, half, (3, 3), conv_general_dilated=blocks.conv, rngs=rngs)
        self.halves = nnx.List([blocks.Residual(half, rngs) for _ in range(2)])
        self.to_quarter = nnx.Linear(4 * half, quarter, rngs=rngs)
        self.quarters = nnx.List([blocks.Residual(quarter, rngs) for _ in range(2)])
        self.to_eighth = nnx.Linear(4 * quarter, eighth, rngs=rngs)
        self.eighth = blocks.Residual(eighth, rngs)
        self.place = nnx.Linear(7, 64, rngs=rngs)
        self.dense = nnx.Linear((config.window // 8) ** 2 * eighth + 64, config.hidden, rngs=rngs)
        self.residual = blocks.ResidualDense(config.hidden, rngs)
        self.norm = nnx.LayerNorm(config.hidden, rngs=rngs)
        self.last = nnx.Linear(config.hidden, 2 * (state.CODE + config.look), kernel_init=blocks.SMALL, rngs=rngs)

    def __call__(self, change: Float[Array, "n size size 3"]) -> Gaussian:
        """Estimate the codes of each image: a Gaussian `(n, code + look)`.

        Args:
            change: Images minus the image of the empty sensor, both in [0, 1].
        """
        config = self.config
        place = window.locate(jax.lax.stop_gradient(change))
        x = self.first(blocks.fold(3 * window.cut(change, place, config.window)))
        for layer in self.halves:
            x = layer(x)
        x = self.to_quarter(blocks.fold(x))
        for layer in self.quarters:
            x = layer(x)
        x = jax.nn.swish(self.eighth(self.to_eighth(blocks.fold(x))))
        # The network works in the coordinate frame of the silhouette. The estimate is rotated into the sensor frame.
        centre = poses.turn_back(place.angle, (place.centre - 0.5) * config.view / config.position_scale)
        side = place.side[:, None]
        features = jnp.concatenate([centre, 0.25 * centre / side, jnp.log(side), place.angle], axis=-1)
        x = jnp.concatenate([x.reshape(len(x), -1), jax.nn.swish(self.place(features))], axis=-1)
        x = self.last(jax.nn.swish(self.norm(self.residual(self.dense(x)))))
        mean, log_var = jnp.split(x, 2, axis=-1)
        log_var = _LOG_VAR_LIMIT * jnp.tanh(log_var / _LOG_VAR_LIMIT)
        mean = mean.at[:, :2].add(centre)  # an object is near its silhouette
        variance = jnp.exp(log_var)
        traits, own, shown = parts(config, mean[:, state.CODE :])
        blur = parts(config, variance[:, state.CODE :])
        tint, doubt_of_tint = self._tint(change)
        traits = traits.at[:, :TINT].set(tint)
        blur = (blur[0].at[:, :TINT].set(jnp.exp(doubt_of_tint)), *blur[1:])
        turned = state.turn(place.angle, state.split(mean[:, : state.CODE]))
        doubt = state.turn_variance(place.angle, state.split(variance[:, : state.CODE]))
        return Gaussian(
            _joined(*turned, traits, own, harmonics.turn(place.angle, shown)),
            jnp.log(_joined(*doubt, *blur[:2], harmonics.turn_variance(place.angle, blur[2]))),
        )

    def _tint(self, change: Float[Array, "n size size 3"]) -> tuple[Float[Array, "n 3"], float]:
        """The tint of the object in each image, and its log variance."""
        if self.name == "tactile":
            return jnp.zeros((len(change), TINT)), UNKNOWN_LOG_VAR
        seen = window.shows(change)[..., None]
        mean = jnp.sum(seen * change, axis=(1, 2)) / jnp.maximum(jnp.sum(seen, axis=(1, 2)), 1)
        return (mean - _MIDDLE) / _WIDTH, _TINT_LOG_VAR


class Transition(nnx.Module):
    """Predicts the density of the final pose from the state in the first frame, or that of a step from any state.

    The mean of a step is the velocity plus a learnt correction, as if inertia alone moved the object. While its centre
    of mass is above the pad, its lowest point does not sink. The last component of the mixture stands for objects at
    rest, and only its weight is learnt. Most steps are those of resting objects, and components that learnt their tiny
    variance would dominate the gradient.

    The appearance code is not an input. Otherwise, the transition would recognise training objects by their appearance
    (see docs/trials.md).
    """

    def __init__(self, config: Config, rngs: nnx.Rngs) -> None:
        self.config = config
        number = 2 * poses.CODE + 7 + 5 + 2 * config.support + 4 + 2 * config.condition
        number += 2 * poses.MOTION + 1 if config.stride else 0
        self.size = poses.MOTION if config.stride else poses.MOVE
        self.first = nnx.Linear(number, config.transition, rngs=rngs)
        self.layers = nnx.List([blocks.ResidualDense(config.transition, rngs) for _ in range(3)])
        self.norm = nnx.LayerNorm(config.transition, rngs=rngs)
        self.outcome = nnx.Linear(config.transition, config.outcomes, kernel_init=blocks.SMALL, rngs=rngs)
        components = config.outcomes * config.components * (1 + 2 * self.size)
        self.mixture = nnx.Linear(config.transition, components, kernel_init=blocks.SMALL, rngs=rngs)

    def __call__(
        self, belief: Gaussian, condition: Float[Array, "n c"] | None, velocity: Float[Array, "n 6"] | None = None
    ) -> FinalPose:
        """Predict the density of the final pose or of a step, in a frame whose x axis is the heading of the mean state.

        Args:
            belief: Belief about the state code, `(n, code)`.
            condition: From `training.Preprocessing.encode_condition`, or None.
            velocity: The motion over the last step, for a one-step model.
        """
        config = self.config
        known = state.split(belief.mean)
        doubt = jnp.clip(belief.log_var, -_LOG_VAR_LIMIT, 2) / 4
        heading = state.heading(known)
        here = poses.turn_code_back(heading, known.pose)
        level = jnp.swapaxes(poses.about_vertical(heading), -1, -2)
        features = [
            here,
            *_shape(config, known, poses.matrix(here), level),
            jnp.einsum("nij,nj->ni", poses.matrix(here), known.com),
            jnp.einsum("nij,nj->ni", level, known.com_in_sensor),
            known.mass,
            state.split(doubt).pose,
            *(jnp.mean(part, axis=-1, keepdims=True) for part in state.split(doubt)[1:]),
            heading,
            known.pose[:, :2],
        ]
        if condition is not None:
            pairs = [condition[:, 2 * k : 2 * k + 2] for k in range(config.vectors)]
            features += [condition, *(poses.turn_back(heading, pair) for pair in pairs), condition[:, 2 * len(pairs) :]]
        still = jnp.broadcast_to(jnp.eye(3), (len(here), 3, 3))
        likely, unit, (middle, reach) = _joined(here, still), 1.0, _FINAL_LOG_VAR
        if velocity is not None:
            likely, unit, (middle, reach) = poses.turn_motion_back(heading, velocity), _STEP, _STEP_LOG_VAR
            gap = config.position_scale * known.pose[:, 2] - state.reach(known, still)
            features += [likely, jnp.tanh(_SLOW * likely), gap[:, None] / state.LENGTH]
        x = self.first(_joined(*features))
        for layer in self.layers:
            x = layer(x)
        x = jax.nn.swish(self.norm(x))
        mixture = self.mixture(x).reshape(len(x), config.outcomes, config.components, -1)
        mean = likely[:, None, None] + unit * mixture[..., 1 : 1 + self.size]
        log_var = middle + reach * jnp.tanh(mixture[..., 1 + self.size :] / reach)
        if velocity is not None:
            place = config.position_scale * known.pose[:, :2] + state.LENGTH * known.com_in_sensor[:, :2]
            lands = jnp.all(jnp.abs(place) < config.view / 2, axis=-1) & (gap > _BELOW)
            lowest = jnp.where(lands, -(gap + _SLACK) / config.position_scale, -jnp.inf)
            mean = mean.at[..., 2].set(jnp.maximum(mean[..., 2], lowest[:, None, None]))
            mean, log_var = mean.at[..., -1, :].set(0), log_var.at[..., -1, :].set(_REST_LOG_VAR)
        return FinalPose(
            outcome=jax.nn.log_softmax(self.outcome(x)),
            weight=jax.nn.log_softmax(mixture[..., 0]),
            mean=mean,
            log_var=log_var,
            heading=heading,
        )


class Decoder(nnx.Module):
    """Renders an object in a given pose, from its shape and its appearance code.

    The network renders the object on a canvas: a square that is parallel to the pad and aligned with the object's
    heading. Its centre is below the mesh origin, at the height of the object's lowest point, because the camera sees
    the object from below. The canvas is then projected into the view of the camera.
    """

    def __init__(self, config: Config, rngs: nnx.Rngs) -> None:
        self.config = config
        eighth, quarter, half = config.decoder
        shapes = 2 * config.support + (config.own + config.shown) * config.directions
        self.first = nnx.Linear(poses.CODE + 4 + config.traits + shapes, 512, rngs=rngs)
        self.residual = blocks.ResidualDense(512, rngs)
        self.core = nnx.Linear(512, (config.canvas // 8) ** 2 * (eighth // 2), rngs=rngs)
        self.widen = nnx.Linear(eighth // 2, eighth, rngs=rngs)
        self.layers = nnx.List([blocks.Residual(width, rngs) for width in (eighth, quarter, half)])
        self.enlarge = nnx.List([nnx.Linear(a, 4 * b, rngs=rngs) for a, b in ((eighth, quarter), (quarter, half))])
        self.last = nnx.Conv(half, 4 * 8, (3, 3), kernel_init=blocks.SMALL, conv_general_dilated=blocks.conv, rngs=rngs)
        features = imprints.FEATURES if config.outlines else 0
        self.shading = imprints.Shading(config.shading, features, rngs) if config.shading else None
        self.outlines = imprints.Outlines(config.outlines, rngs) if config.outlines else None

    def __call__(
        self,
        pose: Float[Array, "n 12"],
        turn: Float[Array, "n 3 3"],
        known: Float[Array, "n code"],
        look: Float[Array, "n look"],
    ) -> Layers:
        """Render each object.

        Args:
            pose: Pose codes of the frame to render.
            turn: Rotation matrices from the first frame to the frame to render.
            known: State codes of the first frame. Only the shapes are used.
            look: Appearance codes of the first frame.
        """
        config = self.config
        heading = poses.heading(pose)
        here = poses.turn_code_back(heading, pose)
        level = jnp.swapaxes(poses.about_vertical(heading), -1, -2)
        shape = state.split(known)
        turns = (poses.matrix(here), level @ turn)
        traits, own, shown = parts(config, look)
        directions = objects.lattice(config.directions)
        seen = harmonics.values(own, turns[0], directions), harmonics.values(shown, turns[1], directions)
        x = _joined(here, heading, pose[:, :2], traits, *seen, *_shape(config, shape, *turns))
        x = self.core(jax.nn.swish(self.residual(self.first(x))))
        x = self.widen(x.reshape(len(x), config.canvas // 8, config.canvas // 8, -1))
        for layer, enlarge in zip(self.layers, self.enlarge, strict=False):
            x = blocks.unfold(enlarge(layer(x)))
        x = blocks.unfold(self.last(jax.nn.swish(self.layers[-1](x)))).at[..., 3::4].add(_OUTSIDE)
        depth = config.camera_distance + jnp.maximum(pose[:, 2] * config.position_scale - state.reach(shape, turn), 0)
        x = window.sample(x, _on_canvas(config, pose, heading, depth))
        x = x.reshape(len(x), config.image_size, config.image_size, -1)
        # An untrained decoder renders an object in its mean colour in the input image, and covers hardly any pixel.
        tint = jnp.clip(_BRIGHT + _MIDDLE + _WIDTH * look[:, None, None, :TINT], 0.03, 0.97)
        colour = jax.nn.sigmoid(x[..., :3] + jnp.log(tint / (1 - tint)))
        covered, pressed = (x[..., i : i + 1] - _OUTSIDE - 3 for i in (3, 7))
        return Layers(covered, colour, x[..., 4:7], pressed if config.imprints else None, shape.mass)

    def imprint(
        self, layers: Layers, pressed: Float[Array, "n size size 1"], noise: Float[Array, "n noise"] | None = None
    ) -> tuple[Float[Array, "n size size 1"], Float[Array, "n size size 3"]]:
        """The weights of the imprints and the changes of the logits of the tactile images.

        With `Config.outlines`, they are drawn from `noise`, or the means if it is None. Without, the changes follow the
        outlines `pressed`.
        """
        touch = layers.touch
        if self.shading is None:
            return pressed, touch
        if self.outlines is None:
            return pressed, touch + self.shading(pressed, touch)
        if noise is None or layers.pressed is None or layers.mass is None:
            return pressed, touch
        pressed, features, depth = self.outlines(layers.pressed, touch, layers.mass, noise)
        return pressed, depth[:, None, None, None] * (touch + self.shading(pressed, touch, features))


def _on_canvas(
    config: Config, pose: Float[Array, "n 12"], heading: Float[Array, "n 2"], depth: Float[Array, "n"]
) -> Float[Array, "n m 2"]:
    """Column and row on the canvas that each of m pixels of the view shows. Whole numbers are pixel centres."""
    position = pose[:, :2] * config.position_scale
    shrunk = (config.camera_distance / depth)[:, None]
    place = ((jnp.arange(config.image_size) + 0.5) / config.image_size - 0.5) * config.view
    pixels = jnp.stack(jnp.meshgrid(place, place), axis=-1).reshape(1, -1, 2)
    apart = (pixels - (position * shrunk)[:, None]) / (shrunk * config.canvas_side)[:, None]
    return (poses.turn_back(heading[:, None], apart) + 0.5) * config.canvas - 0.5


class Model(nnx.Module):
    """The networks of a state-space model."""

    def __init__(self, config: Config, rngs: nnx.Rngs) -> None:
        self.config = config
        self.encoders = nnx.Dict({name: Encoder(config, name, rngs) for name in config.inputs if name in IMAGES})
        self.transition = Transition(config, rngs)
        self.decoder = Decoder(config, rngs)


@in_32_bits
@functools.partial(jax.jit, static_argnames="config")
def init(key: PRNGKeyArray, config: Config) -> tuple[nnx.GraphDef[Model], nnx.State, nnx.State]:
    """Create a model with random parameters: its definition, its parameters, and an empty state of batch statistics."""
    return nnx.split(Model(config, nnx.Rngs(key)), nnx.Param, ...)


def experts(
    model: Model,
    inputs: dict[str, Array],
    counts: dict[str, Bool[Array, "n"]],
    empty: dict[str, Float[Array, "size size 3"]],
) -> dict[str, Gaussian]:
    """The expert of each input alone, `(n, code + look)`, by name of the input.

    Args:
        inputs: Images `visual` and `tactile` `(n, size, size, 3)` in [0, 1], pose codes `pose` `(n, 12)` and, if they
            are known, state codes `state` `(n, code)`.
        counts: A mask for each name in `inputs`. Values of items whose mask is False have no influence and may be NaN.
        empty: `visual` and `tactile` image of the empty sensor in [0, 1], of the same size as the inputs.
    """
    # Masked items are set to zero before the networks, because 0 * NaN would make the product and its gradient NaN.
    change = {name: counted(counts[name], inputs[name] - empty[name]) for name in IMAGES if name in inputs}
    estimates = {name: model.encoders[name](x) for name, x in change.items()}
    for name in ("pose", "state"):
        if name in inputs:
            code = counted(counts[name], inputs[name])
            nothing = jnp.zeros((len(code), state.CODE - code.shape[1] + model.config.look))
            log_var = [jnp.full_like(code, EXACT_LOG_VAR), nothing + UNKNOWN_LOG_VAR]
            estimates[name] = Gaussian(jnp.concatenate([code, nothing], axis=-1), jnp.concatenate(log_var, axis=-1))
    return estimates


def fuse(estimates: dict[str, Gaussian], counts: dict[str, Bool[Array, "n"]]) -> Gaussian:
    """The belief of each item: the normalised product of the prior and the experts that count."""
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *estimates.values())
    return product_of_experts(stacked, jnp.stack([counts[name] for name in estimates]))


def of_state(belief: Gaussian) -> Gaussian:
    """Marginal of the belief over the state code."""
    return Gaussian(belief.mean[:, : state.CODE], belief.log_var[:, : state.CODE])


def moved(belief: Gaussian, position: Float[Array, "n 3"], rotation: Float[Array, "n 3 3"]) -> Gaussian:
    """Belief about the state code after a known rotation in the sensor frame, with a known new position code."""
    mean = state.moved(state.split(belief.mean), position, rotation)
    variance = state.moved_variance(state.split(jnp.exp(belief.log_var)), math.exp(EXACT_LOG_VAR), rotation)
    return Gaussian(state.join(mean), jnp.log(state.join(variance)))


def counted(counts: Bool[Array, "n"], values: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """Set the values of masked items to zero."""
    return jnp.where(counts.reshape(-1, *(1,) * (values.ndim - 1)), values, 0)


def reduced(images: Float[Array, "*n h w c"], size: int) -> Float[Array, "*n size size c"]:
    """Reduce images to `size` x `size` pixels by averaging over blocks. `size` must divide their height and width."""
    *lead, height, width, channels = images.shape
    blocks = images.reshape(*lead, size, height // size, size, width // size, channels)
    return jnp.mean(blocks, axis=(-4, -2))
