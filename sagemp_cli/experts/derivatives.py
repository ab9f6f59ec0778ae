"""Exact Jacobians of functions that work row by row, for all rows at once."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


def row_jacobians(function: Callable[[Tensor], Tensor], rows: Tensor, *, outputs: int) -> Tensor:
    """Jacobians ``(rows, outputs, q)`` of a function that maps ``(..., rows, q)`` to ``(..., rows, outputs)`` by rows.

    One forward and one backward pass over as many copies of the rows as there are outputs: at a hundred short rows
    the number of torch calls decides, not their size. As exact as ``torch.func``, and several times quicker here.
    """
    copies = rows.detach().expand(outputs, *rows.shape).clone().requires_grad_(True)
    chosen = torch.diagonal(function(copies), dim1=0, dim2=-1)  # output i of copy i, (rows, outputs)
    # The product with zero keeps the graph where the function does not depend on the rows at all.
    (gradient,) = torch.autograd.grad(chosen.sum() + 0.0 * copies.sum(), copies)
    return gradient.transpose(0, 1)
