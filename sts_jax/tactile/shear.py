"""Shear of the skin under a tangential load, and the dots printed in the skin, which move with it.

The tangential springs of the gel are independent, as those of `tactile.gel`. Arrays on the gel's grid have x and y on
the last axis. Row 0 has the smallest y, and column 0 the smallest x.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sts_jax._ranges import LENGTH, NOT_NEGATIVE, POSITIVE, SHARE
from sts_jax._sampling import bilinear
from sts_jax.tactile.gel import Gel, cell_area, cell_centres, moment_sums, solve_3x3
from sts_jax.tactile.skin import couple

_STEPS = 16  # largest number of steps. A load at 99.9 % of the limit of friction takes 10
_SETTLED = 1e-5  # the iteration ends after a step shorter than this, relative to the largest stretch of a spring
_SLIDING = 1e3  # it also ends if the object has moved so far, in the same unit: the load is too large
_ENOUGH = 0.5  # a Newton step is accepted if it reduces the energy's directional derivative to this share
_SPREAD = 0.5  # standard deviation with which the skin spreads its displacement, relative to the gel's thickness

Scalar = float | Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Markers:
    """Dots printed in the skin on a square grid, one of them at the pad's centre, and the skin's resistance to shear.

    Values for which no reference is cited are our choice.
    """

    # Distance between neighbouring dots (m).
    pitch: Scalar = dataclasses.field(default=0.01, metadata=POSITIVE | LENGTH)
    # Radius of a dot (m), at most half of the pitch.
    radius: Scalar = dataclasses.field(default=0.0015, metadata=POSITIVE | LENGTH)
    # Share of the light that a dot absorbs.
    darkness: Scalar = dataclasses.field(default=0.8, metadata=SHARE)
    # Stiffness of the gel's tangential springs, relative to `Gel.stiffness`. The default, 2 (1 - n) / (2 - n), is that
    # of a contact on an incompressible elastic half-space, n = 1/2 (Mindlin 1949).
    stiffness: Scalar = dataclasses.field(default=2 / 3, metadata=POSITIVE)
    # Coefficient of friction between the skin and any object. It limits the drawn shear only: physics has its own.
    friction: Scalar = dataclasses.field(default=0.8, metadata=NOT_NEGATIVE)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Shear:
    """Tangential load and displacement of the skin."""

    displacement: Float[Array, "*n r c 2"]  # of the skin from its place without load (m)
    traction: Float[Array, "*n r c 2"]  # force of the object on the skin, per area (Pa)
    slipping: Bool[Array, "*n r c"]  # cells at the limit of friction
    # True if the traction balances Fx, Fy and Mz. False if they exceed what friction transmits.
    held: Bool[Array, "*n"]


def shear(
    gel: Gel,
    markers: Markers,
    pressure: Float[Array, "r c"],
    wrench: Float[Array, "6"],
    traction: Float[Array, "r c 2"] | None = None,
) -> Shear:
    """Find the traction of an object on the skin that balances Fx, Fy and Mz.

    The object turns by a small angle c and shifts by (a, b) in the plane of the skin. A spring of the cell at (x, y)
    with the tangential stiffness k sticks to it, unless friction m and the pressure p limit the traction q:

        v = q_0 / k + (a - c y, b + c x),   q = k v min(1, m p / (k |v|))

    q_0 is the traction of an earlier frame. Let A be the area of a cell. With sums over all cells, the balance

        -Fx = sum q_x A,   -Fy = sum q_y A,   -Mz = sum (x q_y - y q_x) A

    is the condition for a minimum of a convex energy. Each step of the search is a Newton step or, if that does not
    come closer, a step with the secant stiffness `q / v` of each spring, which always does. The derivatives of the
    result follow from the implicit function theorem.

    The skin spreads the displacement `q / k` of each spring with a Gaussian, whose standard deviation is half of the
    gel's thickness. The displacements of several objects add.

    Args:
        gel: Constants of the gel.
        markers: Tangential stiffness and friction.
        pressure: Pressure on the gel's grid (Pa), from `settle` or `indent`.
        wrench: Wrench of the pad on the object: force (N) and moment about the sensor's origin (N m).
        traction: Traction of the previous frame, for the history of the contact. None for a contact that got its whole
            normal load before its tangential load.

    Returns:
        The shear. Beyond the limit of friction, all cells slip and the traction has the direction of the load.
    """
    area, stiffness = cell_area(gel), markers.stiffness * gel.stiffness
    limit = markers.friction * pressure / stiffness  # largest stretch of each spring (m)
    start = jnp.zeros((*limit.shape, 2)) if traction is None else traction / stiffness
    x, y = cell_centres(gel)
    # Rotations are about the centre of the limits. Their unit is the motion (m) at the distance `lever` from it.
    total = jnp.sum(limit)
    share = jax.lax.stop_gradient(limit / jnp.where(total > 0, total, 1))
    centre_x, centre_y = jnp.sum(share * x), jnp.sum(share * y)
    lever = jnp.sqrt(jnp.sum(share * ((x - centre_x) ** 2 + (y - centre_y) ** 2)) + area)
    moment = wrench[5] - (centre_x * wrench[1] - centre_y * wrench[0])
    load = -jnp.stack([wrench[0], wrench[1], moment / lever]) / (stiffness * area)
    x, y = (x[0] - centre_x) / lever, (y[:, 0] - centre_y) / lever

    w = _search(limit, start, x, y, load)
    stretch, slipping = _stretch(w, limit, start, x, y)
    residual = jnp.abs(_balance(stretch, x, y) - load)
    spread = [
        couple(part, _SPREAD * gel.thickness, jnp.stack([gel.size[0] / gel.cells[1], gel.size[1] / gel.cells[0]]))
        for part in stretch
    ]
    return Shear(
        displacement=jnp.stack(spread, axis=-1),
        traction=stiffness * jnp.stack(stretch, axis=-1),
        slipping=slipping,
        held=jnp.all(residual <= gel.tolerance * total),
    )


class _Descent(NamedTuple):
    """State of the search. The unknowns w are the object's motions along x and y, and its rotation times the lever."""

    steps: Int[Array, ""]  # number of steps so far
    w: Float[Array, "3"]
    step: Float[Array, ""]  # m, largest component of the last step
    gradient: Float[Array, "3"]  # of the energy at w
    hessian: Float[Array, "3 3"]  # of the energy at w, with small positive terms on the diagonal


