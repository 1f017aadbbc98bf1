"""The gel as a bed of independent springs, and the equilibrium of an object on it.

An object is given by the heights of its underside above the gel's undeformed face (m), one for each cell of the gel's
grid, negative where the object presses into the gel. Row 0 has the smallest y, and column 0 the smallest x.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, ScalarLike

from sts_jax import _cpu_reductions
from sts_jax._ranges import LENGTH, POSITIVE, STATIC

_NEWTON_STEPS = 20  # largest number of steps
_SETTLED = 1e-7  # m, the iteration ends after a step shorter than this, on a pad of `_SIDE`
_ENOUGH = 0.5  # a full step is accepted if it reduces the energy's directional derivative to this share
_STEP_LENGTHS = (1.0, 0.6, 0.35, 0.15, 0.05)  # candidates of the line search, relative to a full step
_LEVER = 0.02  # m, a tilt is expressed as the height that it causes at this distance, on a pad of `_SIDE`
_SIDE = 0.15  # m, mean of the pad's width and height to which lengths of the computation are in proportion
_BOTTOM = 300.0  # stiffness of the hard bottom beyond `max_depth`, relative to the springs
_FAR = 1.0  # m, height that replaces inf where there is no object

Scalar = float | Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Gel:
    """A rectangular pad of soft gel. Its outer face lies in the plane z = 0."""

    # Size along x and y (m). Source: paper, "Real-World Dataset".
    size: tuple[Scalar, Scalar] = dataclasses.field(default=(0.15, 0.15), metadata=POSITIVE | LENGTH)
    # Thickness (m). Source: paper, supplement "Simulator Details".
    thickness: Scalar = dataclasses.field(default=0.005, metadata=POSITIVE | LENGTH)
    # Pressure per depth (N/m^3). The default gives 10 kPa at a depth of 5 mm. A bottle then sinks 0.2-0.3 mm. Our
    # choice.
    stiffness: Scalar = dataclasses.field(default=2e6, metadata=POSITIVE | {"metres": -3})
    # Largest depth to which an object with a wrench sinks (m). Our choice.
    max_depth: Scalar = dataclasses.field(default=0.003, metadata=POSITIVE | LENGTH)
    # Largest tilt of an object from its given pose, about x and about y (rad). The default is 5 degrees, our choice. It
    # must be < 0.3, because the equilibrium assumes that the tangent of a tilt is equal to its angle.
    max_tilt: Scalar = dataclasses.field(default=0.0873, metadata=POSITIVE | {"below": 0.3})
    # Largest relative error of a balance: error of Fz divided by Fz, and error of Mx or My divided by Fz times 1/15 of
    # the mean of the pad's width and height (1 cm). Our choice.
    tolerance: Scalar = dataclasses.field(default=0.005, metadata=POSITIVE)
    # Number of rows and columns of the grid. The default gives cells of 1 mm.
    cells: tuple[int, int] = dataclasses.field(default=(150, 150), metadata=POSITIVE | {"at_most": 4096} | STATIC)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Equilibrium:
    """Motion of a rigid object from its given pose to the equilibrium on the gel, and the pressure on the gel."""

    # Motion along -z (m), which follows the rotation.
    sink: Float[Array, "*n"]
    # Rotation vector about the sensor's x and y axes (rad).
    turn: Float[Array, "*n 2"]
    # Pressure on the cells of the gel's grid (Pa).
    pressure: Float[Array, "*n r c"]
    # True if the pressure balances Fz, Mx and My of the wrench.
    balanced: Bool[Array, "*n"]


def cell_centres(gel: Gel) -> tuple[Float[Array, "r c"], Float[Array, "r c"]]:
    """x and y of the centre of each cell of the gel's grid, in the sensor frame (m)."""
    rows, columns = gel.cells
    x = ((jnp.arange(columns) + 0.5) / columns - 0.5) * gel.size[0]
    y = ((jnp.arange(rows) + 0.5) / rows - 0.5) * gel.size[1]
    x, y = jnp.meshgrid(x, y)
    return x, y


def cell_area(gel: Gel) -> Float[Array, ""]:
    """Area of one cell of the gel's grid (m^2)."""
    return jnp.asarray(gel.size[0] * gel.size[1] / (gel.cells[0] * gel.cells[1]), float)


def indent(gel: Gel, heights: Float[Array, "r c"]) -> Equilibrium:
    """Pressure under an object that stays in its given pose: `p = k min(max(0, -h), t)`.

    k is the stiffness of the gel, t its thickness, and h the heights, `inf` where there is no object.
    """
    pressure = gel.stiffness * jnp.clip(-heights, 0, gel.thickness)
    return Equilibrium(jnp.float32(0), jnp.zeros(2), pressure, jnp.bool_(True))


