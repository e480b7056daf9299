"""What differs between a stack of floating-point matrices and a matrix of symbols.

Every equation of this package is written once, over `@`, `+`, scalar `*` and the few operations gathered here.
Three algebras supply them:

`NUMPY`
    arrays of shape (..., rows, columns), any leading batch shape, float64;
`SYMPY`
    SymPy matrices;
`FIELD`
    two-dimensional NumPy arrays of dtype object that hold elements of an exact field, such as rational
    functions in the link probability.  SymPy's polynomial fields reduce at every step, so that closed
    forms never need `simplify`.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np


class Algebra(Protocol):
    """The operations that NumPy stacks and matrices of symbols do not share."""

    def transpose(self, A: Any) -> Any:
        """Aᵀ, of the last two axes."""
        ...

    def solve(self, A: Any, B: Any) -> Any:
        """A⁻¹ B."""
        ...

    def inverse(self, A: Any) -> Any:
        """A⁻¹ of a symmetric A."""
        ...

    def symmetric(self, A: Any) -> Any:
        """(A + Aᵀ)/2 where rounding can break the symmetry, A itself where arithmetic is exact."""
        ...

    def identity_like(self, A: Any) -> Any:
        """Return the identity with as many rows as A has."""
        ...


class _NumPy:
    def transpose(self, A: Any) -> Any:
        return np.swapaxes(A, -1, -2)

    def solve(self, A: Any, B: Any) -> Any:
        if np.shape(A)[-1] == 1:
            if not np.all(A):
                raise np.linalg.LinAlgError("Singular matrix")
            return np.divide(B, A)
        return np.linalg.solve(A, B)

    def inverse(self, A: Any) -> Any:
        if np.shape(A)[-1] == 1:
            return self.solve(A, 1.0)
        # to unit diagonal first: states in different units, or known to very different precision, then lose nothing
        diagonal = np.diagonal(A, axis1=-2, axis2=-1)
        scale = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
        return np.linalg.inv(A * scale[..., :, None] * scale[..., None, :]) * scale[..., :, None] * scale[..., None, :]

    def symmetric(self, A: Any) -> Any:
        return 0.5 * (A + np.swapaxes(A, -1, -2))

    def identity_like(self, A: Any) -> Any:
        return np.eye(np.shape(A)[-2])


class _SymPy:
    def transpose(self, A: Any) -> Any:
        return A.T

    def solve(self, A: Any, B: Any) -> Any:
        return A.inv() @ B

    def inverse(self, A: Any) -> Any:
        return A.inv()

    def symmetric(self, A: Any) -> Any:
        return A

    def identity_like(self, A: Any) -> Any:
        from sympy import eye

        return eye(A.rows)


class _Field:
    def transpose(self, A: Any) -> Any:
        return A.T

    def solve(self, A: Any, B: Any) -> Any:
        if A.shape == (1, 1):
            return B / A[0, 0]
        from sympy.polys.matrices import DomainMatrix

        domain = A[0, 0].field.to_domain()
        lhs = DomainMatrix([list(row) for row in A], A.shape, domain)
        rhs = DomainMatrix([list(row) for row in B], B.shape, domain)
        return np.array(lhs.lu_solve(rhs).to_list(), dtype=object)

    def inverse(self, A: Any) -> Any:
        return self.solve(A, self.identity_like(A))

    def symmetric(self, A: Any) -> Any:
        return A

    def identity_like(self, A: Any) -> Any:
        one = A.flat[0] ** 0
        return np.array([[one if i == j else 0 * one for j in range(len(A))] for i in range(len(A))], dtype=object)


NUMPY: Algebra = _NumPy()
SYMPY: Algebra = _SymPy()
FIELD: Algebra = _Field()


def inverse(A: Any, algebra: Algebra = NUMPY) -> Any:
    """Return A⁻¹ of a symmetric A; of a floating-point matrix it is symmetric only up to rounding."""
    return algebra.inverse(A)