def _search(
    limit: Float[Array, "r c"],
    start: Float[Array, "r c 2"],
    x: Float[Array, "c"],
    y: Float[Array, "r"],
    load: Float[Array, "3"],
) -> Float[Array, "3"]:
    """Find the motion of the object (m) at which the sums of the springs' stretches equal `load` (m)."""
    free = jnp.zeros(3, bool)

    def slopes(w: Float[Array, "3"], *, secant: bool = False) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
        """Gradient of the energy at w, and its Hessian or the matrix of the springs' secant stiffness."""
        stretch, slipping = _stretch(w, *fixed)
        vx, vy = _motion(w, *fixed[1:])
        square = jnp.where(slipping, vx * vx + vy * vy, 1)
        touched = (fixed[0] > 0).astype(vx.dtype)
        stiff = jnp.where(slipping, fixed[0] / jnp.sqrt(square), touched)
        drop = jnp.where(slipping & (not secant), stiff / square, 0)
        matrix = _matrix(stiff - drop * vx * vx, stiff - drop * vy * vy, -drop * vx * vy, *fixed[2:])
        return _balance(stretch, *fixed[2:]) - load_, matrix + 1e-6 * jnp.sum(touched) * jnp.eye(3)

    def descend(state: _Descent) -> _Descent:
        def cautious() -> tuple[Array, tuple[Array, Array]]:
            step = -solve_3x3(slopes(state.w, secant=True)[1], state.gradient, free)
            return step, slopes(state.w + step)

        newton = -solve_3x3(state.hessian, state.gradient, free)
        reached = slopes(state.w + newton)
        enough = jnp.abs(jnp.sum(newton * reached[0])) <= _ENOUGH * jnp.abs(jnp.sum(newton * state.gradient))
        step, reached = jax.lax.cond(enough, lambda: (newton, reached), cautious)
        return _Descent(state.steps + 1, state.w + step, jnp.max(jnp.abs(step)), *reached)

    def unsettled(state: _Descent) -> Bool[Array, ""]:
        moving = (state.step > _SETTLED * largest) & (jnp.max(jnp.abs(state.w)) < _SLIDING * largest)
        return (state.steps < _STEPS) & moving

    *fixed, load_ = jax.lax.stop_gradient((limit, start, x, y, load))
    largest = jnp.max(fixed[0])
    first = jnp.zeros(3)
    state = jax.lax.while_loop(unsettled, descend, _Descent(jnp.int32(0), first, jnp.array(jnp.inf), *slopes(first)))
    w, hessian = jax.lax.stop_gradient((state.w, state.hessian))
    # One more step, through which the derivatives pass, unless the object slides.
    gradient = _balance(_stretch(w, limit, start, x, y)[0], x, y) - load
    return jnp.where(state.step <= _SETTLED * largest, w - solve_3x3(hessian, gradient, free), w)