def settle(gel: Gel, heights: Float[Array, "r c"], wrench: Float[Array, "6"]) -> Equilibrium:
    """Find the depth and the tilts of an object at which the pressure of the gel produces the given Fz, Mx and My.

    Each cell of the gel is a spring. The object sinks by d, and turns by a small angle a about the x axis and b about
    the y axis. Above the cell with the centre (x, y), it then has the height h' and exerts the pressure p, with the
    stiffness k:

        h' = h - d + a y - b x,   p = k max(0, -h')

    Let A be the area of a cell. With sums over all cells, the balance

        Fz = sum p A,   Mx = sum y p A,   My = -sum x p A

    is the condition for a minimum of the energy

        E = sum k A max(0, -h')^2 / 2 - Fz d + Mx a + My b

    This energy is convex and piecewise quadratic. Projected Newton steps with a line search find the minimum. The first
    iterate is the pose at which the object's lowest point is at the depth `Gel.max_depth`. A hard bottom at this depth
    limits the compression of the springs. The load that the bottom carries does not count as pressure. The derivatives
    of the equilibrium follow from the implicit function theorem.

    Args:
        gel: Constants of the gel.
        heights: Heights of the object's underside above the gel's face (m), `inf` where there is no object.
        wrench: Wrench of the pad on the object: force (N) and moment about the sensor's origin (N m). Fx, Fy and Mz are
            due to friction and are ignored.

    Returns:
        The equilibrium. If `Fz <= 0`, there is no motion and no pressure, and `balanced` is True. `balanced` is False
        if no equilibrium exists within the limits of depth and tilt: the object starts more than `Gel.max_depth` above
        the face, the centre of pressure lies outside its footprint or the pad, or the load is too large. The result
        then lies within the limits.
    """
    precise = jnp.result_type(float)
    heights, wrench = jnp.asarray(heights, precise), jnp.asarray(wrench, precise)
    force = wrench[2]
    pressed = force > 0
    safe_force = jnp.where(pressed, force, 1)
    load = jnp.where(pressed, force, 0) / (gel.stiffness * cell_area(gel))  # sum of the springs' compressions (m)
    # Tilts are about the centre of pressure. Their unit is the height (m) at the distance `lever` from this centre.
    scale = (gel.size[0] + gel.size[1]) / 2 / _SIDE
    lever = _LEVER * scale
    half_x, half_y = gel.size[0] / 2, gel.size[1] / 2
    wanted_x, wanted_y = -wrench[4] / safe_force, wrench[3] / safe_force
    on_pad = (jnp.abs(wanted_x) <= half_x) & (jnp.abs(wanted_y) <= half_y)
    centre_x, centre_y = jnp.clip(wanted_x, -half_x, half_x), jnp.clip(wanted_y, -half_y, half_y)
    x, y = cell_centres(gel)
    x, y = (x[0] - centre_x) / lever, (y[:, 0] - centre_y) / lever
    target = load * jnp.array([1.0, 0.0, 0.0])

    height = jnp.where(jnp.isfinite(heights), heights, _FAR)
    tilt = jnp.tan(gel.max_tilt) * lever
    bound = jnp.stack([jnp.float32(jnp.inf), tilt, tilt])

    touch = _cpu_reductions.minimum(jnp.min(height, axis=0))
    reach = touch <= gel.max_depth
    start = jnp.stack([touch + gel.max_depth, jnp.float32(0), jnp.float32(0)])
    u = _newton(height, x, y, target, start, bound, gel.max_depth, _SETTLED * scale)

    u = jnp.where(pressed & reach, u, 0)
    length = _plane(u, x, y) - height
    # The hard bottom yields where it carries the load. Lift the object until the deepest spring is at the limit.
    deepest = _cpu_reductions.maximum(jnp.max(length, axis=0))
    beyond = jnp.where(pressed & reach, jnp.maximum(deepest - gel.max_depth, 0), 0)
    length = jnp.where(pressed & reach, jnp.clip(length - beyond, 0, gel.max_depth), 0)

    # A moment is compared as the force that causes it at half of the lever.
    residual = jnp.abs(_moments(length, x, y) - target) * jnp.array([1.0, 2.0, 2.0])
    balanced = ~pressed | (reach & on_pad & jnp.all(residual <= gel.tolerance * load))
    return Equilibrium(
        sink=u[0] - beyond - (u[1] * centre_y + u[2] * centre_x) / lever,
        turn=jnp.stack([-u[1], u[2]]) / lever,
        pressure=gel.stiffness * length,
        balanced=balanced,
    )


class _Descent(NamedTuple):
    """State of Newton's method. The unknowns are the plane `u0 + u1 y + u2 x` by which the object moves down."""

    steps: Int[Array, ""]  # number of steps so far
    u: Float[Array, "3"]
    step: Float[Array, ""]  # m, largest component of the last step
    gradient: Float[Array, "3"]  # of the energy at u
    hessian: Float[Array, "3 3"]  # of the energy at u, with small positive terms on the diagonal


