"""`Trajectory`: the recorded motion of objects."""

from collections import Counter
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sts_jax.objects.body import is_traced
from sts_jax.physics.scenario import Hidden, Outcome


class Trajectory(NamedTuple):
    """n trajectories of one or more bodies, body-major, with f frames each."""

    time: Float[Array, "n f"]  # s, 0 at frame 0
    pose: Float[Array, "n f 7"]  # mesh frame in the sensor frame, w >= 0
    velocity: Float[Array, "n f 6"]  # m/s of the mesh frame's origin, rad/s; sensor frame
    # N, N m about the sensor's origin, exerted by the pad on the object: the mean over the unbroken contact at the end
    # of the frame's interval, or 0 if the last step of the interval has no contact. In frame 0 of an object that is
    # held on the pad (`Start.carried`), the wrench under the held pose.
    wrench: Float[Array, "n f 6"]
    contact: Bool[Array, "n f"]  # the pad pushes in the frame's last step
    wall: Bool[Array, "n f"]  # the stop wall pushes in the frame's last step
    gravity: Float[Array, "n f 3"]  # m/s^2, sensor frame
    settled: Bool[Array, "n"]  # slower than 5 mm/s and 0.1 rad/s for the last 0.2 s, or gone from the pad
    # Outcome from the poses of the first and the last frame. It is final where `settled`
    outcome: Int[Array, "n"]
    touches: Int[Array, "n"]  # contacts with pad or wall, separated by at least 5 ms
    sunk: Float[Array, "n"]  # m, largest depth of the hull in pad or wall
    condition: Float[Array, "n c"]  # the scenario's input
    hidden: Hidden  # (n,) each, `up` (n, 3)
    body: Int[Array, "n"]  # index into the sequence of bodies
    resampled: Int[Array, "n"]  # draws discarded because non-finite or too deep

    @property
    def outcomes(self) -> tuple[Outcome, ...]:
        """The outcome of each trajectory. `Outcome.FELL_OFF` prints as "fell off".

        Raises:
            ValueError: the scenario has an outcome of its own, which `Scenario.named` names.
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
    """An outcome in words. Those that only a scenario of the user has are numbers."""
    return str(Outcome(number)) if number in set(Outcome) else f"outcome {number}"
