"""`looped`: conversion of a function, so that `jax.vmap` runs the function and its derivatives as a loop on a CPU.

Under `jax.vmap`, a function with a data-dependent loop, such as the rasteriser, runs the whole batch for as many
iterations as its slowest item needs. On a CPU, it is several times as fast to process one item after the other.
`jax.custom_batching.sequential_vmap` has the same purpose, but no reverse-mode derivative. This module therefore
defines a JAX primitive for the derivative, with its own rule for `jax.vmap`. The primitive stores the arguments of the
function and not the intermediate values, so the backward pass evaluates the function once more.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, ArrayLike

from sts_jax._checked import current_settings, settings
from sts_jax._devices import on_each_device

Flat = Callable[..., list[Array]]


def looped(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that `jax.vmap` runs item by item on a CPU, and for all items at once on other devices.

    The function maps pytrees of arrays to a pytree of arrays. It must not close over traced values.
    """

    def with_trees(*arguments: Any) -> Any:
        leaves, structure = jax.tree.flatten(arguments)
        structures = []

        def flat(*leaves: Array) -> list[Array]:
            results, result_structure = jax.tree.flatten(function(*jax.tree.unflatten(structure, leaves)))
            structures.append(result_structure)
            return results

        results = _looped(flat)(*leaves)
        return jax.tree.unflatten(structures[-1], results)

    return with_trees


def _looped(given: Flat) -> Flat:
    """`looped` for a function from arrays to a list of arrays."""
    # JAX traces the function again for batches and derivatives, then with the caller's settings.
    x64, *_ = current_settings()

    def function(*leaves: Array) -> list[Array]:
        with settings(x64):
            return given(*leaves)

    # JAX passes flags and symbolic zeros in place of arrays. They would have the wrong type for the fields of the
    # caller's trees, so all functions below use lists of arrays.
    @jax.custom_batching.custom_vmap
    def primal(*leaves: Array) -> list[Array]:
        return function(*leaves)

    @primal.def_vmap
    def batched(size: int, flags: Sequence[bool], *leaves: Array) -> tuple[list[Array], list[bool]]:
        results = _over_batch(primal, function, size, flags, leaves)
        return results, [True] * len(results)

    @jax.custom_jvp
    def differentiable(*leaves: Array) -> list[Array]:
        return primal(*leaves)

    @functools.partial(differentiable.defjvp, symbolic_zeros=True)
    def derivative(leaves: tuple, changes: tuple) -> tuple[list[Array], list[Any]]:
        results = differentiable(*leaves)
        active = tuple(not _is_zero(change) and _is_real(leaf) for leaf, change in zip(leaves, changes, strict=True))
        real = tuple(_is_real(result) for result in results)

        def reals(*leaves: Array) -> list[Array]:
            return [result for result, kept in zip(function(*leaves), real, strict=True) if kept]

        moving = [change for change, used in zip(changes, active, strict=True) if used]
        rates = iter(
            _linear.bind(*leaves, *moving, function=reals, active=active, transposed=False, x64=x64) if moving else ()
        )
        slopes = [
            (next(rates) if moving else jnp.zeros_like(result)) if kept else np.zeros(result.shape, jax.dtypes.float0)
            for result, kept in zip(results, real, strict=True)
        ]
        return results, slopes

    return differentiable


def _is_real(value: Any) -> bool:
    return jnp.issubdtype(value.dtype, jnp.inexact)


def _is_zero(tangent: Any) -> bool:
    return isinstance(tangent, jax.custom_derivatives.SymbolicZero)


def _over_batch(
    single: Flat, dense: Flat, size: int, flags: Sequence[bool], leaves: Sequence[ArrayLike]
) -> list[Array]:
    """Map a function over the first axis of the flagged arguments.

    `single` and `dense` compute the same function. `single` is called in a loop on a CPU, and `dense` under `jax.vmap`
    on other devices.
    """
    if not any(flags):
        return jax.vmap(dense, in_axes=None, axis_size=size)(*leaves)

    def merged(items: list[ArrayLike], shared: list[ArrayLike]) -> list[ArrayLike]:
        mapped, whole = iter(items), iter(shared)
        return [next(mapped if flag else whole) for flag in flags]

    def of_device(items: list[ArrayLike], shared: list[ArrayLike]) -> list[Array]:
        if jax.default_backend() == "cpu":
            return jax.lax.map(lambda item: single(*merged(item, shared)), items)
        return jax.vmap(lambda item: dense(*merged(item, shared)))(items)

    items, shared = ([x for x, flag in zip(leaves, flags, strict=True) if flag == kind] for kind in (True, False))
    return on_each_device(of_device, items, shared)


