"""The gel as a bed of springs, in equilibrium with the wrench that the pad exerts on the object.

Heights are those of the object's underside over the gel's face (m, positive outwards), on a grid of the gel's own;
row 0 is the cell row of lowest y, column 0 that of lowest x, as in an image.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

_NEWTON_STEPS = 20  # at most
_SETTLED = 1e-7  # m, a step shorter than this is the last
_ENOUGH = 0.5  # of the energy's slope along a whole step may be left at its end; else a shorter one is tried
_STEP_LENGTHS = (1.0, 0.6, 0.35, 0.15, 0.05)
_SIDE = 10  # cells, of the squares that are solved for, or left out, as one
_FEW = 32  # squares solved for at first
_NEAR = 0.003  # m over the deepest imprint: what lies within it is solved for at first
_LEVER = 0.02  # m, by which tilts are scaled
_BOTTOM = 300.0  # how many times stiffer the springs are beyond the deepest imprint
_FAR = 1.0  # m, stands for the height where there is no object


Scalar = float | Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Gel:
    """A square pad of soft gel, its outer face in the plane z = 0."""

    size: tuple[Scalar, Scalar] = (0.15, 0.15)  # m, along x and y (paper, "Real-World Dataset")
    thickness: Scalar = 0.005  # m (paper, supplement "Simulator Details")
    stiffness: Scalar = 2e6  # N/m^3, per area; about 10 kPa over 5 mm: a bottle sinks 0.2-0.3 mm. Ours.
    max_depth: Scalar = 0.003  # m, deepest imprint that an equilibrium may ask for. Ours.
    max_tilt: Scalar = 0.0873  # rad (5 degrees), about x and about y each, from the given pose. Ours.
    tolerance: Scalar = 0.005  # of Fz, and of Fz times 1 cm for the moments: what counts as balanced. Ours.
    cells: tuple[int, int] = dataclasses.field(default=(150, 150), metadata={"static": True})  # rows, columns: 1 mm


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Equilibrium:
    """How a rigid object lies in the gel."""

    sink: Float[Array, "*n"]  # m, how far it moves along -z, after the turn
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
    """The imprint that a pose asks for by itself: the object stays where it is, `p = k max(0, -h)`.

    Args:
        gel: its constants.
        heights: of the object's underside over the gel's face (m), `inf` where there is none.

    Returns:
        Equilibrium without motion; balanced, as there is no wrench to balance.
    """
    pressure = gel.stiffness * jnp.clip(-heights, 0, gel.thickness)
    return Equilibrium(jnp.float32(0), jnp.zeros(2), pressure, jnp.bool_(True))


def settle(gel: Gel, heights: Float[Array, "r c"], wrench: Float[Array, "6"]) -> Equilibrium:
    """Depth and two tilts at which the springs balance Fz, Mx and My.

    With the object moved by `h' = h - d + a y - b x`, the pressure is `p = k max(0, -h')`, and

        Fz = sum p A,   Mx = sum y p A,   My = -sum x p A

    are the stationarity of `E = sum k A max(0, -h')^2 / 2 - Fz d + Mx a + My b`, which is convex and piecewise
    quadratic: projected Newton steps with a line search, from an imprint as deep as the limit allows below first
    touch. Beyond `max_depth` the springs meet a hard bottom, which carries what is left and counts for nothing in the
    pressure. Derivatives are those of the equilibrium (implicit function theorem: one more Newton step, undamped).

    Args:
        gel: its constants.
        heights: of the object's underside over the gel's face (m), `inf` where there is none.
        wrench: force (N) and moment about the sensor's origin (N m) of the pad on the object; Fx, Fy and Mz are
            friction and play no part.

    Returns:
        Equilibrium. With `Fz <= 0` nothing moves and nothing is pressed. Where no equilibrium exists (first touch
        farther off than `max_depth`, centre of pressure outside what the footprint can carry, a limit reached) it is
        what the limits allow, and `balanced` is False.
    """
    force = wrench[2]
    pressed = force > 0
    safe_force = jnp.where(pressed, force, 1)
    load = jnp.where(pressed, force, 0) / (gel.stiffness * cell_area(gel))  # sum of the springs' lengths (m)
    # Tilts are taken about the centre of pressure, and measured by the height they make a lever's length from it.
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

    # Few cells are pressed: first only squares of cells near the lowest one are solved for. That is the whole solution
    # if it presses none that was left out; else all are solved for.
    squares, squares_x, squares_y = _squares(height, x, y)
    lowest = jnp.min(squares, axis=1)
    touch = jnp.min(lowest)
    reach = touch <= gel.max_depth
    start = jnp.stack([touch + gel.max_depth, jnp.float32(0), jnp.float32(0)])
    number = len(lowest)

    def solve(chosen: Int[Array, "n"]) -> Float[Array, "3"]:
        cells = squares.at[chosen].get(mode="fill", fill_value=_FAR)
        shape = (len(chosen), _SIDE, _SIDE)
        own_x = jnp.broadcast_to(squares_x[chosen % len(squares_x)][:, None, :], shape)
        own_y = jnp.broadcast_to(squares_y[chosen // len(squares_x) % len(squares_y)][:, :, None], shape)
        basis = jnp.stack([jnp.ones(cells.size), own_y.reshape(-1), own_x.reshape(-1)])
        return _newton(cells.reshape(-1), basis, target, start, bound, gel.max_depth)

    (few,) = jnp.nonzero(lowest < touch + gel.max_depth + _NEAR, size=min(_FEW, number), fill_value=number)
    u = solve(few)
    left_out = jnp.ones(number, bool).at[few].set(False, mode="drop").reshape(len(squares_y), len(squares_x))
    left_out = left_out.repeat(_SIDE, axis=0).repeat(_SIDE, axis=1)[: gel.cells[0], : gel.cells[1]]
    missed = jnp.any(left_out & (_plane(u, x, y) > height))
    u = jax.lax.cond(missed, lambda: solve(jnp.arange(number)), lambda: u)

    u = jnp.where(pressed & reach, u, 0)
    length = jnp.where(pressed & reach, jnp.clip(_plane(u, x, y) - height, 0, gel.max_depth), 0)

    # the moments' errors over a lever of 1 cm
    residual = jnp.abs(_moments(length, x, y) - target) * jnp.array([1.0, _LEVER / 0.01, _LEVER / 0.01])
    balanced = ~pressed | (reach & on_pad & jnp.all(residual <= gel.tolerance * load))
    return Equilibrium(
        sink=u[0] - (u[1] * centre_y + u[2] * centre_x) / _LEVER,
        turn=jnp.stack([-u[1], u[2]]) / _LEVER,
        pressure=gel.stiffness * length,
        balanced=balanced,
    )


def _squares(
    height: Float[Array, "r c"], x: Float[Array, "c"], y: Float[Array, "r"]
) -> tuple[Float[Array, "n k"], Float[Array, "a s"], Float[Array, "b s"]]:
    """Heights square by square, and the x and y of each column and row of squares; beyond the grid nothing is near."""
    down, across = ((0, -n % _SIDE) for n in height.shape)
    column, row = jnp.pad(x, across).reshape(-1, _SIDE), jnp.pad(y, down).reshape(-1, _SIDE)
    squares = jnp.pad(height, (down, across), constant_values=_FAR).reshape(len(row), _SIDE, len(column), _SIDE)
    return squares.swapaxes(1, 2).reshape(-1, _SIDE * _SIDE), column, row


def _newton(
    height: Float[Array, "n"],
    basis: Float[Array, "3 n"],
    target: Float[Array, "3"],
    start: Float[Array, "3"],
    bound: Float[Array, "3"],
    limit: Scalar,
) -> Float[Array, "3"]:
    """The plane `u . basis` whose springs to `height` have the moments `target`, or what comes nearest in bounds."""
    near_bound = 0.9999 * bound

    def plane(u: Float[Array, "3"], basis: Float[Array, "3 n"]) -> Float[Array, "n"]:
        return u[0] * basis[0] + u[1] * basis[1] + u[2] * basis[2]

    def pushed(length: Array) -> Array:
        return jnp.maximum(length, 0) + _BOTTOM * jnp.maximum(length - limit, 0)

    def curvature(length: Float[Array, "n"], basis: Float[Array, "3 n"]) -> Float[Array, "3 3"]:
        weight = (length > 0) + _BOTTOM * (length > limit)
        full = (weight[None, :] * basis) @ basis.T
        return full + (1e-6 + 1e-5 * full[0, 0]) * jnp.eye(3)

    def newton(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        count, u, _ = state
        length = plane(u, fixed_basis) - fixed_height
        gradient = fixed_basis @ pushed(length) - fixed_target
        held = ((u >= near_bound) & (gradient < 0)) | ((u <= -near_bound) & (gradient > 0))
        matrix = curvature(length, fixed_basis)
        step = -_solve(matrix, gradient, held)
        # At a limit, and still led beyond it by the other unknowns: without this one.
        held |= (jnp.abs(u) >= near_bound) & (jnp.abs(u + step) > bound)
        step = -_solve(matrix, gradient, held)
        room = (bound - u * jnp.sign(step)) / jnp.where(step == 0, 1, jnp.abs(step))
        step = step * jnp.clip(jnp.min(jnp.where(step == 0, 1, room)), 0, 1)
        along = plane(step, fixed_basis)

        def slope(part: float) -> Float[Array, ""]:
            return jnp.abs(jnp.sum(pushed(length + part * along) * along) - jnp.sum(step * fixed_target))

        def shorter() -> Float[Array, ""]:
            slopes = jnp.stack([slope(part) for part in _STEP_LENGTHS])
            return jnp.array(_STEP_LENGTHS)[jnp.argmin(slopes)]

        whole = slope(1.0) <= _ENOUGH * jnp.abs(jnp.sum(step * gradient))
        u = u + jax.lax.cond(whole, lambda: jnp.ones(()), shorter) * step
        return count + 1, u, jnp.max(jnp.abs(step))

    def unsettled(state: tuple[Array, Array, Array]) -> Bool[Array, ""]:
        return (state[0] < _NEWTON_STEPS) & (state[2] > _SETTLED)

    fixed_basis, fixed_height, fixed_target = jax.lax.stop_gradient((basis, height, target))
    first = (jnp.int32(0), jax.lax.stop_gradient(start), jnp.array(jnp.inf))
    u = jax.lax.stop_gradient(jax.lax.while_loop(unsettled, newton, first)[1])

    length = plane(u, basis) - height
    gradient = basis @ pushed(length) - target
    matrix = jax.lax.stop_gradient(curvature(length, basis))
    return jnp.clip(u - _solve(matrix, gradient, jnp.abs(u) >= near_bound), -bound, bound)


def _plane(u: Float[Array, "3"], x: Float[Array, "c"], y: Float[Array, "r"]) -> Float[Array, "r c"]:
    return (u[0] + u[1] * y)[:, None] + (u[2] * x)[None, :]


def _sums(value: Float[Array, "r c"], x: Float[Array, "c"], y: Float[Array, "r"]) -> Float[Array, "3 3"]:
    """`sum value y^i x^j`, as two matrix products."""
    powers_x = jnp.stack([jnp.ones_like(x), x, x * x], axis=1)
    powers_y = jnp.stack([jnp.ones_like(y), y, y * y], axis=0)
    return powers_y @ (value @ powers_x)


def _moments(value: Float[Array, "r c"], x: Float[Array, "c"], y: Float[Array, "r"]) -> Float[Array, "3"]:
    sums = _sums(value, x, y)
    return jnp.stack([sums[0, 0], sums[1, 0], sums[0, 1]])


def _solve(matrix: Float[Array, "3 3"], vector: Float[Array, "3"], held: Bool[Array, "3"]) -> Float[Array, "3"]:
    """Solve among the unknowns that are not held; 0 for those that are."""
    matrix = jnp.where(held[:, None] | held[None, :], jnp.eye(3), matrix)
    vector = jnp.where(held, 0, vector)
    a, b, c = matrix[:, 0], matrix[:, 1], matrix[:, 2]
    det = jnp.sum(a * jnp.cross(b, c))
    det = jnp.where(det == 0, 1, det)
    parts = [vector * jnp.cross(b, c), a * jnp.cross(vector, c), a * jnp.cross(b, vector)]
    return jnp.stack([jnp.sum(p) for p in parts]) / det
