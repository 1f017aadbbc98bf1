"""Encoders, transition and decoder as Flax NNX modules.

The latent is the present state. It consists of a state code with the pose, the shape and the mass (`statespace.state`),
and of a look, which describes all other visible or tactile properties of an object. An encoder for each image returns a
Gaussian over both. The transition maps a belief about the present state to a density of the final pose and of the
rotation to it. The decoder draws both streams of an object in a pose, given this rotation and the present state.

Convolutions have stride 1, for which XLA's CPU backend is fast. Pixels are folded into channels to make an image
smaller, and channels are unfolded into pixels to make it larger.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float, PRNGKeyArray

from sts_jax import objects
from sts_jax.mvae import Gaussian
from sts_jax.statespace import harmonics, poses, state, window

IMAGES = ("visual", "tactile")
INPUTS = (*IMAGES, "pose")
UNKNOWN_LOG_VAR = 30.0  # of numbers that an input does not determine, whose precision is almost 0
_LOG_VAR_LIMIT = 8.0  # largest absolute value for an encoder
_FINAL_LOG_VAR = (-3.0, 5.0)  # of a component of the final pose: middle, largest distance from it
_CONTRAST = 10.0  # factor of the outline's logits in a sample
_OUTSIDE = 8.0  # decrease of the logit of being covered outside of the canvas
# The tint is the mean change of the pixels that show the object, less _MIDDLE, divided by _WIDTH.
TINT = 3  # numbers of the tint
_MIDDLE, _WIDTH = -0.3, 0.12
_TINT_LOG_VAR = -6.0  # of the tint in an image
_BRIGHT = 0.7  # approximate brightness of the empty sensor
_SMALL = nnx.initializers.variance_scaling(0.1, "fan_in", "normal")  # of last layers


@dataclasses.dataclass(frozen=True)
class Config:
    """The size, view and loss weights of a model. All values are plain, so that `dataclasses.asdict` returns JSON.

    Raises:
        ValueError: A field is out of range, or two fields contradict each other.
    """

    inputs: tuple[str, ...] = ("visual", "pose")  # some of INPUTS
    outcomes: int = 2  # number of outcomes of the scenario
    condition: int = 0  # numbers in the scenario's condition
    input_size: int = 128  # pixels, side of the input images
    image_size: int = 64  # pixels, side of the predicted images
    camera_distance: float = 0.1  # m, from the pinhole to the gel's outer face
    view: float = 0.15  # m, side of the visible square of the gel's face
    position_scale: float = 0.05  # m, see `training.Preprocessing`
    traits: int = 32  # numbers of the look that do not turn with the object, the tint first
    own: int = 4  # functions on the sphere in the look, in the object's frame
    shown: int = 4  # functions on the sphere in the look, in the sensor's frame at present
    degree: int = 3  # of the harmonics of these functions
    directions: int = 24  # directions in which the values of these functions are features
    support: int = 64  # directions in which the values of the support function are features
    components: int = 6  # Gaussians of the final pose for each outcome
    window: int = 32  # pixels, side of the magnified part of an image
    encoder: tuple[int, ...] = (64, 128, 128)  # channels at 1/2, 1/4 and 1/8 of the window
    decoder: tuple[int, ...] = (128, 64, 32)  # channels at 1/8, 1/4 and 1/2 of the canvas
    hidden: int = 384  # width of the encoders' fully connected layers
    transition: int = 512  # width of the transition's layers
    canvas: int = 64  # pixels, side of the picture of an object before it is placed in the view
    canvas_side: float = 0.165  # m, side of this picture on the gel's face
    tactile_weight: float = 4.0  # of the tactile image's nats in the loss
    state_weight: float = 16.0  # of the squared error of the first state, for the expert of each image
    pose_weight: float = 4.0  # of the nats of the final pose, and of the experts' variances
    outcome_weight: float = 8.0  # of the outcome's nats
    covered_weight: float = 0.15  # of the nats of the object's outline
    first_weight: float = 0.5  # of the nats of the first moment's images
    look_weight: float = 0.1  # of the divergence of the look. Samples are sharper for weights below 1
    drawn: float = 0.4375  # share of a batch whose last moment is drawn (the whole batch trains the other parts)
    drawn_first: float = 0.125  # share of a batch whose first moment is drawn
    vectors: int = 1  # vectors (x, y) in the plane of the pad at the begin of the condition, if there is one

    def __post_init__(self) -> None:
        if not self.inputs or [name for name in INPUTS if name in self.inputs] != list(self.inputs):
            raise ValueError(f"inputs is {self.inputs}, but it must be at least one of {INPUTS}, in this order")
        if not set(self.inputs) & set(IMAGES):
            raise ValueError(f"inputs is {self.inputs}, but the look needs an image: add 'visual' or 'tactile'")
        for name, part in (("window", 8), ("canvas", 8), ("input_size", self.image_size)):
            if getattr(self, name) % part or getattr(self, name) < part:
                raise ValueError(f"{name} is {getattr(self, name)} pixels, but it must be a multiple of {part}")
        if len(self.encoder) != 3 or len(self.decoder) != 3:
            raise ValueError(f"encoder and decoder need 3 widths each, got {len(self.encoder)} and {len(self.decoder)}")
        if self.condition < 0 or (self.condition and not 0 <= 2 * self.vectors <= self.condition):
            raise ValueError(
                f"condition is {self.condition} numbers and vectors is {self.vectors}, but a condition must be 0, or "
                "hold the 2 numbers of each vector"
            )
        if self.traits < TINT:
            raise ValueError(f"traits is {self.traits}, but it must be at least {TINT}, the numbers of the tint")
        for name in ("drawn", "drawn_first"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}, but a share must be above 0 and at most 1")

    @property
    def look(self) -> int:
        """Numbers that describe the look."""
        return self.traits + (self.own + self.shown) * harmonics.number(self.degree)

    def to_json(self) -> dict[str, Any]:
        """Plain dictionaries and lists. `vectors` is left out where it is 1, as older models do not have it."""
        values = dataclasses.asdict(self)
        return {name: value for name, value in values.items() if (name, value) != ("vectors", 1)}

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "Config":
        """The inverse of `to_json`, also after a trip through a JSON file."""
        plain: dict[str, Any] = {k: tuple(value) if isinstance(value, list) else value for k, value in values.items()}
        return cls(**plain)


class FinalPose(NamedTuple):
    """The density of the final pose: a mixture of Gaussians over code and rotation, in the frame of a heading."""

    outcome: Float[Array, "n outcomes"]  # log probability of each outcome
    weight: Float[Array, "n outcomes k"]  # log weight of each component of an outcome
    mean: Float[Array, "n outcomes k 21"]  # code of the pose, and the rotation from the present to the final pose
    log_var: Float[Array, "n outcomes k 21"]
    heading: Float[Array, "n 2"]  # of the frame, see `poses.heading`


class Layers(NamedTuple):
    """An object drawn in the view, to be composed with the images of the empty sensor."""

    covered: Float[Array, "n size size 1"]  # logit of the probability that a pixel shows the object
    colour: Float[Array, "n size size 3"]  # of the object, [0, 1]
    touch: Float[Array, "n size size 3"]  # change of the tactile image, in logits


class _Residual(nnx.Module):
    """`x + layer(swish(norm(x)))` with a 3x3 convolution."""

    def __init__(self, channels: int, rngs: nnx.Rngs) -> None:
        self.norm = nnx.LayerNorm(channels, rngs=rngs)
        self.layer = nnx.Conv(channels, channels, (3, 3), rngs=rngs)

    def __call__(self, x: Array) -> Array:
        return x + self.layer(jax.nn.swish(self.norm(x)))


class _ResidualDense(nnx.Module):
    """A residual block of two fully connected layers."""

    def __init__(self, width: int, rngs: nnx.Rngs) -> None:
        self.norm = nnx.LayerNorm(width, rngs=rngs)
        self.first = nnx.Linear(width, width, rngs=rngs)
        self.second = nnx.Linear(width, width, kernel_init=_SMALL, rngs=rngs)

    def __call__(self, x: Array) -> Array:
        return x + self.second(jax.nn.swish(self.first(jax.nn.swish(self.norm(x)))))


def parts(config: Config, look: Float[Array, "n look"]) -> tuple[Array, Array, Array]:
    """Traits (n, traits), functions in the object's frame (n, c, k) and in the sensor's frame (n, c, k) of looks."""
    count = harmonics.number(config.degree)
    traits, own, shown = jnp.split(look, [config.traits, config.traits + config.own * count], axis=-1)
    return traits, own.reshape(len(look), -1, count), shown.reshape(len(look), -1, count)


def _shape(
    config: Config, known: state.State, own_turn: Float[Array, "n 3 3"], shown_turn: Float[Array, "n 3 3"]
) -> list[Array]:
    """Values of both support functions of a state, `own` and `shown`."""
    directions = objects.lattice(config.support)
    return [
        harmonics.values(known.own[:, None], own_turn, directions),
        harmonics.values(known.shown[:, None], shown_turn, directions),
    ]


def _appearance(
    config: Config, look: Array, own_turn: Float[Array, "n 3 3"], shown_turn: Float[Array, "n 3 3"]
) -> list[Array]:
    """Traits of the look, and values of its functions in the object's frame and in the sensor's frame."""
    traits, own, shown = parts(config, look)
    directions = objects.lattice(config.directions)
    return [traits, harmonics.values(own, own_turn, directions), harmonics.values(shown, shown_turn, directions)]


def _joined(*features: Float[Array, "n ..."]) -> Float[Array, "n k"]:
    return jnp.concatenate([x.reshape(len(x), -1) for x in features], axis=-1)


def _fold(x: Float[Array, "n h w c"]) -> Float[Array, "n h//2 w//2 4*c"]:
    """Blocks of 2x2 pixels as channels."""
    n, h, w, c = x.shape
    return x.reshape(n, h // 2, 2, w // 2, 2, c).transpose(0, 1, 3, 2, 4, 5).reshape(n, h // 2, w // 2, 4 * c)


def _unfold(x: Float[Array, "n h w c"]) -> Float[Array, "n 2*h 2*w c//4"]:
    """The inverse of `_fold`."""
    n, h, w, c = x.shape
    return x.reshape(n, h, w, 2, 2, c // 4).transpose(0, 1, 3, 2, 4, 5).reshape(n, 2 * h, 2 * w, c // 4)


class Encoder(nnx.Module):
    """The expert of one stream: a Gaussian over state code and look for each image.

    The tint is computed from a visual image and unknown from a tactile one.
    """

    def __init__(self, config: Config, name: str, rngs: nnx.Rngs) -> None:
        self.config = config
        self.name = name
        half, quarter, eighth = config.encoder
        self.first = nnx.Conv(12, half, (3, 3), rngs=rngs)
        self.halves = nnx.List([_Residual(half, rngs) for _ in range(2)])
        self.to_quarter = nnx.Linear(4 * half, quarter, rngs=rngs)
        self.quarters = nnx.List([_Residual(quarter, rngs) for _ in range(2)])
        self.to_eighth = nnx.Linear(4 * quarter, eighth, rngs=rngs)
        self.eighth = _Residual(eighth, rngs)
        self.place = nnx.Linear(7, 64, rngs=rngs)
        self.dense = nnx.Linear((config.window // 8) ** 2 * eighth + 64, config.hidden, rngs=rngs)
        self.residual = _ResidualDense(config.hidden, rngs)
        self.norm = nnx.LayerNorm(config.hidden, rngs=rngs)
        self.last = nnx.Linear(config.hidden, 2 * (state.CODE + config.look), kernel_init=_SMALL, rngs=rngs)

    def __call__(self, change: Float[Array, "n size size 3"]) -> Gaussian:
        """The expert of each image.

        Args:
            change: Images less that of the empty sensor.

        Returns:
            A Gaussian over state code and look, `(n, code + look)`.
        """
        config = self.config
        place = window.locate(jax.lax.stop_gradient(change))
        x = self.first(_fold(3 * window.cut(change, place, config.window)))
        for layer in self.halves:
            x = layer(x)
        x = self.to_quarter(_fold(x))
        for layer in self.quarters:
            x = layer(x)
        x = jax.nn.swish(self.eighth(self.to_eighth(_fold(x))))
        # All numbers are estimated in the frame of the silhouette, and turned into the sensor's frame at the end.
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
        found = state.turn(place.angle, state.split(mean[:, : state.CODE]))
        doubt = state.turn_variance(place.angle, state.split(variance[:, : state.CODE]))
        return Gaussian(
            _joined(*found, traits, own, harmonics.turn(place.angle, shown)),
            jnp.log(_joined(*doubt, *blur[:2], harmonics.turn_variance(place.angle, blur[2]))),
        )

    def _tint(self, change: Float[Array, "n size size 3"]) -> tuple[Float[Array, "n 3"], float]:
        """The tint of each image, and the logarithm of its variance."""
        if self.name == "tactile":
            return jnp.zeros((len(change), TINT)), UNKNOWN_LOG_VAR
        seen = window.shows(change)[..., None]
        mean = jnp.sum(seen * change, axis=(1, 2)) / jnp.maximum(jnp.sum(seen, axis=(1, 2)), 1)
        return (mean - _MIDDLE) / _WIDTH, _TINT_LOG_VAR


class Transition(nnx.Module):
    """Maps a belief about the present state and the condition to the density of the final pose.

    The look is no input, because the transition would recognise training objects by it (see docs/trials.md).
    """

    def __init__(self, config: Config, rngs: nnx.Rngs) -> None:
        self.config = config
        number = 2 * poses.CODE + 7 + 5 + 2 * config.support + 4 + 2 * config.condition
        self.first = nnx.Linear(number, config.transition, rngs=rngs)
        self.layers = nnx.List([_ResidualDense(config.transition, rngs) for _ in range(3)])
        self.norm = nnx.LayerNorm(config.transition, rngs=rngs)
        self.outcome = nnx.Linear(config.transition, config.outcomes, kernel_init=_SMALL, rngs=rngs)
        components = config.outcomes * config.components * (1 + 2 * poses.MOVE)
        self.mixture = nnx.Linear(config.transition, components, kernel_init=_SMALL, rngs=rngs)

    def __call__(self, belief: Gaussian, condition: Float[Array, "n c"] | None) -> FinalPose:
        """The density of the final pose.

        Args:
            belief: Fused posterior over the state code, `(n, code)`.
            condition: Each number divided by its typical size, or None if the scenario has no condition.

        Returns:
            The density in the frame of the heading of the belief's mean.
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
            jnp.einsum("nij,nj->ni", level, known.low),
            known.mass,
            state.split(doubt).pose,
            *(jnp.mean(part, axis=-1, keepdims=True) for part in state.split(doubt)[1:]),
            heading,
            known.pose[:, :2],
        ]
        if condition is not None:
            pairs = [condition[:, 2 * k : 2 * k + 2] for k in range(config.vectors)]
            features += [condition, *(poses.turn_back(heading, pair) for pair in pairs), condition[:, 2 * len(pairs) :]]
        x = self.first(_joined(*features))
        for layer in self.layers:
            x = layer(x)
        x = jax.nn.swish(self.norm(x))
        mixture = self.mixture(x).reshape(len(x), config.outcomes, config.components, -1)
        middle, reach = _FINAL_LOG_VAR
        stays = jnp.broadcast_to(jnp.eye(3).reshape(9), (len(x), 9))
        return FinalPose(
            outcome=jax.nn.log_softmax(self.outcome(x)),
            weight=jax.nn.log_softmax(mixture[..., 0]),
            mean=_joined(here, stays)[:, None, None] + mixture[..., 1 : 1 + poses.MOVE],
            log_var=middle + reach * jnp.tanh(mixture[..., 1 + poses.MOVE :] / reach),
            heading=heading,
        )


