"""The configuration of a state-space model."""

import dataclasses

from sts_jax.statespace import harmonics

IMAGES = ("visual", "tactile")  # names of the images
INPUTS = (*IMAGES, "pose")  # names of all inputs that a model can have
TINT = 3  # numbers of the tint


@dataclasses.dataclass(frozen=True)
class LossWeights:
    """Weights of the terms of the loss, see `objective`. The term `visual` has the weight 1."""

    tactile: float = 4.0  # error of the last tactile image
    state: float = 16.0  # squared error of each encoder's state code
    pose: float = 4.0  # negative log likelihoods of the final pose (or of a step) and of the encoders' estimates
    outcome: float = 8.0  # negative log likelihood of the outcome
    covered: float = 0.15  # cross-entropy of the outlines of the object and, with `Config.imprints`, of its imprint
    first: float = 0.5  # errors of the images of the first frame
    look: float = 0.1  # divergence of the appearance code. Below 1, samples are sharper


@dataclasses.dataclass(frozen=True)
class Config:
    """The configuration of a state-space model, in values that JSON can represent."""

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
    components: int = 6  # Gaussians in the density of the final pose for each outcome, or of one step
    window: int = 32  # pixels, side of the magnified window around the object that an encoder sees
    encoder: tuple[int, ...] = (24, 64, 128)  # channels at 1/2, 1/4 and 1/8 of the window's resolution
    decoder: tuple[int, ...] = (128, 64, 32)  # channels at 1/8, 1/4 and 1/2 of the canvas's resolution
    hidden: int = 384  # width of the encoders' fully connected layers
    transition: int = 512  # width of the transition's layers
    canvas: int = 64  # pixels, side of the canvas: the image of an object before it is placed in the view
    canvas_side: float = 0.165  # m, side of the square parallel to the pad that the canvas covers
    weights: LossWeights = LossWeights()  # of the terms of the loss
    # True: the decoder predicts the outline of the imprint in the tactile image, so that samples have sharp imprints.
    # False: it predicts only a mean tactile image, as in the models of the library other than freefall's
    imprints: bool = False
    # channels of a network that adjusts an imprint to its outline in a sample, which `imprints` must predict. 0: none
    shading: int = 0
    # channels of a network that draws the outline and the depth of an imprint in a sample, for which `shading` adds the
    # edges. 0: the outline is where the probability of an imprint is above a random level
    outlines: int = 0
    # True: in the training of the transition, every second trajectory is reflected (x -> -x). This is right if the
    # scenario has no preferred side
    reflected: bool = False
    drawn: float = 0.4375  # share of a batch with a rendered last frame (the whole batch trains the other parts)
    drawn_first: float = 0.125  # share of a batch with a rendered first frame
    vectors: int = 1  # number of vectors (x, y) in the plane of the pad with which the condition begins
    # name of each outcome in words, such as "fell off", or empty if the names are unknown
    outcome_names: tuple[str, ...] = ()
    # number of frames by which the transition advances the state (0: to the last frame). A one-step model has one
    # outcome, because the outcome follows from the first and the last pose. Its condition ends with the time
    stride: int = 0

    def __post_init__(self) -> None:
        if [name for name in INPUTS if name in self.inputs] != list(self.inputs) or not set(self.inputs) & set(IMAGES):
            raise ValueError(f"inputs must be some of {INPUTS} in this order, with an image, got {self.inputs}")
        for name, part in (("window", 8), ("canvas", 8), ("input_size", self.image_size)):
            if getattr(self, name) % part or getattr(self, name) < part:
                raise ValueError(
                    f"{name} must be a positive multiple of {part} pixels"
                    f"{', the image_size' if name == 'input_size' else ''}, got {getattr(self, name)}"
                )
        if len(self.encoder) != 3 or len(self.decoder) != 3:
            raise ValueError(f"encoder and decoder must have 3 widths each, got {self.encoder} and {self.decoder}")
        if self.condition < 0 or (self.condition and not 0 <= 2 * self.vectors <= self.condition):
            raise ValueError(
                f"condition must be >= 2 * vectors >= 0, got condition={self.condition} and vectors={self.vectors}: "
                "set condition to len(scenario.condition_scale) and vectors to scenario.vectors"
            )
        if self.shading < 0 or (self.shading and (not self.imprints or self.image_size % 2)):
            raise ValueError(
                f"shading must be 0, or >= 1 with imprints=True and an even image_size, got shading={self.shading}, "
                f"imprints={self.imprints} and image_size={self.image_size}"
            )
        if self.outlines < 0 or (self.outlines and not self.shading):
            raise ValueError(
                f"outlines must be 0, or >= 1 with shading >= 1, got outlines={self.outlines} and "
                f"shading={self.shading}"
            )
        if self.stride < 0 or (self.stride and self.outcomes != 1):
            raise ValueError(
                f"stride must be 0, or >= 1 with outcomes=1, got stride={self.stride} and outcomes={self.outcomes}"
            )
        if self.traits < TINT:
            raise ValueError(f"traits must be >= {TINT}, because the first {TINT} are the tint, got {self.traits}")
        if self.outcome_names and len(self.outcome_names) != self.outcomes:
            raise ValueError(f"outcome_names must be empty or have {self.outcomes} names, got {self.outcome_names}")
        for name in ("drawn", "drawn_first"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"{name} is a share of a batch, > 0 and <= 1, got {getattr(self, name)}")

    @property
    def look(self) -> int:
        """Number of values in the appearance code."""
        return self.traits + (self.own + self.shown) * harmonics.number(self.degree)