# Primitive that applies the derivative of a function. Its operands are the function's arguments, followed by tangents
# of the active arguments, or by cotangents of the results if it is transposed.
_linear = Primitive("looped_derivative")
_linear.multiple_results = True


def _apply(*operands: ArrayLike, function: Flat, active: tuple[bool, ...], transposed: bool, x64: bool) -> list[Array]:
    with settings(x64):
        return _applied(operands, function, active, transposed)


def _applied(operands: Sequence[ArrayLike], function: Flat, active: tuple[bool, ...], transposed: bool) -> list[Array]:
    arguments, vectors = operands[: len(active)], operands[len(active) :]

    def of_active(*moving: Array) -> list[Array]:
        values = iter(moving)
        return function(*(next(values) if used else x for x, used in zip(arguments, active, strict=True)))

    here = [x for x, used in zip(arguments, active, strict=True) if used]
    if transposed:
        return list(jax.vjp(of_active, *here)[1](list(vectors)))
    return jax.jvp(of_active, here, list(vectors))[1]


def _abstract(*operands: Any, **params: Any) -> list[Any]:
    shapes = jax.eval_shape(functools.partial(_apply, **params), *operands)
    return [jax.core.ShapedArray(leaf.shape, leaf.dtype) for leaf in shapes]


def _derivative(
    primals: Sequence[ArrayLike], tangents: Sequence[Any], **params: Any
) -> tuple[list[Array], list[Array]]:
    """Derivative of the primitive. It is linear in tangents and cotangents, but not in the function's arguments."""
    moving = [k for k, tangent in enumerate(tangents) if type(tangent) is not ad.Zero]

    def of_moving(*values: Array) -> list[Array]:
        operands = list(primals)
        for k, value in zip(moving, values, strict=True):
            operands[k] = value
        return _apply(*operands, **params)

    result = _linear.bind(*primals, **params)
    first = len(params["active"])
    if all(k >= first for k in moving):
        vectors = [ad.instantiate_zeros(tangent) for tangent in tangents[first:]]
        return result, _linear.bind(*primals[:first], *vectors, **params)
    return result, jax.jvp(of_moving, [primals[k] for k in moving], [tangents[k] for k in moving])[1]


def _transpose(cotangents: Sequence[Any], *operands: Any, transposed: bool, **params: Any) -> list[Any]:
    first = len(params["active"])
    vectors = [ad.instantiate_zeros(cotangent) for cotangent in cotangents]
    back = _linear.bind(*operands[:first], *vectors, transposed=not transposed, **params)
    return [None] * first + list(back)


def _batch(operands: Sequence[ArrayLike], axes: Sequence[Any], **params: Any) -> tuple[list[Array], list[int]]:
    """Batching rule of the primitive: a loop if the function's arguments are batched, else `vmap`."""
    flags = [axis is not None for axis in axes]
    moved = [jnp.moveaxis(x, axis, 0) if flag else x for x, axis, flag in zip(operands, axes, flags, strict=True)]
    size = next(jnp.shape(x)[0] for x, flag in zip(moved, flags, strict=True) if flag)
    dense = functools.partial(_apply, **params)
    if any(flags[: len(params["active"])]):
        result = _over_batch(functools.partial(_linear.bind, **params), dense, size, flags, moved)
    else:  # several tangents at one point, as in `jax.jacfwd`, where the function needs one evaluation
        result = jax.vmap(dense, in_axes=[0 if flag else None for flag in flags])(*moved)
    return result, [0] * len(result)


_linear.def_impl(_apply)
_linear.def_abstract_eval(_abstract)
ad.primitive_jvps[_linear] = _derivative
ad.primitive_transposes[_linear] = _transpose
batching.primitive_batchers[_linear] = _batch
mlir.register_lowering(_linear, mlir.lower_fun(_apply, multiple_results=True))
