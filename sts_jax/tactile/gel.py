"""The gel as a bed of springs, in equilibrium with the wrench that the pad exerts on the object.

Heights are those of the object's underside over the gel's face (m, positive outwards), on the gel's grid. As in an
image, row 0 has the lowest y and column 0 the lowest x.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, ScalarLike

from sts_jax import _cpu_reductions
from sts_jax._ranges import POSITIVE, STATIC

_NEWTON_STEPS = 20  # at most
_SETTLED = 1e-7  # m, the iteration ends after a step shorter than this
_ENOUGH = 0.5  # accept a full step if it reduces the energy's directional derivative to this share
_STEP_LENGTHS = (1.0, 0.6, 0.35, 0.15, 0.05)
_LEVER = 0.02  # m, lever by which tilts are scaled to heights
_BOTTOM = 300.0  # stiffness of the hard bottom beyond `max_depth`, relative to the springs
_FAR = 1.0  # m, replaces inf where there is no object

Scalar = float | Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Gel:
    """A square pad of soft gel, its outer face in the plane z = 0."""

    # m, along x and y (paper, "Real-World Dataset")
    size: tuple[Scalar, Scalar] = dataclasses.field(default=(0.15, 0.15), metadata=POSITIVE)
    thickness: Scalar = dataclasses.field(default=0.005, metadata=POSITIVE)  # m (paper, supplement "Simulator Details")
    # N/m^3, about 10 kPa over 5 mm, so that a bottle sinks 0.2-0.3 mm. Our choice.
    stiffness: Scalar = dataclasses.field(default=2e6, metadata=POSITIVE)
    # m, limit of the imprint in an equilibrium. Our choice.
    max_depth: Scalar = dataclasses.field(default=0.003, metadata=POSITIVE)
    # rad (5 degrees), limit about x and about y, from the given pose. Our choice. The equilibrium takes the slope of a
    # tilt for its angle, which limits this constant.
    max_tilt: Scalar = dataclasses.field(default=0.0873, metadata=POSITIVE | {"below": 0.3})
    # allowed error, over Fz, or over Fz times 1 cm for moments. Our choice.
    tolerance: Scalar = dataclasses.field(default=0.005, metadata=POSITIVE)
    cells: tuple[int, int] = dataclasses.field(default=(150, 150), metadata=POSITIVE | STATIC)  # rows, columns: 1 mm


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Equilibrium:
    """The equilibrium of a rigid object in the gel."""

    sink: Float[Array, "*n"]  # m, motion of the object along -z, after the turn
    turn: Float[Array, "*n 2"]  # rad, rotation vector about the sensor's x and y axes
    pressure: Float[Array, "*n r c"]  # Pa, on the gel's grid
    balanced: Bool[Array, "*n"]  # whether the pressure balances Fz, Mx and My


def cell_centres(gel: Gel) -> tuple[Float[Array, "r c"], Float[Array, "r c"]]:
    """x and y of the grid's cells (m)."""
    rows, columns = gel.cells
    x = ((jnp.arange(columns) + 0.5) / columns - 0.5) * gel.size[0]
    y = ((jnp.arange(rows) + 0.5) / rows - 0.5) * gel.size[1]
    x, y = jnp.meshgrid(x, y)
    return x, y


def cell_area(gel: Gel) -> Float[Array, ""]:
    """Area of one cell (m^2)."""
    return jnp.asarray(gel.size[0] * gel.size[1] / (gel.cells[0] * gel.cells[1]), float)


def indent(gel: Gel, heights: Float[Array, "r c"]) -> Equilibrium:
    """Pressure of an object that stays in its pose, `p = k max(0, -h)`.

    Args:
        gel: constants of the gel.
        heights: of the object's underside over the gel's face (m), `inf` where there is none.

    Returns:
        Equilibrium without motion, balanced because there is no wrench to balance.
    """
    pressure = gel.stiffness * jnp.clip(-heights, 0, gel.thickness)
    return Equilibrium(jnp.float32(0), jnp.zeros(2), pressure, jnp.bool_(True))


