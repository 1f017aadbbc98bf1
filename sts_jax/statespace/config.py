"""The configuration of a state-space model."""

import dataclasses
from typing import Any

from sts_jax import storage
from sts_jax.statespace import harmonics

IMAGES = ("visual", "tactile")  # names of the images
INPUTS = (*IMAGES, "pose")  # names of all inputs that a model can have
TINT = 3  # numbers of the tint
_ADDED = (("vectors", 1), ("outcome_names", ()))  # fields that older versions lack, and their default values


@dataclasses.dataclass(frozen=True)
class Config:
    """The configuration of a state-space model, in values that JSON can represent.

    Raises:
        ValueError: A field is out of range, or the values of two fields do not fit together.
    """

    inputs: tuple[str, ...] = ("visual", "pose")  # some of `visual`, `tactile` and `pose`, in this order
    outcomes: int = 2  # number of outcomes of the scenario
    condition: int = 0  # number of values in the scenario's condition
    input_size: int = 128  # pixels, side of the input images
    image_size: int = 64  # pixels, side of the predicted images
    camera_distance: float = 0.1  # m, from the pinhole to the gel's outer face
    view: float = 0.15  # m, side of the visible square of the gel's face
    position_scale: float = 0.05  # m, divisor of positions in pose codes, as in `training.Preprocessing`
    traits: int = 32  # numbers of the appearance code that do not depend on the rotation, the tint first
    own: int = 4  # functions on the sphere in the appearance code, for directions in the mesh frame
    shown: int = 4  # functions on the sphere in the appearance code, for directions in the sensor frame
    degree: int = 3  # largest degree of the spherical harmonics of these functions
    directions: int = 24  # number of directions at which the decoder sees the values of these functions
    support: int = 64  # number of directions at which transition and decoder see the support functions
    components: int = 6  # Gaussians in the density of the final pose for each outcome
    window: int = 32  # pixels, side of the magnified window around the object that an encoder sees
    encoder: tuple[int, ...] = (64, 128, 128)  # channels at 1/2, 1/4 and 1/8 of the window's resolution
    decoder: tuple[int, ...] = (128, 64, 32)  # channels at 1/8, 1/4 and 1/2 of the canvas's resolution
    hidden: int = 384  # width of the encoders' fully connected layers
    transition: int = 512  # width of the transition's layers
    canvas: int = 64  # pixels, side of the canvas: the image of an object before it is placed in the view
    canvas_side: float = 0.165  # m, side of the square parallel to the pad that the canvas covers
    tactile_weight: float = 4.0  # weight of the error of the last tactile image in the loss
    state_weight: float = 16.0  # weight of the squared error of each encoder's state code
    pose_weight: float = 4.0  # weight of the negative log likelihoods of the final pose and of the encoders' estimates
    outcome_weight: float = 8.0  # weight of the negative log likelihood of the outcome
    covered_weight: float = 0.15  # weight of the cross-entropy of the object's outline
    first_weight: float = 0.5  # weight of the errors of the images of the first frame
    look_weight: float = 0.1  # weight of the divergence of the appearance code. Below 1, samples are sharper
    drawn: float = 0.4375  # share of a batch with a rendered last frame (the whole batch trains the other parts)
    drawn_first: float = 0.125  # share of a batch with a rendered first frame
    vectors: int = 1  # number of vectors (x, y) in the plane of the pad with which the condition begins
    # name of each outcome in words, such as "fell off", or empty if the names are unknown
    outcome_names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.inputs or [name for name in INPUTS if name in self.inputs] != list(self.inputs):
            raise ValueError(f"inputs is {self.inputs}, but it must be one or more of {INPUTS}, in this order")
        if not set(self.inputs) & set(IMAGES):
            raise ValueError(
                f"inputs is {self.inputs}, but at least one input must be an image: add 'visual' or 'tactile'"
            )
        for name, part in (("window", 8), ("canvas", 8), ("input_size", self.image_size)):
            if getattr(self, name) % part or getattr(self, name) < part:
                raise ValueError(
                    f"{name} is {getattr(self, name)} pixels, but it must be a positive multiple of {part}"
                    f"{', the image_size' if name == 'input_size' else ''}"
                )
        if len(self.encoder) != 3 or len(self.decoder) != 3:
            raise ValueError(
                f"encoder has {len(self.encoder)} widths and decoder has {len(self.decoder)}, but each must have 3 "
                "widths, one for each resolution of the network"
            )
        if self.condition < 0 or (self.condition and not 0 <= 2 * self.vectors <= self.condition):
            raise ValueError(
                f"condition is {self.condition} and vectors is {self.vectors}, but they must satisfy condition >= "
                "2 * vectors >= 0. Set condition to len(scenario.condition_scale), the number of known quantities of "
                "a trajectory, and vectors to scenario.vectors"
            )
        if self.traits < TINT:
            raise ValueError(
                f"traits is {self.traits}, but it must be >= {TINT}, because the first {TINT} traits describe the mean "
                "colour of the object"
            )
        if self.outcome_names and len(self.outcome_names) != self.outcomes:
            raise ValueError(
                f"outcome_names is {self.outcome_names}, but outcomes, the number of outcomes, is {self.outcomes}: "
                "give one name for each outcome, or an empty tuple"
            )
        for name in ("drawn", "drawn_first"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(
                    f"{name} is {getattr(self, name)}, but it must be > 0 and <= 1, because it is a share of a batch"
                )

    @property
    def look(self) -> int:
        """Number of values in the appearance code, which describes the visible properties other than pose and shape."""
        return self.traits + (self.own + self.shown) * harmonics.number(self.degree)

    def to_json(self) -> dict[str, Any]:
        """The fields by name, in values that `json.dumps` accepts.

        A field that older versions of the library did not have (`vectors` or `outcome_names`) is left out if it has its
        default value, so that the result equals a configuration that an older version saved.
        """
        values = dataclasses.asdict(self)
        return {name: value for name, value in values.items() if (name, value) not in _ADDED}

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "Config":
        """Make a configuration from the result of `to_json`, or from the same values read from a JSON file."""
        return storage.decode(cls, values, "model")
