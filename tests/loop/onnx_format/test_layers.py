"""Networks as layers: stored and read back, and refused before its numbers are made where one is too large."""

import math

import pytest

from sagemp_cli.errors import ConfigError
from sagemp_cli.loop.onnx_format.layers import Layer, Network


def test_the_numbers_of_all_layers_together_are_limited():
    half = Layer("linear", 2**11, (0,))
    again = Layer("linear", 2**12, (1,))
    with pytest.raises(ConfigError, match="network: it has more than 16777216 numbers, far more than can be bounded"):
        Network(2**12, [half, again])


@pytest.mark.parametrize("limits", [(-1.0, 2.0), (-math.inf, 2.0), (-1.0, math.inf), (-math.inf, math.inf)])
def test_limits_are_the_same_after_they_were_stored_also_where_there_are_none(limits):
    layer = Layer("clamp", 3, (0,), limits)
    assert Layer.of(layer.as_data(), "a layer") == layer


@pytest.mark.parametrize("wrong", [{"size": True}, {"size": "3"}, {"reads": 0}, {"numbers": {}}])
def test_data_that_is_no_layer_is_refused(wrong):
    with pytest.raises(ConfigError, match="a layer must have a kind, a size and lists, found"):
        Layer.of(Layer("relu", 3, (0,)).as_data() | wrong, "a layer")