def settle(gel: Gel, heights: Float[Array, "r c"], wrench: Float[Array, "6"]) -> Equilibrium:
    """Depth and two tilts at which the springs balance Fz, Mx and My.

    The motion of the object changes its heights to `h' = h - d + a y - b x`. The pressure is `p = k max(0, -h')`, and

        Fz = sum p A,   Mx = sum y p A,   My = -sum x p A

    are the conditions for a minimum of `E = sum k A max(0, -h')^2 / 2 - Fz d + Mx a + My b`, which is convex and
    piecewise quadratic. Projected Newton steps with a line search find it, starting at the largest depth below first
    touch. Beyond `max_depth` the springs meet a hard bottom, which carries the rest of the load and does not count as
    pressure. Derivatives are those of the equilibrium (implicit function theorem: one more Newton step, undamped).

    Args:
        gel: constants of the gel.
        heights: of the object's underside over the gel's face (m), `inf` where there is none.
        wrench: force (N) and moment about the sensor's origin (N m) of the pad on the object. Fx, Fy and Mz are
            friction and ignored.

    Returns:
        Equilibrium. With `Fz <= 0` there is no motion and no pressure. If no equilibrium exists, the result is within
        the limits, and `balanced` is False. Reasons are a first touch farther away than `max_depth`, a centre of
        pressure outside of the footprint, and a limit that is reached.
    """
    force = wrench[2]
    pressed = force > 0
    safe_force = jnp.where(pressed, force, 1)
    load = jnp.where(pressed, force, 0) / (gel.stiffness * cell_area(gel))  # sum of the springs' compressions (m)
    # Tilts are about the centre of pressure, in metres of height at the distance `_LEVER` from it.
    half_x, half_y = gel.size[0] / 2, gel.size[1] / 2
    wanted_x, wanted_y = -wrench[4] / safe_force, wrench[3] / safe_force
    on_pad = (jnp.abs(wanted_x) <= half_x) & (jnp.abs(wanted_y) <= half_y)
    centre_x, centre_y = jnp.clip(wanted_x, -half_x, half_x), jnp.clip(wanted_y, -half_y, half_y)
    x, y = cell_centres(gel)
    x, y = (x[0] - centre_x) / _LEVER, (y[:, 0] - centre_y) / _LEVER
    target = load * jnp.array([1.0, 0.0, 0.0])

    height = jnp.where(jnp.isfinite(heights), heights, _FAR)
    tilt = jnp.tan(gel.max_tilt) * _LEVER
    bound = jnp.stack([jnp.float32(jnp.inf), tilt, tilt])

    touch = _cpu_reductions.minimum(jnp.min(height, axis=0))
    reach = touch <= gel.max_depth
    start = jnp.stack([touch + gel.max_depth, jnp.float32(0), jnp.float32(0)])
    u = _newton(height, x, y, target, start, bound, gel.max_depth)

    u = jnp.where(pressed & reach, u, 0)
    length = _plane(u, x, y) - height
    # The hard bottom yields visibly where it alone carries the load. Lift the object until the deepest spring is at the
    # limit.
    deepest = _cpu_reductions.maximum(jnp.max(length, axis=0))
    beyond = jnp.where(pressed & reach, jnp.maximum(deepest - gel.max_depth, 0), 0)
    length = jnp.where(pressed & reach, jnp.clip(length - beyond, 0, gel.max_depth), 0)

    # Moments count as forces at a lever of 1 cm.
    residual = jnp.abs(_moments(length, x, y) - target) * jnp.array([1.0, _LEVER / 0.01, _LEVER / 0.01])
    balanced = ~pressed | (reach & on_pad & jnp.all(residual <= gel.tolerance * load))
    return Equilibrium(
        sink=u[0] - beyond - (u[1] * centre_y + u[2] * centre_x) / _LEVER,
        turn=jnp.stack([-u[1], u[2]]) / _LEVER,
        pressure=gel.stiffness * length,
        balanced=balanced,
    )


class _Descent(NamedTuple):
    """State of Newton's method: the plane `u0 + u1 y + u2 x`, with the gradient and the Hessian of the energy at it."""

    steps: Int[Array, ""]  # taken so far
    u: Float[Array, "3"]
    step: Float[Array, ""]  # m, largest component of the last step
    gradient: Float[Array, "3"]
    hessian: Float[Array, "3 3"]  # slightly stiffened


