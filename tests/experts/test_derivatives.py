from __future__ import annotations

import torch

from sagemp_cli.experts.derivatives import row_jacobians


def test_row_jacobians_agree_with_torch_func_on_every_row():
    rows = torch.linspace(-1.0, 2.0, 21, dtype=torch.float64).reshape(7, 3)

    def function(z):
        return torch.stack([torch.sin(z[..., 0]) * z[..., 1], z[..., 2] * z[..., 2]], dim=-1)

    expected = torch.func.vmap(torch.func.jacrev(function))(rows)
    torch.testing.assert_close(row_jacobians(function, rows, outputs=2), expected)


def test_a_function_that_ignores_its_rows_has_a_zero_jacobian():
    rows = torch.ones(4, 3, dtype=torch.float64)
    jacobian = row_jacobians(lambda z: torch.ones(*z.shape[:-1], 2, dtype=z.dtype), rows, outputs=2)
    torch.testing.assert_close(jacobian, torch.zeros(4, 2, 3, dtype=torch.float64))
