"""A tube that a simulated rollout leaves is no answer, whoever made it."""

import dataclasses

import pytest
import torch

from sagemp_cli.errors import SagempError
from sagemp_cli.reachability import reach
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.propagator import Propagator, Reach
from sagemp_cli.sets import Box, Tube


@dataclasses.dataclass(frozen=True)
class TooSmall(Propagator):
    """The tube of affine arithmetic, but of one state at one step only its lower half, or its upper one."""

    upper: bool
    name = "too small"
    rigorous = True

    def reach(self, loop, start, disturbance, *, watch=False):
        tube = Affine().propagate(loop, start, disturbance)
        lower, upper = tube.lower.clone(), tube.upper.clone()
        side = lower if self.upper else upper
        side[..., 2, 1] = (0.5 * (tube.lower + tube.upper))[..., 2, 1]
        return Reach(Tube(lower, upper))


@pytest.mark.parametrize("upper", [False, True])
def test_a_tube_that_is_too_small_in_one_place_is_not_given(upper):
    start, w = Box.around([0.5, 0.2], [0.1, 0.1]), Box.around([0.0, 0.0], [0.02, 0.02])
    turn = torch.tensor([[0.9, 0.2], [-0.2, 0.9]], dtype=torch.float64)
    assert reach(lambda x, w: x @ turn.T + w, start, w, 3).horizon == 3
    with pytest.raises(SagempError, match="a simulated rollout leaves the tube at step 2 in state 1; no tube is"):
        reach(lambda x, w: x @ turn.T + w, start, w, 3, propagator=TooSmall(upper))