class Decoder(nnx.Module):
    """Draws an object with a given state and look in a pose.

    A picture of the object is drawn on a canvas that follows its heading. The canvas is placed in the view under the
    object's origin, at the height of the object's lowest point, because the camera sees the object from below.
    `compose` adds the images of the empty sensor.
    """

    def __init__(self, config: Config, rngs: nnx.Rngs) -> None:
        self.config = config
        eighth, quarter, half = config.decoder
        shapes = 2 * config.support + (config.own + config.shown) * config.directions
        self.first = nnx.Linear(poses.CODE + 4 + config.traits + shapes, 512, rngs=rngs)
        self.residual = _ResidualDense(512, rngs)
        self.core = nnx.Linear(512, (config.canvas // 8) ** 2 * (eighth // 2), rngs=rngs)
        self.widen = nnx.Linear(eighth // 2, eighth, rngs=rngs)
        self.layers = nnx.List([_Residual(width, rngs) for width in (eighth, quarter, half)])
        self.enlarge = nnx.List([nnx.Linear(a, 4 * b, rngs=rngs) for a, b in ((eighth, quarter), (quarter, half))])
        self.last = nnx.Conv(half, 4 * 8, (3, 3), kernel_init=_SMALL, rngs=rngs)

    def __call__(
        self,
        pose: Float[Array, "n 12"],
        turn: Float[Array, "n 3 3"],
        known: Float[Array, "n code"],
        look: Float[Array, "n look"],
    ) -> Layers:
        """Draw each object.

        Args:
            pose: Pose codes.
            turn: Rotations since the present moment.
            known: Present state codes, which provide the shapes.
            look: Present looks.
        """
        config = self.config
        heading = poses.heading(pose)
        here = poses.turn_code_back(heading, pose)
        level = jnp.swapaxes(poses.about_vertical(heading), -1, -2)
        shape = state.split(known)
        turns = (poses.matrix(here), level @ turn)
        drawn = (*_appearance(config, look, *turns), *_shape(config, shape, *turns))
        x = _joined(here, heading, pose[:, :2], *drawn)
        x = self.core(jax.nn.swish(self.residual(self.first(x))))
        x = self.widen(x.reshape(len(x), config.canvas // 8, config.canvas // 8, -1))
        for layer, enlarge in zip(self.layers, self.enlarge, strict=False):
            x = _unfold(enlarge(layer(x)))
        x = _unfold(self.last(jax.nn.swish(self.layers[-1](x)))).at[..., 3].add(_OUTSIDE)
        depth = config.camera_distance + jnp.maximum(pose[:, 2] * config.position_scale - state.reach(shape, turn), 0)
        x = window.sample(x, _on_canvas(config, pose, heading, depth))
        x = x.reshape(len(x), config.image_size, config.image_size, -1)
        # Before training, an object has its present colour, and hardly any pixel is covered.
        tint = jnp.clip(_BRIGHT + _MIDDLE + _WIDTH * look[:, None, None, :TINT], 0.03, 0.97)
        colour = jax.nn.sigmoid(x[..., :3] + jnp.log(tint / (1 - tint)))
        return Layers(covered=x[..., 3:4] - _OUTSIDE - 3, colour=colour, touch=x[..., 4:7])


def compose(
    layers: Layers,
    empty: dict[str, Float[Array, "size size 3"]],
    level: Float[Array, "n"] | None = None,
) -> dict[str, Float[Array, "n size size 3"]]:
    """Both images of each object.

    Args:
        layers: The result of the decoder.
        empty: Both images of the untouched sensor, of the same size.
        level: A threshold from 0 to 1. Pixels whose probability of being covered is above it are covered, so that
            outlines are sharp. For uniformly drawn levels, each pixel is covered with its probability. None draws the
            mean image.

    Returns:
        `visual` and `tactile`, in [0, 1].
    """
    logit = layers.covered
    if level is not None:
        level = jnp.clip(level, 0.01, 0.99).reshape(-1, 1, 1, 1)
        logit = _CONTRAST * (logit - jnp.log(level / (1 - level)))
    covered = jax.nn.sigmoid(logit)
    grey = jnp.clip(empty["tactile"], 0.01, 0.99)
    return {
        "visual": covered * layers.colour + (1 - covered) * empty["visual"],
        "tactile": jax.nn.sigmoid(jnp.log(grey / (1 - grey)) + layers.touch),
    }


def _on_canvas(
    config: Config, pose: Float[Array, "n 12"], heading: Float[Array, "n 2"], depth: Float[Array, "n"]
) -> Float[Array, "n m 2"]:
    """Column and row on the canvas of each pixel of the view. Whole numbers are pixel centres.

    Args:
        config: The configuration of the model.
        pose: Pose codes.
        heading: Headings of the canvas.
        depth: Distance (m) of the canvas from the pinhole along the optical axis.
    """
    position = pose[:, :2] * config.position_scale
    shrunk = (config.camera_distance / depth)[:, None]
    place = ((jnp.arange(config.image_size) + 0.5) / config.image_size - 0.5) * config.view
    pixels = jnp.stack(jnp.meshgrid(place, place), axis=-1).reshape(1, -1, 2)
    apart = (pixels - (position * shrunk)[:, None]) / (shrunk * config.canvas_side)[:, None]
    return (poses.turn_back(heading[:, None], apart) + 0.5) * config.canvas - 0.5


class Model(nnx.Module):
    """The transition, the decoder, and an encoder for each input that is an image."""

    def __init__(self, config: Config, rngs: nnx.Rngs) -> None:
        self.config = config
        self.encoders = nnx.Dict({name: Encoder(config, name, rngs) for name in config.inputs if name in IMAGES})
        self.transition = Transition(config, rngs)
        self.decoder = Decoder(config, rngs)


def init(key: PRNGKeyArray, config: Config) -> tuple[nnx.GraphDef[Model], nnx.State, nnx.State]:
    """A new model as `(graphdef, params, stats)`. Consumes `key`. `stats` is empty (no running statistics)."""

    @jax.jit
    def draw(key: PRNGKeyArray) -> nnx.State:
        return nnx.state(Model(config, nnx.Rngs(key)), nnx.Param)

    abstract = nnx.eval_shape(lambda: Model(config, nnx.Rngs(0)))
    graphdef, _, stats = nnx.split(abstract, nnx.Param, ...)
    return graphdef, draw(key), stats
