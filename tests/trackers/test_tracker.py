"""The tracking policy: the network it says it is, and its first layer folded onto a fixed reference."""

from __future__ import annotations

import math
import re
from fractions import Fraction

import numpy as np
import pytest
import torch

from sagemp_cli.errors import ConfigError


def test_the_controls_are_those_of_the_written_out_network(make_tracker):
    tracker = make_tracker(
        1, error_scale=[1, 2, 0.5, 3], control_scale=[0.5, 4.0], control_offset=[9.81, 0.0], negative_slope=0.2
    )
    errors = np.random.default_rng(0).normal(size=(3, 4))
    h = (errors * [1, 2, 0.5, 3]).reshape(-1)
    for layer in tracker.layers:
        if layer is not tracker.layers[0]:
            h = np.where(h > 0, h, 0.2 * h)
        h = layer.weight.detach().numpy() @ h + layer.bias.detach().numpy()
    expected = h * [0.5, 4.0] + [9.81, 0.0]
    np.testing.assert_allclose(tracker(torch.from_numpy(errors)).detach().numpy(), expected, rtol=1e-13)


def test_a_saturating_tracker_cuts_its_controls_off(make_tracker):
    scales = {"control_scale": [0.5, -2.5], "control_offset": [9.81, 0.1]}
    tracker, free = make_tracker(1, saturate=True, **scales), make_tracker(1, **scales)
    errors = 30.0 * torch.randn(200, 3, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    least, most = tracker.control_range()
    for i, offset, scale in ((0, 9.81, 0.5), (1, 0.1, 2.5)):
        low, high = (Fraction(offset) + side * Fraction(scale) for side in (-1, 1))
        assert 0 <= low - Fraction(float(least[i])) <= 2 * math.ulp(low)
        assert 0 <= Fraction(float(most[i])) - high <= 2 * math.ulp(high)
    controls, wanted = tracker(errors), free(errors)
    inside = ((wanted > least) & (wanted < most)).all(-1)
    assert 0 < inside.sum() < len(inside)
    assert torch.equal(controls[inside], wanted[inside])
    assert (controls >= least - 1e-15).all() and (controls <= most + 1e-15).all()
    assert all(math.isinf(end) for side in free.control_range() for end in side.tolist())


def test_limits_that_can_be_written_are_kept_exactly(make_tracker):
    tracker = make_tracker(saturate=True, control_scale=[1.5, 0.5], control_offset=[0.0, 0.5])
    assert [side.tolist() for side in tracker.control_range()] == [[-1.5, 0.0], [1.5, 1.0]]


def test_leading_dimensions_are_batch(make_tracker):
    tracker, errors = make_tracker(), torch.randn(2, 5, 3, 4, dtype=torch.float64, generator=torch.Generator())
    assert tracker(errors).shape == (2, 5, 2)
    torch.testing.assert_close(tracker(errors)[1, 4], tracker(errors[1, 4]), rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"lookahead": 0}, "tracker: lookahead and hidden widths must be positive, found 0 and [8, 8]"),
        ({"hidden": []}, "tracker: lookahead and hidden widths must be positive, found 3 and []"),
        ({"hidden": [8, 0]}, "tracker: lookahead and hidden widths must be positive, found 3 and [8, 0]"),
        ({"negative_slope": 1.0}, "tracker: negative_slope must lie in [0, 1), found 1.0"),
        ({"error_scale": [1.0]}, "tracker: error_scale needs 4 numbers, found 1"),
        ({"saturate": "yes"}, "tracker: saturate must be true or false, found 'yes'"),
        ({"control_scale": [1.0] * 3}, "tracker: control_scale needs 2 numbers, found 3"),
        ({"control_offset": [1.0] * 3}, "tracker: control_offset needs 2 numbers, found 3"),
    ],
)
def test_a_wrong_option_is_named(options, message, make_tracker):
    with pytest.raises(ConfigError, match=re.escape(message)):
        make_tracker(**options)