def _newton(
    height: Float[Array, "r c"],
    x: Float[Array, "c"],
    y: Float[Array, "r"],
    target: Float[Array, "3"],
    start: Float[Array, "3"],
    bound: Float[Array, "3"],
    limit: Scalar,
) -> Float[Array, "3"]:
    """The plane `u0 + u1 y + u2 x` whose springs to `height` have the moments `target`, or moments near them."""
    near_bound = 0.9999 * bound

    def pushed(length: Array) -> Array:
        return jnp.maximum(length, 0) + _BOTTOM * jnp.maximum(length - limit, 0)

    def slopes(
        u: Float[Array, "3"], height: Array, x: Array, y: Array, target: Array
    ) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
        """Gradient and slightly stiffened Hessian of the energy."""
        length = _plane(u, x, y) - height
        weight = (length > 0) + _BOTTOM * (length > limit)
        gradient = _moments(pushed(length), x, y) - target
        s = _sums(weight, x, y, 2)
        full = jnp.stack([s[0, 0], s[1, 0], s[0, 1], s[1, 0], s[2, 0], s[1, 1], s[0, 1], s[1, 1], s[0, 2]])
        return gradient, full.reshape(3, 3) + (1e-6 + 1e-5 * s[0, 0]) * jnp.eye(3)

    def newton(state: _Descent) -> _Descent:
        u = state.u
        step = _newton_step(state, bound, near_bound)

        def at(part: ScalarLike) -> tuple[Array, tuple[Array, Array]]:
            return u + part * step, slopes(u + part * step, *fixed)

        def shorter() -> tuple[Array, tuple[Array, Array]]:
            parts = jnp.array(_STEP_LENGTHS)
            left = jax.lax.map(lambda part: jnp.abs(jnp.sum(step * at(part)[1][0])), parts)
            return at(parts[jnp.argmin(left)])

        whole = at(1.0)
        enough = jnp.abs(jnp.sum(step * whole[1][0])) <= _ENOUGH * jnp.abs(jnp.sum(step * state.gradient))
        u, (gradient, hessian) = jax.lax.cond(enough, lambda: whole, shorter)
        return _Descent(state.steps + 1, u, jnp.max(jnp.abs(step)), gradient, hessian)

    def unsettled(state: _Descent) -> Bool[Array, ""]:
        return (state.steps < _NEWTON_STEPS) & (state.step > _SETTLED)

    fixed = jax.lax.stop_gradient((height, x, y, target))
    first = jax.lax.stop_gradient(start)
    state = _Descent(jnp.int32(0), first, jnp.array(jnp.inf), *slopes(first, *fixed))
    u = jax.lax.stop_gradient(jax.lax.while_loop(unsettled, newton, state).u)

    # One more step, which carries the derivatives.
    gradient, hessian = slopes(u, height, x, y, target)
    return jnp.clip(u - _solve(jax.lax.stop_gradient(hessian), gradient, jnp.abs(u) >= near_bound), -bound, bound)


def _newton_step(state: _Descent, bound: Float[Array, "3"], near_bound: Float[Array, "3"]) -> Float[Array, "3"]:
    """The Newton step of the unknowns that are not held at their bounds, shortened so that none leaves them."""
    u, gradient = state.u, state.gradient
    held = ((u >= near_bound) & (gradient < 0)) | ((u <= -near_bound) & (gradient > 0))
    step = -_solve(state.hessian, gradient, held)
    # Hold an unknown at its limit too if the other unknowns would drive it beyond.
    held |= (jnp.abs(u) >= near_bound) & (jnp.abs(u + step) > bound)
    step = -_solve(state.hessian, gradient, held)
    room = (bound - u * jnp.sign(step)) / jnp.where(step == 0, 1, jnp.abs(step))
    return step * jnp.clip(jnp.min(jnp.where(step == 0, 1, room)), 0, 1)


def _plane(u: Float[Array, "3"], x: Float[Array, "c"], y: Float[Array, "r"]) -> Float[Array, "r c"]:
    return (u[0] + u[1] * y)[:, None] + (u[2] * x)[None, :]


def _sums(value: Float[Array, "r c"], x: Float[Array, "c"], y: Float[Array, "r"], degree: int) -> Float[Array, "k k"]:
    """`sum value y^i x^j` at [i, j]."""
    # One sum along columns per power: products of such narrow matrices are several times slower on a CPU.
    rows = [jnp.sum(value, axis=0), *(y**power @ value for power in range(1, degree + 1))]
    return jnp.stack(rows) @ jnp.stack([x**power for power in range(degree + 1)], axis=1)


def _moments(value: Float[Array, "r c"], x: Float[Array, "c"], y: Float[Array, "r"]) -> Float[Array, "3"]:
    sums = _sums(value, x, y, 1)
    return jnp.stack([sums[0, 0], sums[1, 0], sums[0, 1]])


def _solve(matrix: Float[Array, "3 3"], vector: Float[Array, "3"], held: Bool[Array, "3"]) -> Float[Array, "3"]:
    """Solve for the unknowns that are not held. The others are 0."""
    matrix = jnp.where(held[:, None] | held[None, :], jnp.eye(3), matrix)
    vector = jnp.where(held, 0, vector)
    a, b, c = matrix[:, 0], matrix[:, 1], matrix[:, 2]
    det = jnp.sum(a * jnp.cross(b, c))
    det = jnp.where(det == 0, 1, det)
    parts = [vector * jnp.cross(b, c), a * jnp.cross(vector, c), a * jnp.cross(b, vector)]
    return jnp.stack([jnp.sum(p) for p in parts]) / det