def _motion(
    w: Float[Array, "3"], start: Float[Array, "r c 2"], x: Float[Array, "c"], y: Float[Array, "r"]
) -> tuple[Float[Array, "r c"], Float[Array, "r c"]]:
    return start[..., 0] + (w[0] - w[2] * y)[:, None], start[..., 1] + (w[1] + w[2] * x)[None, :]


def _stretch(
    w: Float[Array, "3"],
    limit: Float[Array, "r c"],
    start: Float[Array, "r c 2"],
    x: Float[Array, "c"],
    y: Float[Array, "r"],
) -> tuple[tuple[Float[Array, "r c"], Float[Array, "r c"]], Bool[Array, "r c"]]:
    """Stretch of the springs along x and y (m), and whether friction limits it."""
    vx, vy = _motion(w, start, x, y)
    square = vx * vx + vy * vy
    slipping = (square >= limit * limit) & (limit > 0)
    scale = jnp.where(slipping, limit / jnp.sqrt(jnp.where(slipping, square, 1)), limit > 0)
    return (scale * vx, scale * vy), slipping


def _balance(
    stretch: tuple[Float[Array, "r c"], Float[Array, "r c"]], x: Float[Array, "c"], y: Float[Array, "r"]
) -> Float[Array, "3"]:
    """Sums of the stretches along x, along y and around the centre."""
    along_x, along_y = (moment_sums(part, x, y, 1) for part in stretch)
    return jnp.stack([along_x[0, 0], along_y[0, 0], along_y[0, 1] - along_x[1, 0]])


def _matrix(
    xx: Float[Array, "r c"],
    yy: Float[Array, "r c"],
    xy: Float[Array, "r c"],
    x: Float[Array, "c"],
    y: Float[Array, "r"],
) -> Float[Array, "3 3"]:
    """Sum of the springs' stiffness matrices, for motions along x, along y and around the centre."""
    a, b, c = (moment_sums(part, x, y, 2) for part in (xx, yy, xy))
    turn_x, turn_y = c[0, 1] - a[1, 0], b[0, 1] - c[1, 0]
    turn = a[2, 0] - 2 * c[1, 1] + b[0, 2]
    return jnp.stack([a[0, 0], c[0, 0], turn_x, c[0, 0], b[0, 0], turn_y, turn_x, turn_y, turn]).reshape(3, 3)


def dots(
    gel: Gel,
    markers: Markers,
    displacement: Float[Array, "r c 2"],
    x: Float[Array, "*n"],
    y: Float[Array, "*n"],
    blur: Scalar,
) -> Float[Array, "*n"]:
    """Share of the light that the dots let through at points of the skin.

    Args:
        gel: Size of the pad, beyond which there are no dots.
        markers: Grid, radius and darkness of the dots.
        displacement: Displacement of the skin on the gel's grid (m), from `shear`.
        x: x of the points in the sensor frame (m).
        y: y of the points (m).
        blur: Width of the dots' edges (m), such as the distance between pixels.
    """
    rows, columns = gel.cells
    column, row = (x / gel.size[0] + 0.5) * columns - 0.5, (y / gel.size[1] + 0.5) * rows - 0.5
    shift = bilinear(displacement, column, row)
    away = [
        place - markers.pitch * jnp.round(place / markers.pitch) for place in (x - shift[..., 0], y - shift[..., 1])
    ]
    distance = jnp.sqrt(jnp.maximum(away[0] ** 2 + away[1] ** 2, 1e-20))
    on_pad = (jnp.abs(x) <= gel.size[0] / 2) & (jnp.abs(y) <= gel.size[1] / 2)
    covered = jnp.clip((markers.radius - distance) / blur + 0.5, 0, 1)
    return jnp.where(on_pad, 1 - markers.darkness * covered, 1)