def _newton(
    height: Float[Array, "r c"],
    x: Float[Array, "c"],
    y: Float[Array, "r"],
    target: Float[Array, "3"],
    start: Float[Array, "3"],
    bound: Float[Array, "3"],
    limit: Scalar,
    settled: Scalar,
) -> Float[Array, "3"]:
    """Find the plane `u0 + u1 y + u2 x` by which an object must move down so that the springs carry the load.

    `height` (m) is finite. x and y of the columns and rows are relative to the centre of pressure and divided by
    the lever. `target` has the wanted sums of the springs' compressions, and of the compressions times y and x (m).
    `start` is the first u, `bound` the largest absolute values of u (m). If they exclude the target, the sums are near
    it. `limit` is the compression at which a spring meets the hard bottom (m). The iteration ends after a step
    shorter than `settled` (m).
    """
    near_bound = 0.9999 * bound

    def pushed(length: Array) -> Array:
        return jnp.maximum(length, 0) + _BOTTOM * jnp.maximum(length - limit, 0)

    def slopes(
        u: Float[Array, "3"], height: Array, x: Array, y: Array, target: Array
    ) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
        """Gradient and Hessian of the energy in `settle` at u, with small positive terms on the Hessian's diagonal."""
        length = _plane(u, x, y) - height
        weight = (length > 0) + _BOTTOM * (length > limit)
        gradient = _moments(pushed(length), x, y) - target
        s = moment_sums(weight, x, y, 2)
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
        return (state.steps < _NEWTON_STEPS) & (state.step > settled)

    fixed = jax.lax.stop_gradient((height, x, y, target))
    first = jax.lax.stop_gradient(start)
    state = _Descent(jnp.int32(0), first, jnp.array(jnp.inf), *slopes(first, *fixed))
    u = jax.lax.stop_gradient(jax.lax.while_loop(unsettled, newton, state).u)

    # One more step, through which the derivatives pass. All earlier values are constants for them.
    gradient, hessian = slopes(u, height, x, y, target)
    return jnp.clip(u - solve_3x3(jax.lax.stop_gradient(hessian), gradient, jnp.abs(u) >= near_bound), -bound, bound)


def _newton_step(state: _Descent, bound: Float[Array, "3"], near_bound: Float[Array, "3"]) -> Float[Array, "3"]:
    """Newton step that keeps all unknowns within their bounds. Unknowns that would leave them are held fixed."""
    u, gradient = state.u, state.gradient
    held = ((u >= near_bound) & (gradient < 0)) | ((u <= -near_bound) & (gradient > 0))
    step = -solve_3x3(state.hessian, gradient, held)
    # Also hold an unknown at its bound if the step of the other unknowns would move it beyond.
    held |= (jnp.abs(u) >= near_bound) & (jnp.abs(u + step) > bound)
    step = -solve_3x3(state.hessian, gradient, held)
    room = (bound - u * jnp.sign(step)) / jnp.where(step == 0, 1, jnp.abs(step))
    return step * jnp.clip(jnp.min(jnp.where(step == 0, 1, room)), 0, 1)


def _plane(u: Float[Array, "3"], x: Float[Array, "c"], y: Float[Array, "r"]) -> Float[Array, "r c"]:
    return (u[0] + u[1] * y)[:, None] + (u[2] * x)[None, :]


def moment_sums(
    value: Float[Array, "r c"], x: Float[Array, "c"], y: Float[Array, "r"], degree: int
) -> Float[Array, "k k"]:
    """Matrix of the sums of `value y^i x^j`, at row i and column j, for powers up to `degree`."""
    # One vector product for each power of y, because products of narrow matrices are several times slower on a CPU.
    rows = [jnp.sum(value, axis=0), *(y**power @ value for power in range(1, degree + 1))]
    return jnp.stack(rows) @ jnp.stack([x**power for power in range(degree + 1)], axis=1)


def _moments(value: Float[Array, "r c"], x: Float[Array, "c"], y: Float[Array, "r"]) -> Float[Array, "3"]:
    sums = moment_sums(value, x, y, 1)
    return jnp.stack([sums[0, 0], sums[1, 0], sums[0, 1]])


def solve_3x3(matrix: Float[Array, "3 3"], vector: Float[Array, "3"], held: Bool[Array, "3"]) -> Float[Array, "3"]:
    """Solve a linear system for the unknowns that are not held, by Cramer's rule. The held unknowns are 0."""
    matrix = jnp.where(held[:, None] | held[None, :], jnp.eye(3), matrix)
    vector = jnp.where(held, 0, vector)
    a, b, c = matrix[:, 0], matrix[:, 1], matrix[:, 2]
    det = jnp.sum(a * jnp.cross(b, c))
    det = jnp.where(det == 0, 1, det)
    parts = [vector * jnp.cross(b, c), a * jnp.cross(vector, c), a * jnp.cross(b, vector)]
    return jnp.stack([jnp.sum(p) for p in parts]) / det
