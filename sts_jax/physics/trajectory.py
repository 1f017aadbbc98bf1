"""`Trajectory`: the recorded motion of objects."""

from collections import Counter
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sts_jax.objects.body import is_traced
from sts_jax.physics.scenario import Hidden, Outcome


class Trajectory(NamedTuple):
    """n trajectories with f frames each. Each trajectory is the motion of one body.

    The trajectories of body 0 come first, then those of body 1, and so on.
    """

    time: Float[Array, "n f"]  # Time (s), 0 at frame 0.
    pose: Float[Array, "n f 7"]  # Mesh frame in the sensor frame: position (m) and quaternion with w >= 0.
    # Velocity of the mesh frame's origin (m/s) and angular velocity (rad/s), in the sensor frame.
    velocity: Float[Array, "n f 6"]
    # Force (N) and moment about the sensor's origin (N m) of the pad on the object. The wrench is the mean over the
    # unbroken contact at the end of the interval before the frame, or 0 if the last time step has no contact. Frame 0
    # of an object that a hand holds on the pad (`Start.carried`) has the wrench under the held pose.
    wrench: Float[Array, "n f 6"]
    contact: Bool[Array, "n f"]  # True if the pad pushes the object in the last time step before the frame.
    wall: Bool[Array, "n f"]  # True if the stop wall pushes the object in the last time step before the frame.
    gravity: Float[Array, "n f 3"]  # Gravity minus the acceleration of the pad, in the sensor frame (m/s^2).
    # True if the object was slower than 5 mm/s and 0.1 rad/s for the last 0.2 s, or has left the pad.
    settled: Bool[Array, "n"]
    # Number of the outcome, from the poses of the first and the last frame. It is final where `settled` is True.
    outcome: Int[Array, "n"]
    touches: Int[Array, "n"]  # Number of contacts with pad or wall, separated by at least 5 ms.
    sunk: Float[Array, "n"]  # Largest depth of the hull in pad or wall (m).
    condition: Float[Array, "n c"]  # Condition of the start (`Scenario.quantities`), in SI units.
    hidden: Hidden  # Hidden properties: arrays of shape (n,), and `up` of shape (n, 3).
    body: Int[Array, "n"]  # Index of the body in the sequence of bodies.
    resampled: Int[Array, "n"]  # Number of discarded draws, which were non-finite or in which the object sank too deep.

    @property
    def outcomes(self) -> tuple[Outcome, ...]:
        """The outcome of each trajectory. `Outcome.FELL_OFF` prints as "fell off".

        Raises:
            ValueError: The field `outcome` has a number that no member of `Outcome` has. A scenario can define its own
                outcomes, and `Scenario.named` returns their names.
        """
        return tuple(Outcome(int(number)) for number in np.ravel(self.outcome))

    def __repr__(self) -> str:
        shown = (self.time, self.outcome, self.settled, self.body)
        if not all(isinstance(x, np.ndarray | np.generic | jax.Array) for x in shown) or is_traced(shown):
            fields = (f"{name}={getattr(leaf, 'shape', leaf)}" for name, leaf in self._asdict().items())
            return f"Trajectory({', '.join(fields)})"
        number, time = np.size(self.outcome), np.asarray(self.time)
        counts = Counter(_named(number) for number in np.ravel(self.outcome).tolist()).most_common()
        moving = number - int(np.sum(self.settled))
        return (
            f"Trajectory({number} trajector{'y' if number == 1 else 'ies'} of {len(np.unique(self.body))} "
            f"bod{'y' if len(np.unique(self.body)) == 1 else 'ies'}, {time.shape[-1] if time.ndim else 1} frames "
            f"in {time.max(initial=0):.2f} s; {', '.join(f'{count} {name}' for name, count in counts)}; "
            f"{moving} not settled at the end)"
        )


def _named(number: int) -> str:
    """Return an outcome in words, or as "outcome N" if `Outcome` has no member with this number."""
    return str(Outcome(number)) if number in set(Outcome) else f"outcome {number}"
