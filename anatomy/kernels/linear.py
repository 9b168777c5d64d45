"""Small linear systems, solved in kernels without a library."""

from anatomy.kernels.compiling import borrowing_kernel


@borrowing_kernel
def solve_in_place(matrix, right):
    """Solve a small linear system in place; return the determinant, 0 if it is singular."""
    n = right.shape[0]
    determinant = 1.0
    for c in range(n):
        pivot = c
        for r in range(c + 1, n):
            if abs(matrix[r, c]) > abs(matrix[pivot, c]):
                pivot = r
        if matrix[pivot, c] == 0.0:
            return 0.0
        if pivot != c:
            determinant = -determinant
            right[c], right[pivot] = right[pivot], right[c]
            for m in range(n):
                matrix[c, m], matrix[pivot, m] = matrix[pivot, m], matrix[c, m]
        determinant *= matrix[c, c]
        for r in range(c + 1, n):
            factor = matrix[r, c] / matrix[c, c]
            right[r] -= factor * right[c]
            for m in range(c, n):
                matrix[r, m] -= factor * matrix[c, m]
    for r in range(n - 1, -1, -1):
        for m in range(r + 1, n):
            right[r] -= matrix[r, m] * right[m]
        right[r] /= matrix[r, r]
    return determinant
