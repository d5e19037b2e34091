"""Moment matching of one rollout's particles as one GPU kernel there and one back.

Compiled by XLA it is ten small ones a step of the rollout, which wait for each other: docs/decisions/0013. A program
has all K particles of a seed, a vector for each dimension; matrices are lists of numbers, written out.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas
from jax.experimental.pallas import triton

from pegasus_jax.types import Array

Matrix = list[list[Any]]  # the numbers of a lower triangular matrix, or of a whole one, by rows

MOST = 8  # dimensions: the equations are written out, which grows with their cube
PARTICLES = 2048  # more do not fit into a program's registers
LANES = 256  # particles that a warp of the program has


def suits(x: Array) -> bool:
    """Whether the kernel is for particles x [K, D]."""
    return x.shape[1] <= MOST and x.shape[0] <= PARTICLES


def block(particles: int) -> int:
    """Places of a program for so many particles: a power of two, and at least a warp."""
    return max(32, 1 << (particles - 1).bit_length())


def fused(plain: Callable[[Array, Array], Array], *, interpret: bool = False) -> Callable[[Array, Array], Array]:
    """`plain`, which is `moments.match_plain`, as kernels; `interpret` runs them without a GPU.

    The gradient by z, which no search asks for, is that of `plain`.
    """

    def call(kernel: Callable, x: Array, *others: Array) -> Array:
        warps = max(1, block(x.shape[0]) // LANES)
        how = None if interpret else triton.CompilerParams(num_warps=warps, num_stages=1)
        shape = jax.ShapeDtypeStruct(x.shape, x.dtype)
        return pallas.pallas_call(kernel, out_shape=shape, interpret=interpret, compiler_params=how)(x, *others)

    def there(x: Array, z: Array) -> tuple[Array, tuple[Array, Array]]:
        return call(matched, x, z), (x, z)

    def back(residuals: tuple[Array, Array], cotangent: Array) -> tuple[Array, Array]:
        x, z = residuals
        _, pull = jax.vjp(lambda z: plain(x, z), z)
        return call(pulled, x, z, cotangent), *pull(cotangent)

    match = jax.custom_vjp(lambda x, z: there(x, z)[0])
    match.defvjp(there, back)
    return match


def matched(x: Any, z: Any, out: Any) -> None:
    """out = mean + L z."""
    own = Particles(*x.shape)
    mean, _, cov = own.moments(own.read(x))
    root, _, _ = factor(cov)
    draws = own.read(z)
    own.write(out, [m + dot(row, draws) for m, row in zip(mean, root, strict=True)])


def pulled(x: Any, z: Any, cotangent: Any, out: Any) -> None:
    """The cotangent of x: as `moments.cholesky` has its derivative, turned round."""
    own = Particles(*x.shape)
    _, centered, cov = own.moments(own.read(x))
    _, root, floored = factor(cov)
    given, draws = own.read(cotangent), own.read(z)
    size = len(given)
    of_root = [[jnp.sum(given[i] * draws[j]) for j in range(i + 1)] for i in range(size)]

    def product(i: int, j: int) -> Any:
        """An entry of P, which is the lower half of L' of_root with half of its diagonal."""
        if j > i:
            return 0.0
        inner = sum(root[k][i] * of_root[k][j] for k in range(i, size))
        return jnp.where(floored[i], inner, 0.5 * inner) if i == j else inner

    # L^-T P L^-1: solved for the columns of P first, then for the rows of what is left.
    columns = [substituted(root, [product(i, j) for i in range(size)]) for j in range(size)]
    of_cov = [substituted(root, [column[i] for column in columns]) for i in range(size)]
    slope = [[(of_cov[i][j] + of_cov[j][i]) / (own.count - 1) for j in range(size)] for i in range(size)]
    of_mean = [jnp.sum(g) / own.count for g in given]
    own.write(out, [m + dot(row, centered) for m, row in zip(of_mean, slope, strict=True)])


class Particles:
    """The K particles of a program, in a block whose size is a power of two; those beyond K are 0."""

    def __init__(self, count: int, size: int) -> None:
        self.count, self.size = count, size
        self.rows = jnp.arange(block(count))
        self.there = self.rows < count

    def read(self, ref: Any) -> list[Array]:
        """The columns of what is [K, D]."""
        return [triton.load(ref.at[self.rows, i], mask=self.there, other=0.0) for i in range(self.size)]

    def write(self, ref: Any, columns: list[Array]) -> None:
        for i, column in enumerate(columns):
            triton.store(ref.at[self.rows, i], column, mask=self.there)

    def moments(self, x: list[Array]) -> tuple[list[Array], list[Array], Matrix]:
        """Mean, x - mean, and the lower half of the unbiased covariance."""
        mean = [jnp.sum(column) / self.count for column in x]
        centered = [jnp.where(self.there, column - m, 0.0) for column, m in zip(x, mean, strict=True)]
        cov = [[jnp.sum(centered[i] * centered[j]) / (self.count - 1) for j in range(i + 1)] for i in range(self.size)]
        return mean, centered, cov


def factor(cov: Matrix) -> tuple[Matrix, Matrix, list[Array]]:
    """The root L of `moments.cholesky`, the same with its pivots, and which pivots are floored, so constants."""
    root: Matrix = []
    pivoted: Matrix = []
    floored = []
    for i, row in enumerate(cov):
        new: list[Any] = []
        for j in range(i):
            new.append((row[j] - dot(new, pivoted[j][:j])) / pivoted[j][j])
        left = row[i] - dot(new, new)
        pivot = jnp.sqrt(jnp.maximum(left, 1e-7 * row[i] + float(jnp.finfo(jnp.float32).tiny) ** 0.5))
        last = left / pivot
        root.append([*new, last])
        pivoted.append([*new, pivot])
        floored.append(last < pivot * (1 - 1e-5))
    return root, pivoted, floored


def substituted(root: Matrix, right: list[Any]) -> list[Any]:
    """a with L' a = right."""
    size = len(root)
    a: list[Any] = [0.0] * size
    for i in reversed(range(size)):
        a[i] = (right[i] - sum(root[k][i] * a[k] for k in range(i + 1, size))) / root[i][i]
    return a


def dot(a: list[Any], b: list[Any]) -> Any:
    """The sum of products of the first entries."""
    return sum((x * y for x, y in zip(a, b, strict=False)), start=0.0)
